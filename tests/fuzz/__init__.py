"""Damages good bags in every way there is, and asks questions beside them."""
