"""`forget` and moments beside a recorder that deletes: two processes, one bag directory.

Nothing that a moment keeps is lost, nothing foreign is deleted, and nobody ends in a traceback.
8 rounds; EPISODIC_LONG=1 makes it 24.
"""

import os
import random
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
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


@dataclass
class Robot:
    """A bag directory in which recordings come to lie whole, as the recorder's own."""

    bag_dir: Path
    workshop: Path
    content: dict[str, bytes] = field(default_factory=dict)
    kept: list[Outcome] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def record(self, number: int) -> None:
        name = f"rec_20260101T{number // 60:02}{number % 60:02}00Z"
        for split in range(SPLITS):
            start = T0 + (number * SPLITS + split) * 2 * S
            path = self.workshop / name / f"{name}_{split}.mcap"
            write_mcap(path, [odom(start + n * S // 20, n / 10, float(number)) for n in range(20)])
            os.utime(path, (T0 / S, T0 / S))
            self.content[f"{name}/{path.name}"] = path.read_bytes()
        (self.workshop / name / "handover.json").write_text('{"format": 1}')
        identity = identity_of(self.workshop / name)
        assert identity is not None
        OwnRecordings(self.bag_dir).adopt({name: identity})
        (self.workshop / name).rename(self.bag_dir / name)

    def ask_for_moments(self, number: int, chance: random.Random) -> None:
        for label in range(3):
            start = T0 + (number * SPLITS + chance.randrange(SPLITS)) * 2 * S
            slot = PendingRequest(
                self.bag_dir, f"r{number} m{label}", start, start + 3 * S, time.time_ns()
            )
            try:
                slot.post()
                self.kept.append(until(slot.outcome))
                slot.close()
            except Exception as error:  # noqa: BLE001 - of a thread
                self.faults.append(repr(error))


def test_whoever_deletes_first_nothing_that_is_kept_or_foreign_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = Robot(tmp_path / "bags", tmp_path / "workshop")
    foreign = [
        write_mcap(robot.bag_dir / name, [odom(T0 + n * S, 1.0, 2.0) for n in range(500)])
        for name in ("session_mcap/session_0.mcap", "loose.mcap", "deep/er/x.mcap")
    ]
    before = {path: path.read_bytes() for path in foreign}
    # A moment keeps what other programs recorded then, too.
    robot.content |= {str(path.relative_to(robot.bag_dir)): before[path] for path in foreign}
    robot.record(0)
    monkeypatch.setenv("MEMORY_BAG_DIR", str(robot.bag_dir))
    stop = tmp_path / "stop"
    budget = size_of(robot.bag_dir / "rec_20260101T000000Z") // 2
    # Into a file: nobody reads a pipe meanwhile, and a full one would stop it.
    log = tmp_path / "house.log"
    house_keeping = [sys.executable, "-m", "tests.integration.rival_housekeeper"]
    with log.open("w") as stream:
        house = subprocess.Popen(
            [*house_keeping, robot.bag_dir, str(budget), stop],
            cwd=ROOT,
            stdout=stream,
            stderr=subprocess.STDOUT,
        )
    chance = random.Random(7)
    try:
        for number in range(1, ROUNDS + 1):
            robot.record(number)
            asker = threading.Thread(target=robot.ask_for_moments, args=(number, chance))
            asker.start()
            while asker.is_alive():
                start = T0 / S + (number * SPLITS + chance.randrange(SPLITS)) * 2
                window = ["--start", str(start), "--end", str(start + chance.choice([3, 9, 24]))]
                assert cli.main(["forget", *window, "--yes"]) in {0, 1}
            asker.join()
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
    assert robot.faults == []
    assert {path: path.read_bytes() for path in foreign} == before
    granted = [each for each in robot.kept if each.moment is not None]
    assert granted
    assert not [each.refused for each in robot.kept if "cannot be saved" in str(each.refused)]
    moments = {held.folder.name: held for held in stored_moments_in(robot.bag_dir)}
    for each in granted:
        held = moments[str(each.moment)]
        files = {
            path.relative_to(held.folder).as_posix(): path.read_bytes()
            for path in held.folder.rglob("*.mcap")
        }
        assert files.items() <= robot.content.items()
        assert len(files) >= each.bags
        assert not held.moment.pending
    out = capsys.readouterr()
    assert "Traceback" not in out.err
    assert "still lists deleted bags" not in out.out
