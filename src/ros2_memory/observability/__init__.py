"""Adapters of the telemetry port, which need `pip install '.[observability]'`."""
