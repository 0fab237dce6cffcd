"""Where the robot was: in the map, in regions, in named places."""
