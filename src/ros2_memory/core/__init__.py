"""Errors, times, the domain model, geometry, text, logging: what every room may use."""
