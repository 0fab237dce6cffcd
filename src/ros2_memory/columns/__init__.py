"""Whole bags as columns: what every message of a topic says, in arrays."""
