"""What holds for every test."""

import atexit
import os
import shutil
from tempfile import mkdtemp

from hypothesis import settings

# A loaded machine is slow, not wrong.
settings.register_profile("steady", deadline=None)
settings.load_profile("steady")

# Also for the programs that tests start: nothing is to be left in the user's own.
_CACHE = mkdtemp(prefix="ros2-memory-tests-")
atexit.register(shutil.rmtree, _CACHE, ignore_errors=True)
os.environ["XDG_CACHE_HOME"] = _CACHE
