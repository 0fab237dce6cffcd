"""Answers agree with brute force over odd histories, the recorded sessions and public bags."""

import os
import random
from pathlib import Path
from typing import Final

import pytest

from tests.oracle.exam import Server, examine
from tests.oracle.truth import History
from tests.oracle.worlds import WORLDS, World
from tests.support.examples import LONG
from tests.support.shared_bags import REAL, RECORDED, needs_real, needs_recorded

pytestmark = pytest.mark.xdist_group("heavy")

QUESTIONS: Final = int(os.environ.get("EPISODIC_QUESTIONS", "2000" if LONG else "25"))
SEED: Final = int(os.environ.get("EPISODIC_SEED", "0"))
SEEDS: Final = range(SEED, SEED + 5) if LONG else [SEED]
SHARED_SEED: Final = SEED + 7
"""Of the questions about bags that are not written here."""


def held(world: World, seed: int, *, stored: bool) -> None:
    history = History(world.folder)
    server = Server(world.folder, world, stored=stored)
    try:
        report = examine(world, history, server, random.Random(seed), QUESTIONS)
    finally:
        server.stop()
    assert report.total >= QUESTIONS
    assert not report.wrong, "\n".join(report.wrong[:10])


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The store lies in this test's own cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.mark.parametrize("stored", [False, True], ids=["bags", "store"])
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", WORLDS)
def test_answers_about_odd_worlds(name: str, seed: int, stored: bool, tmp_path: Path) -> None:
    held(WORLDS[name](tmp_path / name, random.Random(seed)), seed, stored=stored)


@needs_recorded
@pytest.mark.parametrize("stored", [True, *LONG * [False]], ids=["store", *LONG * ["bags"]])
@pytest.mark.parametrize("name", ["session_mcap", "session_zstd", "session_sqlite3"])
def test_answers_about_recorded_sessions(name: str, stored: bool) -> None:
    storage = "rosbag2" if name.endswith("sqlite3") else "mcap"
    tf = (("/tf", False), ("/tf_static", True))
    held(World(RECORDED / name, storage, tf=tf), SHARED_SEED, stored=stored)


@needs_real
@pytest.mark.parametrize("stored", [True, *LONG * [False]], ids=["store", *LONG * ["bags"]])
@pytest.mark.parametrize(
    "name",
    [
        "mobrob_odom_mcap",
        "evo_tf_example_db3",
        "rerun_sensors_mcap",
        "rosbags_rs_94types_mcap",
        "rosbags_rs_94types_db3",
        "rosbag2_3split_nometa_mcap",
        "cougars_auv_mcap",
    ],
)
def test_answers_about_public_bags(name: str, stored: bool) -> None:
    storage = "rosbag2" if name.endswith("db3") else "mcap"
    held(World(REAL / name, storage, odometry=()), SHARED_SEED, stored=stored)
