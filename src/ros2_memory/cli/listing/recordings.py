"""`ros2-memory recordings`: every recording of a folder, with its time, size and maker."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import typer

from ros2_memory.bag_dir.layout import MOMENTS_FOLDER, bag_kind
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.cli.options import (
    EXIT_NEGATIVE,
    MB,
    AsJson,
    Bags,
    print_line,
    stdout_console,
)
from ros2_memory.cli.output import print_reply
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.model import BagFile, BagState, JsonValue
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.index.recordings import name_of, recordings_of
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import nothing_here

_OWN = "this recorder"
_OTHERS = "another recorder"
_MOMENT = "saved moment"
_EMPTY = "no message was recorded"


def recordings(
    as_json: AsJson = False,
    *,
    bags: Bags,
) -> None:
    """List every recording of a folder: start, length, size, and which program made it.

    To use one of them only, give --recording NAME to the other commands, or data.recording=NAME to
    the server.
    """
    memory = bags.memory()
    snapshot, root = memory.index.snapshot(), memory.index.bag_dir
    rows = [*_rows(snapshot, root)]
    empty: list[JsonValue] = [*_empty_rows(snapshot, root)]
    if as_json:
        print_line(json.dumps([*rows, *empty]))
    elif rows:
        console = stdout_console()
        with_messages = [row for row in rows if "start" in row]
        left_out = {"end"}  # there is the length
        if all(row["whose"] == _OTHERS for row in with_messages):
            left_out.add("whose")
        print_reply(
            console,
            [{key: row[key] for key in row if key not in left_out} for row in with_messages],
        )
        if with_messages and "whose" in left_out:
            print_line(f"whose: {_OTHERS} made all of them")
        others: list[JsonValue] = [row for row in rows if "start" not in row]
        if others:
            print_reply(console, {"not_read": others})
        if empty:
            print_reply(console, {"empty": empty})
    else:
        print_line(f"{root}: {snapshot.problem or nothing_here(snapshot)}")
    if not rows:
        raise typer.Exit(EXIT_NEGATIVE)


def _rows(snapshot: Snapshot, root: Path) -> Iterator[dict[str, JsonValue]]:
    own = _own_recordings(root)
    left = {str(each.path): each.reason for each in (*snapshot.damaged, *snapshot.unread)}
    found = sorted(recordings_of(snapshot).items(), key=lambda each: each[1][0].start)
    for path, bags in found:
        inside = [file for file in left if file.startswith(f"{path}/")]
        row = _row(name_of(path, bags, str(root)), bags)
        row["whose"] = _maker(Path(path), bags, root, own)
        if inside:
            row["not_read"] = len(inside)
        for file in inside:
            del left[file]
        yield row
    for file, reason in sorted(left.items()):
        name = file.removeprefix(f"{root}/")
        yield {"recording": name, "reason": reason}


def _empty_rows(snapshot: Snapshot, root: Path) -> Iterator[dict[str, JsonValue]]:
    """Yields the recordings without any message; a loose bag file is one."""
    aside = (*snapshot.active, *snapshot.damaged, *snapshot.unread)
    folders = {bag.path.parent for bag in snapshot.bags} | {each.path.parent for each in aside}
    found = [each if each.parent == root else each.parent for each in snapshot.empty]
    for path in dict.fromkeys(each for each in found if each not in folders):
        yield {"recording": str(path).removeprefix(f"{root}/"), "messages": 0, "reason": _EMPTY}


def _row(name: str, bags: Sequence[BagFile]) -> dict[str, JsonValue]:
    start, end = min(bag.start for bag in bags), max(bag.end for bag in bags)
    topics = {topic for bag in bags for topic in bag.summary.schema.positions}
    is_open = any(bag.state is BagState.ACTIVE for bag in bags)
    return {
        "recording": name,
        "start": unix_from_ns(start),
        "end": None if is_open else unix_from_ns(end),
        "length_s": round(unix_from_ns(end - start), 3),
        "size_mb": round(sum(bag.size for bag in bags) / MB, 3),
        "bags": len(bags),
        "messages": sum(bag.summary.count for bag in bags),
        "topics": len(topics),
        "storage": ", ".join(sorted({(bag_kind(bag.path.name) or "")[1:] for bag in bags})),
    }


def _own_recordings(root: Path) -> OwnRecordings | None:
    """Returns which recordings this program made; None where that cannot be known."""
    try:
        return OwnRecordings(root)
    except (OSError, RecorderError):
        return None


def _maker(path: Path, bags: Sequence[BagFile], root: Path, own: OwnRecordings | None) -> JsonValue:
    if path.is_relative_to(root / MOMENTS_FOLDER):
        return _MOMENT
    if own is None:
        return None
    return _OWN if own.owns_bag(bags[0].path) else _OTHERS
