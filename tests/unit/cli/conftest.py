"""What the tests of the commands share."""

from tests.support.program import exits

__all__ = ["exits"]
