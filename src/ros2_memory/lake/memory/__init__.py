"""A robot's memory over the bags that a lake has of it."""
