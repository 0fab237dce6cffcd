"""The good bags that mutants are made of, one of every kind that is read, and two neighbours."""

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import zstandard
from mcap.writer import CompressionType, Writer

from ros2_memory.core.model import BAG_KINDS
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import (
    McapLayout,
    Msg,
    boolean,
    detections,
    header,
    make,
    odom,
    text,
    tf,
    tf_of,
    transform,
    write_db3,
    write_mcap,
)
from tests.support.reader_cases import LAYOUTS
from tests.support.shared_bags import REAL, RECORDED

BASE_S = 1_784_023_200
LENGTH_S = 3
BEFORE_S = BASE_S - 100
AFTER_S = BASE_S + 100
TOPICS = ("/odom", "/tf", "/tf_static", "/chatter", "/bumper", "/scan", "/seen", "/json")
_LARGEST_SHARED = 120_000
_DATA = Path(__file__).resolve().parents[1] / "data"


@dataclass(frozen=True)
class Good:
    """A bag of one kind. `plain` is its content, before a compression of the whole file."""

    kind: str
    suffix: str
    plain: bytes

    @property
    def is_mcap(self) -> bool:
        return self.suffix.startswith(".mcap")

    @property
    def whole(self) -> bytes:
        """The file itself."""
        return self.packed(self.plain)

    def packed(self, plain: bytes) -> bytes:
        """A content as the file would hold it."""
        return zstandard.compress(plain) if self.suffix.endswith(".zstd") else plain

    @property
    def needs_rosbag2(self) -> bool:
        return self.suffix != ".mcap"


@cache
def run_of(start_s: int, *, prefix: str = "", frames: str = "", hz: int = 10) -> tuple[Msg, ...]:
    """A few seconds of a robot: what topics and types a bag holds, it holds of all kinds."""
    messages = [
        tf_of(
            start_s * NS_PER_S,
            f"{frames}base",
            f"{frames}laser",
            (0.2, 0.0, 0.1),
            topic="/tf_static",
        )
    ]
    for step in range(LENGTH_S * hz):
        at = start_s * NS_PER_S + step * NS_PER_S // hz
        messages.append(
            odom(at, math.sin(step / 9), step / 20, 0.1 * step, vx=0.5, topic=f"{prefix}/odom")
        )
        moved = transform(at, f"{frames}odom", f"{frames}base", (step / 20, 0.0, 0.0), 0.1)
        messages.append(tf(at + 1, moved))
        if step % 3 == 0:
            messages.append(text(at + 2, f"step {step} of a way", f"{prefix}/chatter"))
            messages.append(boolean(at + 3, step % 2 == 0, f"{prefix}/bumper"))
        if step % 5 == 0:
            labels = ["cup", "scissors"][: 1 + step % 2]
            messages.append(detections(at + 4, labels, topic=f"{prefix}/seen"))
            messages.append(_scan(at + 5, f"{prefix}/scan"))
    return tuple(messages)


def _scan(at: int, topic: str) -> Msg:
    ranges = np.linspace(0.5, 5.0, 40, dtype=np.float32)
    body = make(
        "sensor_msgs/msg/LaserScan",
        header=header(at, "laser"),
        angle_min=-1.0,
        angle_max=1.0,
        angle_increment=0.05,
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.1,
        range_max=9.0,
        ranges=ranges,
        intensities=ranges[:0],
    )
    return Msg(topic, "sensor_msgs/msg/LaserScan", at, body)


def with_packed_payloads(messages: Iterable[Msg]) -> list[Msg]:
    """The messages as rosbag2's message compression writes them."""
    return [replace(each, body=zstandard.compress(each.payload)) for each in messages]


def write_json(path: Path) -> None:
    """JSON messages, some deep, beside a CDR topic's worth of nothing."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=500)
        writer.start(profile="", library="test")
        schema = writer.register_schema("Thing", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/json", "json", schema)
        for step in range(LENGTH_S * 10):
            at = BASE_S * NS_PER_S + step * NS_PER_S // 10
            value = {"x": step, "y": -step, "name": f"thing {step}", "deep": [[{"z": step}]]}
            writer.add_message(channel, at, json.dumps(value).encode(), at)
        writer.finish()


@cache
def neighbours() -> dict[str, bytes]:
    """Two good bags by their place in the bag directory; nothing of them is in any mutant."""
    layout = McapLayout(chunk_size=2000, compression=CompressionType.ZSTD)
    return {
        f"near_{name}/near_{name}_0.mcap": _written(
            ".mcap",
            lambda path, at=at: write_mcap(  # type: ignore[misc]
                path, run_of(at, prefix="/near", frames="near_"), layout
            ),
        )
        for name, at in (("before", BEFORE_S), ("after", AFTER_S))
    }


@cache
def goods() -> tuple[Good, ...]:
    """One good bag of every kind."""
    messages = run_of(BASE_S)
    found = [_mcap(name, layout, messages) for name, layout in LAYOUTS.items()]
    killed = McapLayout(chunk_size=2000, compression=CompressionType.ZSTD, finish=False)
    found.append(_mcap("left open", killed, messages))
    found.append(_mcap("packed payloads", LAYOUTS["small chunks"], with_packed_payloads(messages)))
    found.append(Good("json", ".mcap", _written(".mcap", write_json)))
    found.append(Good("mcap.zstd", ".mcap.zstd", found[0].plain))
    db3 = Good("db3", ".db3", _written(".db3", lambda path: write_db3(path, messages)))
    packed = with_packed_payloads(messages)
    found += [
        db3,
        Good("db3.zstd", ".db3.zstd", db3.plain),
        Good(
            "db3 without definitions",
            ".db3",
            _written(".db3", lambda path: write_db3(path, messages, definitions=False)),
        ),
        Good("db3 packed payloads", ".db3", _written(".db3", lambda path: write_db3(path, packed))),
    ]
    return (*found, *_from(_DATA), *_from(RECORDED), *_from(REAL))


def mcaps() -> tuple[Good, ...]:
    """The good MCAP bags, also those compressed as a whole."""
    return tuple(good for good in goods() if good.is_mcap)


def sqlites() -> tuple[Good, ...]:
    """The good sqlite bags, also those compressed as a whole."""
    return tuple(good for good in goods() if not good.is_mcap)


def _mcap(name: str, layout: McapLayout, messages: Iterable[Msg]) -> Good:
    return Good(name, ".mcap", _written(".mcap", lambda path: write_mcap(path, messages, layout)))


def _written(suffix: str, write: Callable[[Path], object]) -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"bag{suffix}"
        write(path)
        return path.read_bytes()


def _from(folder: Path) -> list[Good]:
    """The small bags of real robots, where they are."""
    found = [
        _from_file(path, suffix)
        for path in (sorted(folder.rglob("*")) if folder.is_dir() else ())
        for suffix in BAG_KINDS
        if path.name.endswith(suffix) and 0 < path.stat().st_size <= _LARGEST_SHARED
    ]
    return [each for each in found if each is not None]


def _from_file(path: Path, suffix: str) -> Good | None:
    data = path.read_bytes()
    if suffix.endswith(".zstd"):
        try:
            data = zstandard.ZstdDecompressor().decompressobj().decompress(data)
        except zstandard.ZstdError:
            return None
    return Good(f"{path.parent.name}/{path.name}", suffix, data)
