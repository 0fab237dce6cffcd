"""Recording, and the state of the bag directory."""

import sys

if "structlog" not in sys.modules and "rich" not in sys.modules:
    # structlog imports rich where it can, for tracebacks that nothing here uses: 8 MB.
    sys.modules["rich"] = None  # type: ignore[assignment]
    import structlog  # noqa: F401

    del sys.modules["rich"]
