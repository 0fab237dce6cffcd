"""What one bag says about the map, made by the catalogue or from the bag itself."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ros2_memory.catalogue.digest import Digester
from ros2_memory.catalogue.map_digest import (
    MapDigest,
    MapSettings,
    decode_map_tracks,
    encode_map_track,
    statics_of,
)
from ros2_memory.core.model import StampedTransform, Transform
from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from ros2_memory.places.bag_statics import BagStatics
from ros2_memory.places.map_digests import MapDigests, map_settings
from tests.support.bags import odom, tf, transform, write_mcap
from tests.support.examples import examples
from tests.support.memories import extractor, memory_of, recalling
from tests.support.moving_map import BEGIN, S, write_moving_map
from tests.support.random_histories import write_history

if TYPE_CHECKING:
    from ros2_memory.catalogue.map_digest import PlacedPoses
    from ros2_memory.history.context import Memory
    from ros2_memory.messages.detections import Detection
    from ros2_memory.storage.base import Record


def digests(memory: Memory) -> list[tuple[MapDigest, MapDigest]]:
    """Of each closed bag, what the digester makes, and what a query makes of it."""
    view = View(memory, Call())
    limits = memory.limits
    digester = Digester(memory.reader, memory.extractor, map_settings(limits))
    maps, statics, found = MapDigests(view), BagStatics(view), []
    for bag in view.snapshot.timeline.bags:
        stored = digester.digest(bag.path, statics.of(bag)).in_map
        assert stored is not None
        found.append((stored, maps.made(bag)))
    return found


def assert_same(one: MapDigest, other: MapDigest) -> None:
    assert encode_map_track(one) == encode_map_track(other)
    assert one.statics == other.statics
    assert (one.own is None) == (other.own is None)
    if one.own is not None and other.own is not None:
        assert_same(one.own, other.own)


def test_the_robot_is_placed_in_a_map_that_moves(tmp_path: Path) -> None:
    truth = write_moving_map(tmp_path, 7)
    memory = memory_of(tmp_path)
    for stored, made in digests(memory):
        assert stored.frame_id == "map"
        assert stored.left_out == 0
        assert_same(stored, made)
        track = stored.track
        inside = [
            (at, place)
            for at, place in zip(truth.times, truth.places, strict=True)
            if track.times[0] <= at <= track.times[-1]
        ]
        times = np.array([at for at, _ in inside])
        places = np.array([place for _, place in inside])
        x, y = (np.interp(times, track.times, column) for column in (track.x, track.y))
        off = np.hypot(x - places[:, 0], y - places[:, 1])
        # A correction that jumps lies between two transforms, at the ends of a bag in none.
        assert np.quantile(off, 0.95) < track.error_m + 0.1


def test_without_a_map_the_robot_is_placed_in_odometry(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", [odom(BEGIN + n * S // 5, n / 10, 0.0) for n in range(50)])
    [(stored, made)] = digests(memory_of(tmp_path))
    assert_same(stored, made)
    assert (stored.frame_id, stored.left_out, stored.own) == ("odom", 0, None)
    assert stored.track.x.tolist() == pytest.approx([0.0, 4.9])


def test_poses_without_a_transform_are_left_out_and_counted(tmp_path: Path) -> None:
    messages = [odom(BEGIN + n * S, n / 10, 0.0) for n in range(10)]
    late = BEGIN + 8 * S
    messages.append(tf(late, transform(late, "map", "odom", (1.0, 0.0, 0.0))))
    write_mcap(tmp_path / "a.mcap", sorted(messages, key=lambda each: each.log_time))
    [(stored, _)] = digests(memory_of(tmp_path))
    assert (stored.frame_id, stored.left_out) == ("map", 6)
    assert stored.own is not None
    assert (stored.own.frame_id, stored.own.left_out) == ("odom", 0)
    assert stored.own.track.x.tolist() == pytest.approx([0.0, 0.9])


def test_an_entry_made_with_other_static_transforms_is_not_used(tmp_path: Path) -> None:
    def fixed(at: int, x: float) -> list[object]:
        return [transform(at, "map", "odom", (x, 0.0, 0.0))]

    def bag(number: int, *statics: float) -> None:
        begin = BEGIN + number * 10 * S
        messages = [odom(begin + n * S, 0.0, 0.0) for n in range(8)]
        messages += [tf(begin + S, *fixed(begin + S, x), topic="/tf_static") for x in statics]
        ordered = sorted(messages, key=lambda each: each.log_time)
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", ordered)

    bag(0)
    memory = recalling(memory_of(tmp_path), tmp_path)
    bag(1, 5.0)
    view = View(memory, Call())
    first, second = view.snapshot.timeline.bags
    maps = MapDigests(view)
    segment = view.snapshot.timeline.segment_of(second)
    digests = view.bags.digests_of(segment)
    assert digests is not None
    assert maps.valid_in(digests, segment) == {}
    assert maps.made(first).frame_id == "map"
    assert maps.made(first).track.x.tolist()[0] == 5.0


@settings(max_examples=examples(25), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 10_000))
def test_the_digest_is_the_same_in_the_catalogue_and_from_the_bag(seed: int) -> None:
    with TemporaryDirectory() as folder:
        write_history(Path(folder), random.Random(seed))
        memory = memory_of(Path(folder))
        view = View(memory, Call())
        known = recalling(memory, Path(folder))
        assert known.recall is not None
        fresh = View(known, Call())
        maps, again = MapDigests(view), MapDigests(fresh)
        for segment in fresh.snapshot.timeline.segments:
            digests = fresh.bags.digests_of(segment)
            assert digests is not None
            valid = again.valid_in(digests, segment)
            catalogue, numbers = known.recall.catalogue, [*valid.values()]
            stored, own = catalogue.maps(numbers), catalogue.maps(numbers, own=True)
            for bag in segment.bags:
                if bag.file in valid:
                    number, made = valid[bag.file], maps.made(bag)
                    assert_same(stored[number], replace(made, own=None))
                    assert_same(own[number], replace(made.own or made, own=None))


def test_the_order_of_static_transforms_does_not_matter() -> None:
    one, other = (
        StampedTransform("base", name, 0, 0, Transform((1, 2, 3), (0, 0, 0, 1)), static=True)
        for name in ("a", "b")
    )
    assert statics_of([one, other]) == statics_of([other, one])
    assert statics_of([one]).key != statics_of([other]).key


class Sights:
    """Counts detector messages, and notes where the camera and the robot were at the last."""

    def __init__(self) -> None:
        self.times: list[int] = []
        self.values = 0

    def wants(self, topic: str, type_name: str) -> bool:
        return "Detection" in type_name and topic.startswith("/vision")

    def add(self, record: Record, detections: tuple[Detection, ...] | None) -> None:
        self.times.append(record.log_time)
        self.values += detections is not None

    def digest(self, robot: PlacedPoses) -> bytes:
        times = np.array(self.times, np.int64)
        cameras = robot.frames.poses("cam", times)
        assert cameras is not None
        assert cameras.valid.all()
        at = robot.at(times)
        off = np.hypot(cameras.translation[0] - at.x, cameras.translation[1] - at.y)
        assert off[at.valid] == pytest.approx(np.full(at.valid.sum(), 0.2), abs=0.05)
        return f"{len(times)}".encode()


def test_sights_are_collected_with_frames_and_stored(tmp_path: Path) -> None:
    write_moving_map(tmp_path, 3, seconds=20)
    memory = memory_of(tmp_path)
    view = View(memory, Call())
    digester = Digester(memory.reader, extractor(), MapSettings(), Sights)
    for bag in view.snapshot.timeline.bags:
        statics = BagStatics(view).of(bag)
        stored = digester.digest(bag.path, statics).in_map
        assert stored is not None
        assert stored.sights == b"10"
        assert MapDigests(view).made(bag, Sights()).sights == b"10"


def test_a_map_digest_that_is_stored_is_the_same(tmp_path: Path) -> None:
    write_moving_map(tmp_path, 5, seconds=10)
    [(stored, _)] = digests(memory_of(tmp_path))
    packed = [(encode_map_track(stored), stored.statics)]
    [again] = decode_map_tracks(packed)
    assert_same(replace(stored, own=None), again)
    assert replace(again, track=stored.track, own=stored.own) == stored
    assert stored.own is not None
    [own] = decode_map_tracks(packed, own=True)
    assert_same(stored.own, own)
    assert math.isclose(again.track.error_m, stored.track.error_m)
