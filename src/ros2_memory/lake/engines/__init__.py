"""Engines that run SQL over the data files of a lake: the port, and an adapter for each."""
