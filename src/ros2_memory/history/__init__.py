"""One call's view across many bags."""
