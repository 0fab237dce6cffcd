"""Adapters of the telemetry port, which need `pip install 'ros2-memory[observability]'`."""
