"""Recordings of different runs that overlap in time, and answer together all the same.

Bags that were copied into one folder, two robots' for instance, answer as one memory. Where one
recording took over from another they overlap too: that is written down in `handover.json`, each
message counts once, and there is nothing to report.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple
from weakref import WeakKeyDictionary

from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.bag_dir.layout import MOMENTS_FOLDER
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.index.recordings import folder_of, loose_bags

if TYPE_CHECKING:
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.index.timeline import Timeline

LONG_NS: Final[Ns] = 30 * NS_PER_S
"""No handover takes longer; a shorter overlap counts where it is half of a recording."""
SHORT_NS: Final[Ns] = NS_PER_S
_IN_MOMENTS: Final = f"/{MOMENTS_FOLDER}/"
_MOMENT: Final = re.compile(rf"(?P<bag_dir>.*){_IN_MOMENTS}\d{{8}}T\d{{6}}Z[^/]*/(?P<recording>.+)")
_MAX_READ: Final = 200
"""How many pairs are checked for a handover; each costs two files."""


class Overlapping(NamedTuple):
    """Two recordings, by their paths, and when (log times, inclusive) they overlap."""

    first: Path
    second: Path
    start: Ns
    end: Ns

    @property
    def names(self) -> tuple[str, str]:
        """The names of the two, with those of their parents where these are equal."""
        depth = 1 if self.first.name != self.second.name else 2
        first, second = ("/".join(each.parts[-depth:]) for each in (self.first, self.second))
        return first, second


def overlapping_recordings(snapshot: Snapshot) -> tuple[Overlapping, ...]:
    """Returns the pairs of recordings that overlap and that no handover joins, in order of time.

    Bags that a wrong clock dated are left out. Those in a saved moment count with the recording
    that they were saved from.
    """
    known = _KNOWN.get(snapshot.timeline)
    if known is None:
        known = _KNOWN[snapshot.timeline] = _long_overlaps(snapshot)
    return tuple(each for each in known if not _took_over(each))


_KNOWN: Final[WeakKeyDictionary[Timeline, tuple[Overlapping, ...]]] = WeakKeyDictionary()
"""Caches the pairs of a timeline, but for their handovers; a new bag makes a new timeline."""


def _long_overlaps(snapshot: Snapshot) -> tuple[Overlapping, ...]:
    spans, pairs = _sweep(snapshot)
    found = []
    for (one, other), (start, end, shared) in pairs.items():
        shorter = min(spans[one], spans[other])
        if shared > LONG_NS or (shared > SHORT_NS and 2 * shared >= shorter):
            found.append(Overlapping(Path(one), Path(other), start, end))
    return tuple(sorted(found, key=lambda each: each.start)[:_MAX_READ])


def _sweep(
    snapshot: Snapshot,
) -> tuple[dict[str, Ns], dict[tuple[str, str], tuple[Ns, Ns, Ns]]]:
    """Returns how long each recording is, and when and for how long two have a bag at once."""
    left_out, spans = snapshot.dating.misdated, dict[str, Ns]()
    loose = loose_bags(snapshot)
    pairs: dict[tuple[str, str], tuple[Ns, Ns, Ns]] = {}
    reach: dict[str, Ns] = {}
    for bag in snapshot.bags:
        if bag.file in left_out:
            continue
        own, start, end = loose.get(bag.file) or folder_of(bag.file), bag.start, bag.end
        if _IN_MOMENTS in own:
            own = _recorded_folder(own)
        before = reach.get(own)
        if len(reach) > (before is not None):
            for other, until in [*reach.items()]:
                if other == own:
                    continue
                if until <= start:
                    del reach[other]
                    continue
                pair = (other, own) if other < own else (own, other)
                last = min(until, end)
                first, until_then, shared = pairs.get(pair, (start, last, 0))
                pairs[pair] = (first, max(last, until_then), shared + last - start)
        reach[own] = end if before is None or end > before else before
        spans[own] = spans.get(own, 0) + end - start
    return spans, pairs


def _recorded_folder(folder: str) -> str:
    """Returns the folder of the recording that a folder in a saved moment has bags of."""
    found = _MOMENT.fullmatch(folder)
    return f"{found['bag_dir']}/{found['recording']}" if found else folder


def _took_over(pair: Overlapping) -> bool:
    """Returns whether a handover joins the two recordings."""
    names = {pair.first.name, pair.second.name}
    handovers = (read_handover(each).handover for each in (pair.first, pair.second))
    return pair.first.parent == pair.second.parent and any(
        names & {handover.previous, handover.next} for handover in handovers
    )
