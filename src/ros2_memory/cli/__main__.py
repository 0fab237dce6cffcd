"""`python -m ros2_memory.cli`: as `ros2-memory`."""

import sys

from ros2_memory.cli.app import main

if __name__ == "__main__":
    sys.exit(main())
