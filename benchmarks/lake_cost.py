"""`python -m benchmarks.lake_cost`: what shipping a robot-hour costs the hub and the lake.

Robots with a home robot's bags get new bags in stages, each of which is shipped by a process of its
own. What a stage adds to the one before gives the cost of a pass, of a commit and of a bag. Robots
have the same bags; a lake stores them under each robot's name.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import urlsplit

from pyiceberg.catalog.sql import SqlCatalog

from benchmarks.home.__main__ import made
from benchmarks.home.days import Scale
from benchmarks.report import machine
from ros2_memory.lake.written_files import WRITTEN_FILE

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pyiceberg.table import Table

_DIR: Final = Path(__file__).resolve().parents[1] / "build" / "benchmarks"
_NAMESPACE: Final = "ros2_memory"
_HOUR_S: Final = 3_600.0
_PLANS: Final = 5
_NO_CACHE: Final = "reader.chunk_cache_mb=1"
"""What readers keep is bounded, and would hide what is kept of each bag."""
_COMMITS: Final = 20
"""One after the other, as in so many minutes: each adds a manifest to each table."""


class Pass(NamedTuple):
    """One `ros2-memory ship --once`: what it was given, what it took, and the lake after it."""

    words: str
    bags: int
    processor_s: float
    peak_mb: float
    snapshots: int
    data_files: int
    data_bytes: int
    other_bytes: int
    """Of manifests, snapshots, metadata, the catalogue and what `ship` keeps for itself."""


class Hub:
    """Robots whose folders get bags, and the process that ships them."""

    def __init__(self, folder: Path, bags: Sequence[Path], robots: int) -> None:
        self._folder = folder
        self._bags = bags
        self._given = {f"r{number:03d}": 0 for number in range(robots)}
        for name in self._given:
            (folder / "robots" / name).mkdir(parents=True)

    @property
    def robots(self) -> list[str]:
        """The robots' names."""
        return list(self._given)

    def give(self, robot: str, count: int) -> None:
        """Puts the robot's next bags into its folder, as links: their times stay."""
        for bag in self._bags[self._given[robot] : self._given[robot] + count]:
            place = self._folder / "robots" / robot / bag.parent.name
            place.mkdir(exist_ok=True)
            os.link(bag, place / bag.name)
        self._given[robot] += count

    def ship(self, words: str, bags: int, *overrides: str) -> Pass:
        """Ships what is new.

        Raises:
            RuntimeError: it failed, or did not ship so many bags.
        """
        argv = [
            *(sys.executable, "-m", "ros2_memory.cli", "ship", "--once", "--json"),
            f"fleet.robots={self._folder}/robots/*",
            f"lake.warehouse={self._folder / 'lake'}",
            "lake.commit_interval_s=0",
            *overrides,
        ]
        env = {
            **os.environ,
            "MEMORY_DEPLOYMENT": "lake",
            "XDG_CACHE_HOME": str(self._folder / "cache"),
            "TZ": "UTC",
        }
        reply = self._folder / "reply.json"
        with reply.open("wb") as stdout, subprocess.Popen(argv, env=env, stdout=stdout) as child:
            _, status, used = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
        shipped = json.loads(reply.read_text())["bags"]
        if child.returncode or shipped != bags:
            raise RuntimeError(f"{words}: exit {child.returncode}, {shipped} of {bags} bags")
        return Pass(
            words, bags, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, *self._lake()
        )

    def planned(self, robot: str) -> tuple[int, float]:
        """Returns the manifests of `sightings`, and the processor time (s) to plan one robot."""
        with self._tables() as tables:
            table = tables["sightings"]
            snapshot = table.current_snapshot()
            if snapshot is None:
                raise RuntimeError("nothing was shipped")
            manifests = len(snapshot.manifests(table.io))
            begun = time.process_time()
            for _ in range(_PLANS):
                list(table.scan(row_filter=f"robot = '{robot}'").plan_files())
            return manifests, (time.process_time() - begun) / _PLANS

    def version_bytes(self) -> float:
        """Returns by how much a version makes the list of versions of a table longer, at most.

        Each commit writes that list again.
        """
        with self._tables() as tables:
            return max(
                Path(urlsplit(table.metadata_location).path).stat().st_size / len(table.snapshots())
                for table in tables.values()
                if table.snapshots()
            )

    def recorded_bytes(self) -> float:
        """Returns the bytes by which `ship` records a file that it writes."""
        [record] = (self._folder / "lake").rglob(WRITTEN_FILE)
        return record.stat().st_size / len(record.read_text().splitlines())

    def _lake(self) -> tuple[int, int, int, int]:
        """Returns snapshots, files and bytes of data, and all other bytes."""
        with self._tables() as tables:
            snapshots = sum(len(table.snapshots()) for table in tables.values())
            tasks = [task for table in tables.values() for task in table.scan().plan_files()]
            data = sum(task.file.file_size_in_bytes for task in tasks)
        place = self._folder / "lake"
        everything = sum(each.stat().st_size for each in place.rglob("*") if each.is_file())
        return snapshots, len(tasks), data, everything - data

    @contextmanager
    def _tables(self) -> Iterator[dict[str, Table]]:
        place = (self._folder / "lake").absolute()
        [found] = place.rglob("*.sqlite")
        catalog = SqlCatalog("lake", uri=f"sqlite:///{found}", warehouse=place.as_uri())
        try:
            names = catalog.list_tables(_NAMESPACE)
            yield {name[-1]: catalog.load_table(name) for name in names}
        finally:
            catalog.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Ships in stages and prints each, and what follows for a robot-hour."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lake_cost", description=__doc__)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--split-s", type=float, default=60.0)
    parser.add_argument("--dir", type=Path, default=_DIR, help="where the lake is made")
    parser.add_argument("--worlds", type=Path, default=_DIR, help="where worlds are kept")
    given = parser.parse_args(argv)
    folder = given.dir / "lake_cost"
    shutil.rmtree(folder, ignore_errors=True)
    world = made(Scale(seed=0, days=1, compression=1.0, split_s=given.split_s), given.worlds)
    bags = sorted((world / "bags").rglob("*.mcap"), key=_numbered)
    hour = round(_HOUR_S / given.split_s)
    hub = Hub(folder, bags, given.robots)
    print(f"{given.robots} robots, bags of {given.split_s:g} s\n{machine()}\n")
    print("| pass | bags | processor, s | peak, MB | snapshots | files | data, MB | other, MB |")
    print("|---|---|---|---|---|---|---|---|")
    first, *others = hub.robots
    passes: list[Pass] = []

    def shipped(words: str, given_to: Sequence[str], count: int, *overrides: str) -> Pass:
        for robot in given_to:
            hub.give(robot, count)
        done = hub.ship(words, len(given_to) * count, *overrides)
        print(
            f"| {done.words} | {done.bags} | {done.processor_s:.2f} | {done.peak_mb:.0f} "
            f"| {done.snapshots} | {done.data_files} | {done.data_bytes / 1e6:.2f} "
            f"| {done.other_bytes / 1e6:.2f} |",
            flush=True,
        )
        passes.append(done)
        return done

    # The bags are of a day that is over, so a pass also compacts: what has more than three files.
    shipped("the first hour of one robot", [first], hour)
    nothing = shipped("nothing new", [], 0)
    one = shipped("one bag", [first], 1)
    shipped("the first bag of all others", others, 1)
    each = shipped("one bag of each robot", hub.robots, 1)
    before = shipped("nothing new, all robots", [], 0, _NO_CACHE)
    few = hub.planned(first)
    turns = [
        shipped(f"one bag of each other robot, {commit + 1} of {_COMMITS}", others, 1)
        for commit in range(_COMMITS)
    ]
    last, many, version = turns[-1], hub.planned(first), hub.version_bytes()
    much = shipped("an hour of each robot", hub.robots, hour)
    seen = shipped("nothing new, many bags", [], 0, _NO_CACHE)
    after = shipped("nothing new, and no old versions", [], 0, "lake.grace_h=0")
    hours = given.robots
    per_bag = (much.processor_s - each.processor_s) / (much.bags - each.bags)
    commits = each.snapshots - passes[3].snapshots
    commits_files = (turns[0].data_files - before.data_files) / len(others)
    added = [new.snapshots - old.snapshots for old, new in pairwise(turns)]
    plain = [one.processor_s for one, more in zip(turns[1:], added, strict=True) if more <= commits]
    closing = [
        one.processor_s for one, more in zip(turns[1:], added, strict=True) if more > commits
    ]
    since = sum(each.bags for each in passes[passes.index(before) :])
    lines = {
        "a pass that ships nothing: processor, s": nothing.processor_s,
        "the same with all robots": before.processor_s,
        "one bag more: processor, s": one.processor_s - nothing.processor_s,
        "each bag of a batch: processor, s": per_bag,
        "each robot-hour in batches: processor, s": per_bag * hour,
        "each bag of a batch with one of each robot: processor, s": (
            mean(plain) - nothing.processor_s
        )
        / len(others),
        "files of such a batch, for each robot": commits_files,
        "versions that a batch of all tables adds": commits,
        "versions that closing days adds": max(added) - commits,
        "closing a day of a robot: processor, s": (mean(closing) - mean(plain)) / len(others),
        "a bag that was shipped before: kB of memory": (seen.peak_mb - before.peak_mb)
        / since
        * 1e3,
        "the same: processor at the start, ms": (seen.processor_s - before.processor_s)
        / since
        * 1e3,
        "the list of versions of a table: kB for each": version / 1e3,
        "the record of a file that was written: bytes": hub.recorded_bytes(),
        f"planning one robot, {few[0]} manifests: processor, s": few[1],
        f"the same, {many[0]} manifests": many[1],
        "each robot-hour: data, kB": (after.data_bytes - last.data_bytes) / hours / 1e3,
        "each robot-hour: recorded, kB": sum(b.stat().st_size for b in bags[:hour]) / 1e3,
        "what is not data, old versions deleted: MB": after.other_bytes / 1e6,
    }
    print()
    for words, figure in lines.items():
        print(f"{words}: {figure:.3g}")
    return 0


def _numbered(bag: Path) -> tuple[str, int]:
    return bag.parent.name, int(bag.stem.rpartition("_")[2])


if __name__ == "__main__":
    sys.exit(main())
