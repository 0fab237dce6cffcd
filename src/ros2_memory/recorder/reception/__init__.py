"""How messages reach `ros2 bag record`: queues that are deep enough, and what is lost before."""
