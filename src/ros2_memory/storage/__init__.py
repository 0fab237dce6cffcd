"""Reading bag files: the port, and one adapter for each backend."""
