"""`.episodic/deleted.jsonl`: what retention deleted, so that nobody calls it lost or unrecorded.

The recorder appends a line for each recording before it deletes splits of it. A line is only asked
about what is not there, so one whose deletion failed hides nothing. Once the file is too long it is
written again: a line for each recording that is still there, and one for all that have gone, whose
files nothing lists any more. Lines of other versions, and a last line that a crash cut short, are
ignored.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from pydantic import TypeAdapter

from ros2_memory.bag_dir.durable_write import append_durably, open_plain, write_durably
from ros2_memory.bag_dir.json_fields import Int64, json_object, validated
from ros2_memory.bag_dir.layout import DELETED_FILE
from ros2_memory.core import directories
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

_MOST_BYTES: Final = 1 << 18
_MOST_SPANS: Final = 1000
_APART_NS: Final[Ns] = 20 * NS_PER_S
"""From one split of a recording to the next no message may come for so long."""
_TOUCHING_NS: Final[Ns] = NS_PER_S
"""From one recording to the next."""
_LONGEST_NS: Final[Ns] = 86_400 * NS_PER_S
"""The clock was set within a split that lasts for longer: it shows nothing."""


@dataclass(frozen=True, slots=True)
class Deleted:
    """What was deleted of a recording (its path below the bag directory); "" for some.

    `files` are the names of its splits, without the suffix of compression; `spans` the log times
    (half-open) of their first and last messages, joined.
    """

    recording: str
    files: tuple[str, ...] = ()
    spans: tuple[tuple[Int64, Int64], ...] = ()


_DELETED: Final = TypeAdapter(Deleted)


def deleted_of(recording: str, splits: Iterable[tuple[str, Ns, Ns]]) -> Deleted:
    """Returns the entry for splits of a recording: each its name, first and last log time."""
    named = [*splits]
    spans = [(first, last + 1) for _, first, last in named if 0 <= last - first <= _LONGEST_NS]
    return Deleted(recording, tuple(name for name, _, _ in named), _joined(spans, _APART_NS))


def append_deleted(bag_dir: Path, deleted: Iterable[Deleted]) -> None:
    """Appends durably what is about to be deleted, and shortens a file that is too long.

    Raises:
        OSError: the file cannot be written.
    """
    target = bag_dir / DELETED_FILE
    directories.make(bag_dir, target.parent)
    append_durably(target, "".join(map(_line, deleted)))
    if target.stat().st_size <= _MOST_BYTES:
        return
    known = read_deleted(bag_dir)
    there = {name for name in known if name and (bag_dir / name).is_dir()}
    gone = (span for name, each in known.items() if name not in there for span in each.spans)
    text = _line(Deleted("", (), _joined(gone, _TOUCHING_NS)[-_MOST_SPANS:]))
    # The last line of a recording is the newest, so its oldest entries come first.
    for line in reversed([_line(known[name]) for name in known if name in there]):
        if len(text) + len(line) > _MOST_BYTES // 2:
            break
        text += line
    write_durably(target, text)


def read_deleted(bag_dir: Path) -> Mapping[str, Deleted]:
    """Returns what was deleted, by recording; nothing where there is no file, or it is damaged."""
    path = bag_dir / DELETED_FILE
    try:
        status = path.lstat()
        return _parsed(path, (status.st_ino, status.st_mtime_ns, status.st_size))
    except (OSError, ValueError):
        return {}


def deleted_spans(bag_dir: Path) -> Sequence[tuple[Ns, Ns]]:
    """Returns the log times (half-open) of all that was deleted, sorted and apart."""
    every = (span for each in read_deleted(bag_dir).values() for span in each.spans)
    return _joined(every, _TOUCHING_NS)


# Asked for by every answer; the key says when the file has changed.
@lru_cache(2)
def _parsed(path: Path, _stamp: tuple[int, int, int]) -> Mapping[str, Deleted]:
    with open_plain(path) as stream:
        lines = stream.read(4 * _MOST_BYTES).decode(errors="replace").splitlines()
    files: dict[str, dict[str, None]] = {}
    spans: dict[str, list[tuple[Ns, Ns]]] = {}
    for line in lines:
        try:
            each = validated(_DELETED, json_object(line))
        except (ValueError, RecursionError):
            continue
        files.setdefault(each.recording, {}).update(dict.fromkeys(each.files))
        spans.setdefault(each.recording, []).extend(each.spans)
    return {
        name: Deleted(name, tuple(known), _joined(spans[name], _APART_NS if name else _TOUCHING_NS))
        for name, known in files.items()
    }


def _joined(spans: Iterable[tuple[Ns, Ns]], apart: Ns) -> tuple[tuple[Ns, Ns], ...]:
    """Returns spans, sorted; those that are no further apart than this are joined."""
    wider = united((start, stop + apart) for start, stop in spans)
    return tuple((start, stop - apart) for start, stop in wider)


def _line(deleted: Deleted) -> str:
    return f"{json.dumps(asdict(deleted))}\n"
