"""A second opinion: the same questions, answered by brute force with plain libraries.

`truth` reads every message of every file with `mcap`, `sqlite3` and `rosbags`, and shares no line
with the package. `worlds` writes histories that are odd in the ways of real robots. `exam` draws
questions at random, asks the server's dispatcher, and compares. EPISODIC_SEED chooses others,
EPISODIC_QUESTIONS how many of each world.
"""
