"""A real server under clients of every bad habit, with its memory, threads and files counted."""
