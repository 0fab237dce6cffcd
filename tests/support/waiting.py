"""Waiting for something that a process is about to do: for as long as it takes, up to a bound."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

PATIENCE_S: Final = 180.0
"""How long any condition is waited for, and any program to end, before it counts as vain.

No promise of the product: where all is well nobody waits for so long, and a machine that has more
to do than it has processors may need most of it to start one program.
"""


def until(what: Callable[[], T | None], *, timeout_s: float = PATIENCE_S) -> T:
    """The first result of `what` that is neither None nor False.

    Raises:
        AssertionError: there was none within the timeout.
    """
    give_up = time.monotonic() + timeout_s
    while True:
        found = what()
        if found is not None and found is not False:
            return found
        assert time.monotonic() < give_up, f"{what} did not come about within {timeout_s:g} s"
        time.sleep(0.01)
