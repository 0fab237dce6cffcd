"""Bag files of plain text, and a reader for them: for tests of what surrounds a bag's content.

A file is `BAG`, a line `topic type log_time` for each message or `topic type -` for a topic without
any, and `END` once it is closed.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from ros2_memory.core.bag_summary import BagSummary, SummarySchema, TopicSummary
from ros2_memory.core.errors import BagError, BagVanishedError
from ros2_memory.storage.mcap_reader import McapReader


def plain(
    path: Path,
    times: Iterable[int] = (),
    *,
    topic: str = "/odom",
    silent: Iterable[str] = (),
    closed: bool = True,
) -> Path:
    """Writes one bag; without `closed` as a recorder leaves it that was killed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["BAG", *(f"{topic} nav_msgs/msg/Odometry {time}" for time in times)]
    lines += [f"{name} nav_msgs/msg/Odometry -" for name in silent]
    path.write_text("\n".join([*lines, "END" if closed else ""]))
    return path


def grow(path: Path, *times: int) -> None:
    """Appends messages to an open bag, as its recorder does."""
    with path.open("a") as stream:
        stream.writelines(f"/odom nav_msgs/msg/Odometry {time}\n" for time in times)


def close(path: Path) -> None:
    """Closes an open bag in place."""
    with path.open("a") as stream:
        stream.write("END")


class PlainReader(McapReader):
    """Reads plain bags but their messages, and counts by file name what it was asked for."""

    def __init__(self, *kinds: str) -> None:
        super().__init__()
        self.kinds = kinds or (".mcap",)
        self.closings: Counter[str] = Counter()
        self.summaries: Counter[str] = Counter()
        self.before_summary: Callable[[Path], object] = bool

    def reads(self, path: Path) -> bool:
        return path.name.endswith(self.kinds)

    def is_finished(self, path: Path) -> bool:
        self.closings[path.name] += 1
        text = _text(path)
        left_open = text.startswith("BAG") and not text.endswith("END")
        return not left_open

    def summarize(self, path: Path) -> BagSummary:
        self.summaries[path.name] += 1
        self.before_summary(path)
        text = _text(path)
        if not text.startswith("BAG"):
            raise BagError(str(path), "the file is empty" if not text else "not a bag")
        times: dict[tuple[str, str], list[int]] = {}
        for line in text.splitlines()[1:]:
            if line not in {"END", ""}:
                topic, type_name, time = line.split()
                heard = times.setdefault((topic, type_name), [])
                heard.extend([] if time == "-" else [int(time)])
        return BagSummary.packed(
            tuple(
                TopicSummary(topic, kind, "cdr", len(at), min(at), max(at), topic == "/tf_static")
                for (topic, kind), at in times.items()
                if at
            ),
            SummarySchema(
                silent=tuple(topic for (topic, _), at in times.items() if not at),
                complete=text.endswith("END"),
            ),
        )


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except FileNotFoundError as error:
        raise BagVanishedError(str(path), "it is gone") from error
    except OSError as error:
        raise BagError(str(path), f"cannot be opened: {error.strerror}") from error
