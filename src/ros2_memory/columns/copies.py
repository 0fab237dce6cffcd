"""Copies: messages that a message of another recording repeats, of which one counts.

Recordings overlap for some seconds while one takes over from the other. A message that is in both
has the same publish time and payload in each, and log times that differ by little
(`COPY_HORIZON_NS` at most); it counts once, at its earliest log time. Where one recording has it n
times and another m times, it counts max(n, m) times. Inside one recording nothing is a copy,
however alike two messages are.

A latched message is received again by each new recording: it counts at its earliest log time,
however long ago that is.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.core.spans import COPY_HORIZON_NS
from ros2_memory.storage.base import RELATCHED_NS, IntArray

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ros2_memory.core.timebase import Ns


class Identities(NamedTuple):
    """What tells messages apart, of messages of one topic.

    Attributes:
        log_times: ns.
        publish_times: ns.
        hashes: of the payloads.
        recordings: a number for the recording of each.
    """

    log_times: IntArray
    publish_times: IntArray
    hashes: IntArray
    recordings: IntArray

    def rows(self, positions: IntArray) -> Identities:
        """Returns some of them."""
        return Identities(*(column[positions] for column in self))


def copies_among(messages: Identities) -> NDArray[np.bool_]:
    """Returns which of the messages repeat an earlier one of another recording.

    Of several of one log time that of the recording with the lowest number counts.
    """
    copies = np.zeros(messages.log_times.size, np.bool_)
    suspects = _shared_by_recordings(messages)
    suspected = messages.rows(suspects)
    order = suspects[np.lexsort((suspected.recordings, suspected.log_times))]
    counts: dict[tuple[int, int], dict[int, int]] = {}
    recent: deque[tuple[Ns, tuple[int, int]]] = deque()
    columns = (column.tolist() for column in messages.rows(order))
    rows = zip(order.tolist(), *columns, strict=True)
    for row, time, published, payload, recording in rows:
        while recent and recent[0][0] < time - COPY_HORIZON_NS:
            counts.pop(recent.popleft()[1], None)
        key = (published, payload)
        by_recording = counts.setdefault(key, {})
        most = max(by_recording.values(), default=0)
        by_recording[recording] = by_recording.get(recording, 0) + 1
        if by_recording[recording] > most:
            recent.append((time, key))
        else:
            copies[row] = True
    return copies


def relatched_among(messages: Identities) -> NDArray[np.bool_]:
    """Returns which messages were received again: late, and before by another recording."""
    order = np.lexsort(
        (messages.recordings, messages.log_times, messages.hashes, messages.publish_times)
    )
    ordered = messages.rows(order)
    is_first = np.ones(order.size, np.bool_)
    is_first[1:] = (np.diff(ordered.publish_times) != 0) | (np.diff(ordered.hashes) != 0)
    first = np.maximum.accumulate(np.where(is_first, np.arange(order.size), 0))
    is_late = ordered.log_times - ordered.publish_times > RELATCHED_NS
    is_again = (
        is_late
        & (ordered.log_times > ordered.log_times[first])
        & (ordered.recordings != ordered.recordings[first])
    )
    relatched = np.zeros(order.size, np.bool_)
    relatched[order] = is_again
    return relatched


def _shared_by_recordings(messages: Identities) -> IntArray:
    """Returns the rows whose publish time and payload several recordings have."""
    if not messages.log_times.size:
        return np.zeros(0, np.int64)
    order = np.lexsort((messages.recordings, messages.hashes, messages.publish_times))
    ordered = messages.rows(order)
    is_same = (np.diff(ordered.publish_times) == 0) & (np.diff(ordered.hashes) == 0)
    group = np.append(0, np.cumsum(~is_same))
    is_elsewhere = is_same & (np.diff(ordered.recordings) != 0)
    return order[np.isin(group, group[1:][is_elsewhere])]
