"""A robot's episodic memory: recorded ROS 2 topics, and answers about the past over MCP."""
