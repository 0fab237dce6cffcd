"""The bag directory: the contract between the two programs, and the reader that applies it."""
