"""Faults of the machine under a running memory: what it answers, says, and does when they pass."""
