"""`python -m benchmarks.home`: a home robot's days, and how many questions are answered."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import yaml

from benchmarks.home import asking, instances, recording
from benchmarks.home.days import Scale
from benchmarks.home.judging import wrong_fields
from benchmarks.home.questions import questions
from benchmarks.home.things import LABELS
from benchmarks.home.truth import places, truth_of
from benchmarks.home.world import world_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from benchmarks.home.judging import Answer
    from benchmarks.home.questions import Question
    from ros2_memory.core.model import JsonValue

_DIR: Final = Path(__file__).resolve().parents[2] / "build" / "benchmarks"
_SEAL: Final = "scale.json"
_FORMAT: Final = 1  # of what is written; folders of another one are made anew


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark; the exit code is 0 whatever was right."""
    given = _parser().parse_args(argv)
    scale = Scale(given.seed, given.days, given.compression, given.split_s, given.rosout)
    if given.write is not None:
        write(scale, given.write)
        return 0
    if given.judge is not None:
        answers = json.loads(given.judge.read_text(encoding="utf-8"))
        print(judged(questions(scale), answers))
        return 0
    world = made(scale, given.dir)
    with _in_utc():
        server = asking.server_over(asking.settings_for(world, scale.split_s))
        outcomes = asking.ask_all(server, questions(scale))
        things = instances.measured(server, truth_of(scale), scale.split_s)
        denied = instances.denials(server, world_of(scale), truth_of(scale))
    print(asking.as_table(outcomes))
    if things is not None:
        print("\n".join(["", *things.lines(), *denied.lines()]))
    if given.json is not None:
        rows = [
            {
                "id": each.question.id,
                "kind": each.question.kind,
                "result": each.result,
                "calls": each.calls,
                "characters": each.characters,
                "longest_reply": each.longest_reply,
                "slowest_s": round(each.slowest_s, 4),
            }
            for each in outcomes
        ]
        given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


def judged(asked: Sequence[Question], answers: Mapping[str, Answer]) -> str:
    """Returns how many answers (by the question's id) are right, and what is wrong with others."""
    lines, right = [], 0
    for question in asked:
        wrong = wrong_fields(question.truth, answers.get(question.id, {}))
        right += not wrong
        if wrong:
            lines.append(f"wrong: {question.id}: {', '.join(wrong)}")
    return "\n".join([f"{right} of {len(asked)} right", *lines])


@contextmanager
def _in_utc() -> Iterator[None]:
    """Has this process's days begin and end as those of the robot do."""
    before = os.environ.get("TZ")
    os.environ["TZ"] = "UTC"
    time.tzset()
    try:
        yield
    finally:
        if before is None:
            del os.environ["TZ"]
        else:
            os.environ["TZ"] = before
        time.tzset()


def made(scale: Scale, folder: Path) -> Path:
    """Returns the world of a scale in `folder`, as it lies there or built."""
    words = f"{scale.seed}_{scale.days}_{scale.compression:g}_{scale.split_s:g}_{scale.rosout:d}"
    world = folder / f"home_{words}"
    facts = {"format": _FORMAT, **asdict(scale)}
    seal = world / _SEAL
    if not seal.is_file() or json.loads(seal.read_text(encoding="utf-8")) != facts:
        shutil.rmtree(world, ignore_errors=True)
        write(scale, world)
        seal.write_text(json.dumps(facts), encoding="utf-8")
    return world


def write(scale: Scale, folder: Path) -> None:
    """Writes bags, truth, places and labels into `folder`; from two days on, questions as well.

    Raises:
        FileExistsError: bags lie there already.
    """
    recording.write(scale, folder / "bags")
    _write_json(folder / "truth.json", truth_of(scale).as_json())
    if scale.days > 1:
        _write_json(folder / "questions.json", as_json(scale))
    named = {"places": places(), "labels": {label: [*also] for label, also in LABELS.items()}}
    for kind, content in named.items():
        text = yaml.safe_dump({kind: content}, sort_keys=False, default_flow_style=None)
        (folder / f"{kind}.yaml").write_text(text, encoding="utf-8")


def as_json(scale: Scale) -> JsonValue:
    """Returns the questions of a scale with their truth."""
    return [question.as_json() for question in questions(scale)]


def _write_json(path: Path, content: JsonValue) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.home", description=__doc__)
    shipped = Scale()
    parser.add_argument("--seed", type=int, default=shipped.seed)
    parser.add_argument("--days", type=int, default=shipped.days, help="2 or more, to ask")
    parser.add_argument(
        "--compression",
        type=float,
        default=shipped.compression,
        help="1: days of 24 hours; more: on for outings alone, and those are short",
    )
    parser.add_argument("--split-s", type=float, default=shipped.split_s)
    parser.add_argument("--no-rosout", dest="rosout", action="store_false")
    parser.add_argument("--write", type=Path, metavar="DIR", help="build there, and ask nothing")
    parser.add_argument(
        "--judge",
        type=Path,
        metavar="FILE",
        help="only judge somebody's answers: for each id an object with the fields asked for",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the outcomes there")
    parser.add_argument("--dir", type=Path, default=_DIR, help="where worlds are kept")
    return parser


if __name__ == "__main__":
    sys.exit(main())
