"""`forget` and moments beside a recorder that deletes: two processes, one bag directory.

Nothing that a moment keeps is lost, nothing foreign is deleted, and nobody ends in a traceback.
8 rounds; EPISODIC_LONG=1 makes it 24.
"""

import os
import random
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from ros2_memory import cli
from ros2_memory.bag_dir.moment_file import Outcome, PendingRequest, stored_moments_in
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.directories import identity_of
from tests.support.bags import odom, write_mcap
from tests.support.examples import LONG
from tests.support.housekeepers import size_of
from tests.support.memories import ROOT
from tests.support.processes import until

S = 10**9
ROUNDS = 24 if LONG else 4
SPLITS = 12
T0 = time.time_ns() // S * S - 3600 * S


def record(bag_dir: Path, number: int) -> dict[str, bytes]:
    """A recording comes to lie whole in a bag directory, as the recorder's own; its bags."""
    name = f"rec_20260101T{number // 60:02}{number % 60:02}00Z"
    made, content = bag_dir.with_name("workshop") / name, dict[str, bytes]()
    for split in range(SPLITS):
        start = T0 + (number * SPLITS + split) * 2 * S
        path = made / f"{name}_{split}.mcap"
        write_mcap(path, [odom(start + n * S // 20, n / 10, float(number)) for n in range(20)])
        os.utime(path, (T0 / S, T0 / S))
        content[f"{name}/{path.name}"] = path.read_bytes()
    (made / "handover.json").write_text('{"format": 1}')
    identity = identity_of(made)
    assert identity is not None
    OwnRecordings(bag_dir).adopt({name: identity})
    made.rename(bag_dir / name)
    return content


def ask_for_moments(bag_dir: Path, number: int, chance: random.Random) -> list[Outcome]:
    kept: list[Outcome] = []
    for label in range(3):
        start = T0 + (number * SPLITS + chance.randrange(SPLITS)) * 2 * S
        slot = PendingRequest(bag_dir, f"r{number} m{label}", start, start + 3 * S, time.time_ns())
        slot.post()
        kept.append(until(slot.outcome))
        slot.close()
    return kept


def test_whoever_deletes_first_nothing_that_is_kept_or_foreign_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bag_dir, kept = tmp_path / "bags", list[Outcome]()
    foreign = [
        write_mcap(bag_dir / name, [odom(T0 + n * S, 1.0, 2.0) for n in range(500)])
        for name in ("session_mcap/session_0.mcap", "loose.mcap", "deep/er/x.mcap")
    ]
    before = {path: path.read_bytes() for path in foreign}
    # A moment keeps what other programs recorded then, too.
    content = {str(path.relative_to(bag_dir)): before[path] for path in foreign}
    content |= record(bag_dir, 0)
    monkeypatch.setenv("MEMORY_BAG_DIR", str(bag_dir))
    stop = tmp_path / "stop"
    budget = size_of(bag_dir / "rec_20260101T000000Z") // 2
    # Into a file: nobody reads a pipe meanwhile, and a full one would stop it.
    log = tmp_path / "house.log"
    house_keeping = [sys.executable, "-m", "tests.integration.rival_housekeeper"]
    with log.open("w") as stream:
        house = subprocess.Popen(
            [*house_keeping, bag_dir, str(budget), stop],
            cwd=ROOT,
            stdout=stream,
            stderr=subprocess.STDOUT,
        )
    chance = random.Random(7)
    try:
        with ThreadPoolExecutor() as pool:
            for number in range(1, ROUNDS + 1):
                content |= record(bag_dir, number)
                asking = pool.submit(ask_for_moments, bag_dir, number, chance)
                while not asking.done():
                    start = T0 / S + (number * SPLITS + chance.randrange(SPLITS)) * 2
                    end = start + chance.choice([3, 9, 24])
                    window = ["--start", str(start), "--end", str(end)]
                    assert cli.main(["forget", *window, "--yes"]) in {0, 1}
                kept += asking.result()
    finally:
        stop.touch()
        house.wait(timeout=60)
        output = log.read_text()
    assert house.returncode == 0, output
    assert "Traceback" not in output
    # That the budget is not held is right: moments are more than it.
    wrong = [
        line for line in output.splitlines() if "[error" in line and "budget_not_held" not in line
    ]
    assert wrong == []
    assert {path: path.read_bytes() for path in foreign} == before
    granted = [each for each in kept if each.moment is not None]
    assert granted
    assert not [each.refused for each in kept if "cannot be saved" in str(each.refused)]
    moments = {held.folder.name: held for held in stored_moments_in(bag_dir).readable.values()}
    for each in granted:
        held = moments[str(each.moment)]
        files = {
            path.relative_to(held.folder).as_posix(): path.read_bytes()
            for path in held.folder.rglob("*.mcap")
        }
        assert files.items() <= content.items()
        assert len(files) >= each.bags
        assert not held.moment.pending
    out = capsys.readouterr()
    assert "Traceback" not in out.err
    assert "still lists deleted bags" not in out.out
