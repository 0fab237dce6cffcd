"""Even downsampling, and the notes that say so.

A reply that leaves something out says how much of how much; these are the only two wordings.
"""

from __future__ import annotations


def evenly(count: int, at_most: int) -> list[int]:
    """Returns at most `at_most` evenly spaced indices into `count` values, strictly increasing.

    The first and the last value are kept, and the distances between neighbours differ by at most
    one. If only one may be kept it is the last: the newest.

    Raises:
        ValueError: `at_most` is below 1.
    """
    if at_most < 1:
        raise ValueError(f"at most {at_most} values cannot be kept; at least 1 is")
    if count <= at_most:
        return list(range(count))
    if at_most == 1:
        return [count - 1]
    return [place * (count - 1) // (at_most - 1) for place in range(at_most)]


def array_note(name: str, kept: int, total: int) -> str:
    """Returns the note on an array inside a message that was thinned."""
    return f"{name}: {kept} of {total} values, evenly spaced"


def samples_note(kept: int, total: int) -> str:
    """Returns the note on a window whose samples were thinned."""
    return f"{kept} of {total} samples, evenly spaced over the window"
