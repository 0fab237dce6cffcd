"""Whether the system clock is synchronised with a time server.

Nothing else makes its dates fit to delete by: a clock that was set by hand, or that starts wrong
for want of a battery, looks like any other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod


class TimeSync(ABC):
    """Knows whether the system clock is synchronised."""

    @abstractmethod
    def is_synchronised(self) -> bool:
        """Whether the clock is reported synchronised now; False also where nobody can say.

        It may take some seconds. Raises nothing.
        """
