"""The `ros2 bag record` subprocess: argv, environment, output, signals."""
