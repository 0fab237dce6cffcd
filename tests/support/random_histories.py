"""Histories of a robot with everything odd that bags can have, drawn at random."""

import json
import math
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from random import Random

from mcap.exceptions import McapError
from mcap.writer import Writer

from ros2_memory.bag_dir.handover_file import Handover, Overlap, write_handover
from ros2_memory.recorder.handover import settle_handover
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import (
    McapLayout,
    Msg,
    battery,
    boolean,
    command,
    detections,
    diagnostics,
    goals,
    log_entry,
    odom,
    text,
    tf,
    transform,
    write_mcap,
)
from tests.support.mcap_surgery import spoil_chunk

S = 10**9
MS = 10**6
LATCHED = frozenset({"/tf_static", "/dock"})
WORDS = ("cup", "Person 2", "red-chair", "scissors", "straße", "--")
FOREIGN = "nobody_msgs/msg/Unknown"


@dataclass
class Written:
    """What lies in a folder: all moments that something happened, for questions to aim at."""

    moments: list[int] = field(default_factory=list)


@dataclass
class _Robot:
    """What is published, before any recorder stamps it."""

    draw: Random
    tick: int
    latched: list[Msg] = field(default_factory=list)

    def between(self, start: int, stop: int) -> list[Msg]:
        messages = [self._message(at) for at in self._moments(start, stop)]
        self.latched += [each for each in messages if each.topic in LATCHED]
        return messages

    def _moments(self, start: int, stop: int) -> list[int]:
        count = self.draw.randint(2, 14)
        return sorted(
            self.draw.randrange(start, stop) // self.tick * self.tick for _ in range(count)
        )

    def _message(self, at: int) -> Msg:  # noqa: PLR0911 - one for each kind
        draw = self.draw
        kind = draw.randrange(14)
        x = draw.choice([draw.uniform(-2, 2), draw.uniform(-2, 2), math.nan, 80.0])
        if kind < 4:
            return odom(at, x, draw.uniform(-1, 1), draw.uniform(-3, 3), vx=draw.choice([0.0, 0.4]))
        if kind == 4:
            child = draw.choice(["base_link", "arm"])
            return tf(at, transform(at - draw.choice([0, 900 * S]), "odom", child, (x, 0.0, 0.0)))
        if kind == 5:
            parts = [transform(at, "base_link", name, (x, 0, 0)) for name in ("laser", "cam")]
            return tf(at, *parts[: draw.randint(1, 2)], topic="/tf_static")
        if kind == 6:
            return text(at, draw.choice(["docked", "undocked"]), "/dock")
        if kind == 7:
            topic = draw.choice(["/vision/a", "/vision/b"])
            labels = draw.sample(WORDS, draw.randint(0, 3))
            return detections(
                at,
                labels,
                topic=topic,
                at=(x, 0.5, draw.choice([0.0, 1.0])),
                score=at // 1000 % 10 / 10,
            )
        if kind == 8:
            return boolean(at, draw.random() < 0.5)
        if kind == 9:
            body = draw.choice([text(at, "cup"), boolean(at, True)])
            return replace(body, topic="/mixed")
        if kind > 11:
            return _state(at, draw)
        if kind == 10 and draw.random() < 0.3:
            broken = b"\x00\x01\x00\x00\xff\xff\xff\x7f"
            return Msg("/chatter", "std_msgs/msg/String", at, broken)
        return text(at, draw.choice(WORDS), "/chatter")


def _state(at: int, draw: Random) -> Msg:
    """What explains why a robot stopped."""
    kind = draw.randrange(5)
    if kind == 0:
        return log_entry(at, draw.choice([20, 30, 40]), "planner", draw.choice(["no way", "9 s"]))
    if kind == 1:
        names = draw.sample(["motor", "camera"], draw.randint(1, 2))
        return diagnostics(at, **{name: (draw.randrange(3), "hot") for name in names})
    if kind == 2:
        numbers = draw.sample([1, 2, 3], draw.randint(0, 2))
        return goals(at, {number: draw.choice([1, 2, 4, 6]) for number in numbers})
    if kind == 3:
        return battery(at, draw.choice([math.nan, 0.9, 0.15, 0.04]))
    return command(at, draw.choice([0.0, 0.3]), draw.choice([0.0, -0.0, 0.5]))


def write_history(bag_dir: Path, draw: Random, tick: int = MS) -> Written:
    """Recordings of one robot, one after another or overlapping, some of them ended badly.

    With a long `tick` many messages share a log time, as with a simulated clock.
    """
    written = Written()
    robot = _Robot(draw, tick)
    now = draw.choice([0, 1_700_000_000 * S])
    before: tuple[str, list[Msg]] | None = None
    for number in range(draw.randint(1, 4)):
        name = f"rec_{number}"
        stop = now + draw.choice([3 * S, 25 * S])
        fresh = robot.between(now, stop)
        again = [_again(each, now) for each in robot.latched if each not in fresh]
        arrived = [*(again if draw.random() < 0.8 else ()), *fresh]
        if before is not None and draw.random() < 0.6:
            arrived += [shifted(each, draw.randint(10_000, 900_000)) for each in before[1][-6:]]
            if draw.random() < 0.4:
                _hand_over(bag_dir, before[0], name, now)
                # The recorder before stalled: it missed these.
                missed = [
                    each
                    for each in robot.between(min(before[1][0].log_time, now - S), now)
                    if each.topic not in LATCHED
                ]
                arrived += [shifted(each, draw.randint(10_000, 900_000)) for each in missed]
        _write_recording(bag_dir / name, arrived, draw)
        if before is not None:
            settle_handover(bag_dir / before[0], bag_dir / name, McapReader())
        written.moments += [each.log_time for each in arrived]
        before = (name, fresh)
        now = stop + draw.choice([0, 0, -S, 60 * S])
    if draw.random() < 0.5:
        written.moments += _write_json(bag_dir / "json" / "json_0.mcap", now, draw)
    if draw.random() < 0.3:
        (bag_dir / "bad").mkdir()
        (bag_dir / "bad" / "bad_0.mcap").write_bytes(b"not a bag, however long it may be")
    _spoil(bag_dir, draw)
    return written


def _spoil(bag_dir: Path, draw: Random) -> None:
    """Time does its work: a split is lost, a chunk of another is overwritten, a clock is wrong."""
    splits = sorted(bag_dir.glob("rec_*/*.mcap"))
    if draw.random() < 0.3:
        draw.choice(splits).write_bytes(b"this was a split once, and is none any more")
    if draw.random() < 0.2:
        with suppress(IndexError, OSError, ValueError, McapError):
            spoil_chunk(draw.choice(splits), 0)
    if draw.random() < 0.2:
        start = draw.choice([40 * S, 2**61])
        wrong = [odom(40 * S, n, 0.0, log_time=start + n * S) for n in range(3)]
        write_mcap(bag_dir / "wrong" / "wrong_0.mcap", wrong)


def _again(message: Msg, at: int) -> Msg:
    """A latched message as a later recording receives it."""
    return shifted(message, max(0, at - message.log_time))


def shifted(message: Msg, by: int) -> Msg:
    """A message as a recording that overlaps logged it."""
    return replace(message, log_time=message.log_time + by, publish_time=message.published)


def _hand_over(bag_dir: Path, before: str, after: str, cut: int) -> None:
    files = tuple(f"{before}_{n}.mcap" for n in range(3))
    write_handover(
        bag_dir / before,
        Handover(next=after, counts_until=cut, end=Overlap(None, None, files)),
    )
    (bag_dir / after).mkdir()
    files = (f"{after}_0.mcap",)
    write_handover(
        bag_dir / after,
        Handover(
            previous=before, counts_from=cut, begin=Overlap(None, None, files), compared=False
        ),
    )


def _write_recording(folder: Path, messages: list[Msg], draw: Random) -> None:
    ordered = sorted(messages, key=lambda each: each.log_time)
    cuts = sorted(draw.randrange(len(ordered) + 1) for _ in range(draw.randint(0, 2)))
    edges = [0, *cuts, len(ordered)]
    splits = [ordered[begin:end] for begin, end in pairwise(edges)]
    for number, split in enumerate(splits):
        if draw.random() < 0.3:
            draw.shuffle(split)
        left_open = number == len(splits) - 1 and draw.random() < 0.3
        layout = McapLayout(
            chunk_size=draw.choice([300, 4000]) if not left_open else 300,
            finish=not left_open,
            latched=LATCHED,
        )
        declared = [("/silent", "std_msgs/msg/String")]
        write_mcap(folder / f"{folder.name}_{number}.mcap", split, layout, declared=declared)


def _write_json(path: Path, now: int, draw: Random) -> list[int]:
    """A bag with a JSON topic, a topic of an unknown type, and log times that go back."""
    path.parent.mkdir()
    moments = [now + draw.randrange(20) * S for _ in range(draw.randint(1, 6))]
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=400)
        writer.start(profile="", library="test")
        json_schema = writer.register_schema("status", "jsonschema", b"{}")
        unknown = writer.register_schema(FOREIGN, "", b"")
        status = writer.register_channel("/status", "json", json_schema)
        foreign = writer.register_channel("/foreign", "cdr", unknown)
        for at in moments:
            value = {
                "state": draw.choice(WORDS),
                "battery": draw.choice([1, 0.5, True, None]),
                "position": {"x": draw.uniform(-1, 1), "y": 0},
                "goal": {"x": draw.choice([1, 2]), "y": 3},
                "tags": draw.sample([1, 2, "cup", False], 2),
            }
            writer.add_message(status, at, json.dumps(value).encode(), at)
            writer.add_message(foreign, at, b"\x00\x01\x00\x00abc", at)
        writer.finish()
    return moments
