"""Garbage collection, latched carry-forward, repair and saved moments."""
