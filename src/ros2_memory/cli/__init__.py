"""`ros2-memory`: the program for people. `app` has its commands."""

from ros2_memory.cli.app import main

__all__ = ["main"]
