"""Writes records as rosbag2 lays splits out, one step further at a time."""

from dataclasses import dataclass, field
from pathlib import Path

from mcap.writer import CompressionType

from ros2_memory.core.timebase import NS_PER_S, WallClock
from tests.support.bags import McapLayout, Msg, mcap_content, odom, text, tf, transform
from tests.support.heartbeats import beat

SPLIT = 10 * NS_PER_S
SPLITS_IN_RECORDING = 5
DOCK = "/docked"
LAYOUT = McapLayout(
    chunk_size=4096,
    compression=CompressionType.ZSTD,
    latched=frozenset({"/tf_static", DOCK}),
)


@dataclass
class SplitWriter:
    """Writes splits that are dated from `begin` on; the newest is open."""

    bag_dir: Path
    begin: int
    opened: list[Path] = field(default_factory=list)
    rest: bytes = b""

    def step(self) -> int:
        """Opens the next split, then closes the one before it; returns its size, once closed."""
        number, nth = divmod(len(self.opened), SPLITS_IN_RECORDING)
        start = self.begin + len(self.opened) * SPLIT
        name = f"rec_{number:04d}"
        messages = [*(self.latched(start) if nth == 0 else []), *driven(self.begin, start)]
        content = mcap_content(messages, LAYOUT)
        self.tell(name)
        path = self.bag_dir / name / f"{name}_{nth}.mcap"
        path.parent.mkdir(exist_ok=True)
        # It reaches the disk in two parts, as a recorder's does.
        cut = len(content) * 6 // 10
        path.write_bytes(content[:cut])
        self.close()
        self.opened.append(path)
        self.rest = content[cut:]
        return len(content)

    def latched(self, start: int) -> list[Msg]:
        """Published once, and received again by each recording."""
        at = self.begin
        where = text(at, "home", DOCK)
        fixed = transform(at, "base_link", "laser", (0.1, 0.0, 0.2))
        return [
            Msg(DOCK, where.type, start + 1, where.body, at),
            tf(at, fixed, topic="/tf_static", log_time=start + 2),
        ]

    def close(self) -> None:
        if self.opened:
            with self.opened[-1].open("ab") as stream:
                stream.write(self.rest)
            if len(self.opened) % SPLITS_IN_RECORDING == 0:
                metadata = self.opened[-1].with_name("metadata.yaml")
                metadata.write_text("rosbag2_bagfile_information: {}\n")

    def tell(self, *recordings: str) -> None:
        beat(self.bag_dir, WallClock().now(), recordings=recordings, interval_s=3600.0)


def driven(begin: int, start: int) -> list[Msg]:
    """Ten seconds of odometry, one metre a second, and a word a second."""
    times = [start + 10 + n * NS_PER_S // 5 for n in range(50)]
    moved = [odom(at, (at - begin) / NS_PER_S, 0.0, vx=1.0) for at in times]
    return [*moved, *(text(start + 20 + n * NS_PER_S, f"word {n}") for n in range(10))]
