"""A test double of `ros2 bag record`; see README.md."""
