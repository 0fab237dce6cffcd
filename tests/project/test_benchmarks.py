"""The benchmark: its worlds are what it says, and are asked as a server is. No time is judged."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from benchmarks import plain, questions, worlds
from benchmarks.__main__ import main
from benchmarks.payloads import typestore
from benchmarks.questions import NEVER
from rosbags.rosbag2 import Reader

from tests.support.shared_bags import needs_real, needs_recorded

if TYPE_CHECKING:
    from pathlib import Path

SEED = 0xC0FFEE
KINDS = {worlds.HOME: 1, worlds.SPLITS: 12}


@pytest.fixture(scope="module")
def splits(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return worlds.made(worlds.SPLITS, SEED, 12, tmp_path_factory.mktemp("worlds"))


def test_a_world_of_splits_has_the_stated_messages_and_one_that_the_power_ended(
    splits: Path,
) -> None:
    counts = []
    for bag in plain.bags_of(splits):
        with Reader(bag.path) as reader:
            read = [(raw, connection.msgtype) for connection, _, raw in reader.messages()]
            assert len(read) == reader.message_count
            counts.append(len(read))
        for raw, type_name in read[::40]:
            assert NEVER not in repr(typestore().deserialize_cdr(raw, type_name))
    assert 1261 <= np.median(counts) <= 1361
    recordings = {path.parent for path in (splits / "bags").rglob("*.mcap")}
    assert sum(not (each / "metadata.yaml").exists() for each in recordings) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_world_is_the_same_for_the_same_seed_and_another_for_another(kind: str) -> None:
    facts = [worlds.World(kind, seed, KINDS[kind]).facts() for seed in (SEED, SEED, SEED + 1)]
    assert facts[0] == facts[1] != facts[2]


@needs_real
@needs_recorded
def test_the_world_of_strangers_has_bags_of_several_kinds(tmp_path: Path) -> None:
    place = worlds.made(worlds.STRANGERS, SEED, 0, tmp_path)
    assert {path.suffix for path in place.rglob("*") if path.is_file()} >= {".mcap", ".db3"}
    assert questions.questions(json.loads((place / "world.json").read_bytes()), SEED)


def test_the_command_fills_asks_and_prints_one_table(
    splits: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = tmp_path / "figures.json"
    options = ["--world", "splits_week", "--bags", "12", "--seed", f"{SEED:x}"]
    options += ["--dir", str(splits.parent), "--json", str(told)]
    assert main([*options, "--only", "position at a time"]) == 0
    printed = capsys.readouterr().out
    lines = {line["figure"]: line for line in json.loads(told.read_bytes())["lines"]}
    assert len(lines) == 8
    assert all(figure in printed for figure in lines)
    position = lines["position at a time"]
    assert (position["plain"][-2:], position["floor"][-2:]) == ("ms", "ms")
    assert not position["trouble"]
