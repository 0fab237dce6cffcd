"""Many robots, one memory: the tools of one robot, asked of several, and their replies as one."""
