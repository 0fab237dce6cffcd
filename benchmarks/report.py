"""What was measured, as a table for people and as JSON for programs."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from benchmarks.timing import FLOOR, OURS, PLAIN

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from benchmarks.questions import Question
    from benchmarks.timing import Timed

_HEADS: Final = (
    *("question", "ours", "plain rosbags", "times faster", "aim"),
    *("floor", "times the floor", "aim", "plain measured on", "runs"),
)


@dataclass(frozen=True, slots=True)
class Row:
    """One question's figures; times are medians in seconds, None where a side was not asked.

    Attributes:
        slug: the question's name on the command line.
        words: what was asked.
        ours_s: this project.
        plain_s: plain rosbags, scaled to all bags where it was measured on some.
        floor_s: the physical floor.
        plain_aim: how many times faster than plain it is to be.
        floor_aim: within how many times the floor it is to be.
        limit_s: within which time it is to be.
        plain_bags: on how many bags plain was measured where those are not all.
        asks: how often each side was timed.
    """

    slug: str
    words: str
    ours_s: float
    plain_s: float | None = None
    floor_s: float | None = None
    plain_aim: float | None = None
    floor_aim: float | None = None
    limit_s: float | None = None
    plain_bags: int | None = None
    asks: tuple[tuple[str, int], ...] = ()

    @property
    def faster(self) -> float | None:
        """How many times faster than plain."""
        return None if self.plain_s is None else self.plain_s / self.ours_s

    @property
    def above_floor(self) -> float | None:
        """How many times the floor."""
        return None if self.floor_s is None else self.ours_s / self.floor_s

    @property
    def reached(self) -> bool | None:
        """Whether every aim is reached; None where there is none."""
        verdicts = []
        if self.plain_aim is not None and self.faster is not None:
            verdicts.append(self.faster >= self.plain_aim)
        if self.floor_aim is not None and self.above_floor is not None:
            verdicts.append(self.above_floor <= self.floor_aim)
        if self.limit_s is not None:
            verdicts.append(self.ours_s <= self.limit_s)
        return all(verdicts) if verdicts else None


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure that is no comparison of times, such as memory; `limit` is what it may be."""

    slug: str
    words: str
    value: float
    unit: str
    limit: float | None = None

    @property
    def reached(self) -> bool | None:
        """Whether it is within its limit; None where there is none."""
        return None if self.limit is None else self.value <= self.limit


def row(slug: str, question: Question, found: Mapping[str, Timed]) -> Row:
    """The figures of one question."""
    target = question.target
    seconds = {name: each.median / question.units for name, each in found.items()}
    plain_s = seconds.get(PLAIN)
    return Row(
        slug,
        question.words,
        seconds[OURS],
        None if plain_s is None else plain_s * question.plain_scale,
        seconds.get(FLOOR),
        target.plain,
        target.floor,
        target.seconds,
        question.plain_bags,
        tuple((name, len(each.seconds)) for name, each in found.items()),
    )


def machine() -> str:
    """This machine in its own words: processor, cores, memory, system and Python."""
    words = _field("/proc/cpuinfo", "model name") or platform.processor() or platform.machine()
    cores = len(os.sched_getaffinity(0))
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return (
        f"{words}, {cores} cores, {memory_gb:.0f} GB; {platform.system()} {platform.release()}; "
        f"Python {platform.python_version()}; load {os.getloadavg()[0]:.1f}"
    )


def as_json(rows: Sequence[Row], figures: Sequence[Figure], about: str) -> dict[str, object]:
    """Everything measured; times in seconds."""
    return {
        "machine": about,
        "questions": [
            {
                **asdict(each),
                "asks": dict(each.asks),
                "times_faster_than_plain": each.faster,
                "times_the_floor": each.above_floor,
                "reached": each.reached,
            }
            for each in rows
        ],
        "figures": [{**asdict(each), "reached": each.reached} for each in figures],
    }


def as_table(rows: Sequence[Row], figures: Sequence[Figure]) -> str:
    """A Markdown table of the questions, and one of the other figures."""
    lines = _table(_HEADS, [_cells(each) for each in rows]) if rows else []
    if figures:
        lines += ["", *_table(("figure", "value", "aim"), [_figure(each) for each in figures])]
    return "\n".join(lines)


def duration(seconds: float) -> str:
    """A duration with three digits and the unit that suits it."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}" if seconds < 1000 else f"{seconds:.0f} s"
    return f"{seconds / 1e-6:.3g} us"


def _cells(each: Row) -> list[str]:
    limit = "" if each.limit_s is None else f" ({_mark(each.ours_s <= each.limit_s)}"
    if each.limit_s is not None:
        limit += f" {duration(each.limit_s)})"
    faster, above = each.faster, each.above_floor
    return [
        each.words,
        duration(each.ours_s) + limit,
        "" if each.plain_s is None else duration(each.plain_s),
        "" if faster is None else _number(faster),
        _aim(each.plain_aim, faster is not None and faster >= (each.plain_aim or 0)),
        "" if each.floor_s is None else duration(each.floor_s),
        "" if above is None else _number(above),
        _aim(each.floor_aim, above is not None and above <= (each.floor_aim or 0)),
        "" if each.plain_bags is None else f"{each.plain_bags} bags, scaled up",
        "/".join(str(count) for _, count in each.asks),
    ]


def _figure(each: Figure) -> list[str]:
    aim = "" if each.limit is None else f"{each.limit:g} {each.unit}"
    verdict = "" if each.reached is None else f" {_mark(each.reached)}"
    return [each.words, f"{each.value:.3g} {each.unit}", aim + verdict]


def _aim(aim: float | None, reached: bool) -> str:
    return "" if aim is None else f"{_number(aim)} {_mark(reached)}"


def _mark(reached: bool) -> str:
    return "ok" if reached else "MISSED"


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(line[at]) for line in (heads, *lines)) for at in range(len(heads))]

    def joined(cells: Sequence[str]) -> str:
        padded = (cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
        return "| " + " | ".join(padded) + " |"

    return [joined(heads), joined(["-" * width for width in widths]), *map(joined, lines)]


def _field(path: str, name: str) -> str | None:
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), None)
