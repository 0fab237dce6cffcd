"""A robot's memory made of its rows in a lake, so that every question is folded as on the robot."""
