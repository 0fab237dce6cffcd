"""Which release of the package this is."""

from importlib.metadata import PackageNotFoundError, version
from typing import Final

PACKAGE: Final = "ros2-memory"


def package_version() -> str:
    """The installed version of this package; `0` where it is run without being installed."""
    try:
        return version(PACKAGE)
    except PackageNotFoundError:
        return "0"
