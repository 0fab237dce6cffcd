"""`python -m benchmarks`: draws a world by a seed, fills its memory, asks it, prints one table.

The seed is the hash of the commit that is measured, so that nobody can tune for its world. With
`--recorder` it measures the recorder's daemon instead.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from benchmarks import plain, recorder, report, timing, worlds
from benchmarks.bags import Topic
from benchmarks.questions import Question, questions
from benchmarks.report import Line, milliseconds

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from benchmarks.timing import Asked, Ran
    from ros2_memory.core.model import JsonValue

_DIR: Final = Path(__file__).resolve().parents[1] / "build" / "benchmarks"


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the table; the exit code is 0 whatever was measured, 1 where there is no world."""
    given = _parser().parse_args(argv)
    if given.recorder:
        return _recorder(given.dir / "recorder", given.bags, given.setup)
    size = given.days if given.world == worlds.HOME else given.bags
    seed = int((given.seed or report.commit()).split()[0][:16], 16)
    try:
        place = worlds.made(given.world, seed, size, given.dir, jobs=given.jobs)
    except FileNotFoundError as error:
        print(f"skipped: {error}")
        return 1
    if given.robots:
        place = worlds.fleet_of(place, given.robots, lake=given.lake)
    facts = json.loads((place / "world.json").read_bytes())
    title = (
        f"{given.world}, seed {seed:x}: {facts['bags']:,} bags of {facts['bytes'] / 1e6:,.0f} MB"
    )
    print(report.head(title), flush=True)
    lines = []
    asked = [each for each in questions(facts, seed) if given.only in each.words]
    for line in _measured(place, facts, asked, fills=not given.keep, yardsticks=not given.ours):
        lines.append(line)
        print(report.row(line), flush=True)
    if given.json is not None:
        rows = [line._asdict() for line in lines]
        table = {"title": title, "commit": report.commit(), "lines": rows}
        given.json.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    return 0


def _recorder(folder: Path, bags: int, setup: Path | None) -> int:
    print(report.head(f"{bags:,} bags of the recorder's own"), flush=True)
    peak_mb, resident_mb = recorder.measured(folder, bags, setup)
    memory = f"{peak_mb:.0f} / {resident_mb:.0f} MB"
    print(report.row(Line("memory of the daemon: peak / resident", memory)))
    return 0


def _measured(
    place: Path,
    facts: dict[str, JsonValue],
    asked: Sequence[Question],
    *,
    fills: bool,
    yardsticks: bool,
) -> Iterator[Line]:
    if fills:
        bags, size = cast("int", facts["bags"]), cast("int", facts["bytes"])
        yield from _filling(place, timing.filled(place), "fill", bags, size)
        if facts.get("lake"):
            yield from _filling(place, timing.shipped(place), "ship", bags, size)
    # A robot of a fleet alone could be asked as plain rosbags are.
    alone = "topics" in facts and "robots" not in facts
    bags_of_it = plain.bags_of(place) if yardsticks and alone else []
    if asked:
        ran = timing.first_answer(place, asked[0])
        both = f"{ran.seconds:.2f} s, {ran.elapsed_s:.2f} s by the clock"
        yield Line("start to first answer, a process", both)
    timing.imported(place, asked)
    starts = []
    for question in asked:
        found = timing.asked(place, question)
        starts.append(found.start_ms)
        yield _line(question, found, bags_of_it)
    if starts:
        yield Line("start: look at all bags", milliseconds(min(starts)))
    ours = timing.server(place, asked)
    yield Line("all questions in one server", milliseconds(sum(ours.spent_ms)))
    yield Line("resident after them / peak", f"{ours.resident_mb:.0f} / {ours.peak_mb:.0f} MB")


def _filling(place: Path, filled: Ran, words: str, bags: int, size: int) -> Iterator[Line]:
    yield Line(f"{words}, for each bag", milliseconds(filled.seconds * 1e3 / bags))
    stored = timing.stored(place)
    share = f"{stored / bags / 1e3:.2f} kB ({stored / size:.1%} of the bags)"
    yield Line("stored, for each bag", share)
    yield Line(f"peak memory of {words}", f"{filled.peak_mb:.0f} MB")


def _line(question: Question, found: Asked, bags: Sequence[plain.Bag]) -> Line:
    theirs = least = ""
    if question.plain is not None and bags:
        spent, is_scaled = plain.asked(bags, question.plain)
        theirs = f"{'~' if is_scaled else ''}{milliseconds(spent * 1e3)}"
        if question.tool == "get_position_at":
            topic = Topic(question.plain.topic, "nav_msgs/msg/Odometry")
            least = milliseconds(plain.floor(bags, topic, question.plain.stop - 1) * 1e3)
    times = milliseconds(found.first_ms, found.again_ms)
    return Line(question.words, times, theirs, least, found.told, found.trouble)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--world", choices=worlds.KINDS, default=worlds.HOME)
    parser.add_argument("--days", type=int, default=2, help="of a home")
    parser.add_argument("--bags", type=int, default=2_000, help="of splits")
    parser.add_argument("--robots", type=int, help="a fleet, each with a third of the recordings")
    parser.add_argument("--lake", action="store_true", help="the fleet's bags are in a lake")
    parser.add_argument("--recorder", action="store_true", help="the daemon, over --bags")
    parser.add_argument("--setup", type=Path, help="with --recorder: setup file of a real ros2")
    parser.add_argument("--seed", metavar="HEX", help="default: the commit's hash")
    parser.add_argument("--only", default="", metavar="TEXT", help="only questions named so")
    parser.add_argument("--keep", action="store_true", help="ask what is stored, fill nothing")
    parser.add_argument("--ours", action="store_true", help="without the yardsticks")
    parser.add_argument("--jobs", type=int, default=1, help="processes that write a world")
    parser.add_argument("--dir", type=Path, default=_DIR, help="where worlds are kept")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    return parser


if __name__ == "__main__":
    sys.exit(main())
