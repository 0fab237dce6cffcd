"""Recording, and the state of the bag directory."""

import ros2_memory.core.logging_setup  # noqa: F401 - before any module here imports structlog
