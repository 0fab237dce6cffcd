"""Bags are digested before the static transforms of all are read; in the end as if they were."""

from __future__ import annotations

import random
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.catalogue.detector_sights import DetectorSights
from ros2_memory.catalogue.digest import Digester
from ros2_memory.catalogue.digest_config import DigestConfig
from ros2_memory.catalogue.lookup import DigestCache
from ros2_memory.catalogue.store import FILE, FOLDER, Catalogue
from ros2_memory.cli.maintenance.index import fill_catalogue
from ros2_memory.columns.store import BagKey
from ros2_memory.core.model import TimeWindow
from ros2_memory.places.map_digests import map_settings
from ros2_memory.serving import backfill as serving_backfill
from ros2_memory.serving.backfill import Backfill
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import odom, tf, transform, write_mcap
from tests.support.examples import examples
from tests.support.memories import memory_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from ros2_memory.storage.base import Record

S = 10**9
T0 = 1_700_000_000 * S
STATIC = "/tf_static"


class Noting(BagDirReader):
    """Knows of which bags static transforms alone were read, in order."""

    def __init__(self, bag_dir: Path) -> None:
        super().__init__(McapReader(), bag_dir)
        self.static: list[str] = []

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        if [*topics] == [STATIC]:
            self.static.append(path.name)
        return super().records(path, topics, window, newest_first=newest_first)


def backfill_of(bag_dir: Path, catalogue: str, reader: BagDirReader | None = None) -> Backfill:
    memory = memory_of(bag_dir, reader=reader or BagDirReader(McapReader(), bag_dir))
    path = bag_dir / FOLDER / catalogue / FILE
    memory = replace(memory, recall=DigestCache(Catalogue([path], DigestConfig("test")), bag_dir))
    sights = partial(DetectorSights, memory.reader, memory.extractor)
    digester = Digester(memory.reader, memory.extractor, map_settings(memory.limits), sights)
    return Backfill(memory, digester, bag_dir)


def placed(backfill: Backfill, bag_dir: Path) -> dict[str, tuple[int, bytes]]:
    """Returns what a catalogue has of the robot in the map, by bag."""
    catalogue = backfill.catalogue
    files = catalogue.known_files(bag_dir)
    numbers = catalogue.find([BagKey.of(bag, bag_dir) for bag in files.values()])
    found = [number for number in numbers if number is not None]
    sights = catalogue.sights(found)
    return {file: sights[number] for file, number in zip(files, found, strict=True)}


def write_bag(bag_dir: Path, recording: str, number: int, statics: dict[str, float]) -> None:
    at = T0 + number * 10 * S
    messages = [odom(at + n * S, n / 10, 0.0) for n in range(9)]
    messages += [
        tf(at + S // 2, transform(at, "map", child, (x, 0.0, 0.0)), topic=STATIC)
        for child, x in statics.items()
    ]
    messages += [
        tf(at + n * S, transform(at + n * S, "odom", "base_link", (n, 0, 0))) for n in range(9)
    ]
    messages.sort(key=lambda each: each.log_time)
    write_mcap(bag_dir / recording / f"{recording}_{number}.mcap", messages)


def write_bags(bag_dir: Path, draw: random.Random, bags: int) -> None:
    """Writes recordings that follow each other; some hand over to the next.

    Some static transforms are in each bag, some in few; some change, by much or by hardly anything.
    """
    values = {"odom": 0.0, "camera": 0.0, "laser": 0.0}
    often = {child: draw.choice([0.0, 0.2, 1.0]) for child in values}
    recordings = 0
    for number in range(bags):
        if number and draw.random() < 0.2:
            recordings += 1
            if draw.random() < 0.7:
                write_handover(
                    bag_dir / f"rec_{recordings - 1}", Handover(next=f"rec_{recordings}")
                )
        for child in values:
            values[child] += draw.choices([0.0, 1e-12, 0.5], [8, 1, 1])[0]
        held = {child: x for child, x in values.items() if draw.random() < often[child]}
        write_bag(bag_dir, f"rec_{recordings}", number, held)


@settings(max_examples=examples(30), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 10_000))
def test_what_was_guessed_is_in_the_end_as_if_all_static_transforms_were_read_first(
    seed: int,
) -> None:
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        bag_dir, draw = Path(folder), random.Random(seed)
        write_bags(bag_dir, draw, draw.randint(2, 12))
        read_first = backfill_of(bag_dir, "read_first")
        for bag in read_first.waiting():
            assert read_first.digest(bag)
        patch.setattr(serving_backfill, "MOST_READ", draw.randint(0, 3))
        guessed = backfill_of(bag_dir, "guessed")
        assert fill_catalogue(guessed).waiting == 0
        assert placed(guessed, bag_dir) == placed(read_first, bag_dir)
        assert guessed.waiting() == read_first.waiting() == []


def test_the_newest_bag_is_digested_before_the_static_transforms_of_others_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving_backfill, "MOST_READ", 4)
    for number in range(20):
        write_bag(tmp_path, "rec", number, {"odom": 1.0})
    reader = Noting(tmp_path)
    backfill = backfill_of(tmp_path, "one", reader)
    newest, before, *_ = backfill.waiting(guesses=True)
    assert backfill.digest(newest)
    assert reader.static == ["rec_0.mcap", "rec_19.mcap"]
    assert backfill.digest(before)
    assert reader.static == ["rec_0.mcap", "rec_19.mcap", "rec_18.mcap"]
    assert fill_catalogue(backfill).waiting == 0
    # Those that the catalogue has are not read again.
    assert reader.static[1:] == [f"rec_{number}.mcap" for number in range(19, -1, -1)]
    assert len({key for key, *_ in placed(backfill, tmp_path).values()}) == 1


def test_bags_whose_static_transforms_were_guessed_wrong_are_digested_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving_backfill, "MOST_READ", 2)
    for number in range(8):
        # Moved in the middle, and published then alone.
        write_bag(tmp_path, "rec", number, {0: {"odom": 1.0}, 3: {"odom": 2.0}}.get(number, {}))
    backfill = backfill_of(tmp_path, "one")
    for bag in backfill.waiting(guesses=True)[:6]:
        assert backfill.digest(bag)
    assert [bag.path.name for bag in backfill.waiting(guesses=True)] == [
        f"rec_{number}.mcap" for number in (7, 6, 5, 4, 1, 0)
    ]
    assert fill_catalogue(backfill).waiting == 0


def test_without_guesses_those_with_other_static_transforms_wait_from_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving_backfill, "MOST_READ", 2)
    for number in range(8):
        write_bag(tmp_path, "rec", number, {})
    backfill = backfill_of(tmp_path, "one")
    fill_catalogue(backfill)
    for number in range(8, 12):
        write_bag(tmp_path, "rec", number, {"odom": 1.0} if number == 8 else {})
    assert len(backfill.waiting(guesses=True)) == 4
    assert len(backfill.waiting()) == 12
