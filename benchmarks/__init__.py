"""Measures this project against plain rosbags and against the physical floor (README.md)."""
