"""One recording takes over from another without losing or doubling a message."""
