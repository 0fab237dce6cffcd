"""The questions of an hour: how each side asks, and what is aimed at."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Final, NamedTuple

from benchmarks import digests, floor, ours, plain
from benchmarks.bags import HOUR, ODOM, SCENE, SPLIT_NS
from benchmarks.copies import copied
from benchmarks.motion import NOWHERE
from benchmarks.payloads import NEVER_SEEN
from benchmarks.timing import FLOOR, OURS, PLAIN

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from benchmarks.bags import History, Split
    from benchmarks.timing import Ask, Side
    from ros2_memory.config import Settings
    from ros2_memory.history.context import Memory

_SAMPLES: Final = 100
_POINTS: Final = 20
_POINTS_BY_TOOL: Final = 200
_TOLERANCE_M: Final = 0.5
_TOLERANCE_NS: Final = 100_000_000
_INSIDE_NS: Final = 3_005_000_000
"""How far a window begins and ends inside a split, and between two messages."""


class Target(NamedTuple):
    """What is aimed at: `plain` times faster than plain, within `floor` times the floor, or both.

    `seconds` is a limit by itself.
    """

    plain: float | None = None
    floor: float | None = None
    seconds: float | None = None


@dataclass(frozen=True, slots=True)
class Question:
    """One question, the sides that answer it, and the aim.

    Attributes:
        words: what is asked.
        sides: how each side answers; `ours` is among them.
        target: the aim.
        silent: the sides whose answer is not one that can be compared.
        units: how many answers one timed ask gives.
        plain_bags: on how many bags the plain side is measured where those are not all; its time
            is then multiplied by `plain_scale`.
        plain_scale: see there.
    """

    words: str
    sides: Mapping[str, Side]
    target: Target = field(default_factory=Target)
    silent: Collection[str] = ()
    units: int = 1
    plain_bags: int | None = None
    plain_scale: float = 1.0


@dataclass
class Case:
    """What the questions are asked of; `known` says whether the catalogue is to know every bag."""

    history: History
    settings: Settings
    known: bool = True

    @cached_property
    def memory(self) -> Memory:
        """A memory that knows the folder."""
        memory = ours.memory(self.settings)
        memory.index.refresh()
        if self.known:
            digests.made_known(memory, self.settings)
        return memory

    @cached_property
    def splits(self) -> list[Split]:
        """All bags."""
        return list(self.history.splits())

    @property
    def hour(self) -> list[Split]:
        """The bags of the last hour."""
        return self.splits[-HOUR:]

    @property
    def window(self) -> tuple[int, int]:
        """The last hour in nanoseconds; it begins and ends inside a split."""
        return self.hour[0].start + _INSIDE_NS, self.history.end - _INSIDE_NS

    @cached_property
    def places(self) -> list[floor.Needed]:
        """The chunks of the last hour that hold odometry."""
        return floor.needed(self.hour, ODOM)

    @cached_property
    def chance(self) -> random.Random:
        """Which moments are asked about; the same in every run of the program."""
        return random.Random(4)  # noqa: S311 - a draw that must repeat, nothing secret

    def moments(self, count: int) -> list[tuple[Split, int]]:
        """Different splits of the hour, and in each a moment between two poses."""
        chosen = self.chance.sample(self.hour, min(count, len(self.hour)))
        between = SPLIT_NS // ODOM.messages
        return [
            (split, split.start + self.chance.randrange(5, ODOM.messages) * between + between // 2)
            for split in chosen
        ]


def index(case: Case) -> Question:
    """Indexing a cold directory."""
    paths = [split.path for split in case.splits]
    some = paths[-HOUR:]

    def mine() -> Sequence[Ask]:
        # Under another name, where no catalogue lies.
        bare = copied(case.history, 1)
        memory = ours.memory(ours.settings_for(bare.folder))
        return [lambda: ours.counts(memory)]

    return Question(
        f"index a cold directory of {len(paths)} bags (summaries only)",
        {
            OURS: mine,
            PLAIN: lambda: [lambda: plain.index(some)],
            FLOOR: lambda: [lambda: floor.open_and_read_summaries(paths)],
        },
        Target(plain=40, floor=20),
        silent={FLOOR} if len(some) == len(paths) else {FLOOR, PLAIN},
        plain_bags=None if len(some) == len(paths) else len(some),
        plain_scale=len(paths) / len(some),
    )


def point_cold(case: Case) -> Question:
    """One moment, nothing cached."""
    return _point(case, cached=False)


def point_cached(case: Case) -> Question:
    """One moment, asked before."""
    return _point(case, cached=True)


def point_tool(case: Case) -> Question:
    """One moment, through all of the server but its transport."""
    asked = case.moments(_POINTS)
    at_s = [moment / 1e9 for _, moment in asked]
    at_s = (at_s * (_POINTS_BY_TOOL // len(at_s)))[:_POINTS_BY_TOOL]
    return Question(
        f"the same by a tool call, JSON in and out ({len(at_s)} calls)",
        {OURS: lambda: [lambda: ours.positions_by_tool(case.memory, case.settings, at_s)]},
        units=len(at_s),
    )


def samples(case: Case) -> Question:
    """A hundred samples of an hour."""
    start, stop = case.window
    inside = [each for each in floor.located(case.places, ODOM) if start <= each.log_time < stop]
    last = len(inside) - 1
    kept = [inside[nth * last // (_SAMPLES - 1)] for nth in range(_SAMPLES)]
    return Question(
        f"{_SAMPLES} samples of an hour of odometry",
        {
            OURS: lambda: [lambda: ours.samples(case.memory, ODOM.name, start, stop, _SAMPLES)],
            PLAIN: lambda: [lambda: plain.samples(case.hour, ODOM.name, start, stop, _SAMPLES)],
            FLOOR: lambda: [lambda: floor.poses(case.places, kept)],
        },
        Target(plain=35, floor=2.5),
    )


def trajectory(case: Case) -> Question:
    """The way driven in an hour."""
    start, stop = case.window
    return Question(
        "trajectory of an hour",
        {
            OURS: lambda: [lambda: ours.path_length(case.memory, ODOM.name, start, stop)],
            PLAIN: lambda: [lambda: plain.path_length(case.hour, ODOM.name, start, stop)],
            FLOOR: lambda: [lambda: floor.unpack_all(case.places)],
        },
        Target(plain=400, floor=1),
        silent={FLOOR},
    )


def seen(case: Case) -> Question:
    """A thing that was never seen."""
    return _never(
        case,
        f'find_last_match "{NEVER_SEEN}", never seen',
        lambda: ours.last_match(case.memory, SCENE.name, "contains", NEVER_SEEN),
        lambda bags: plain.last_match(bags, SCENE.name, plain.shows(NEVER_SEEN)),
        Target(plain=10_000),
    )


def near(case: Case) -> Question:
    """A place where the robot never was."""
    x, y = NOWHERE
    place: dict[str, float | int | str | bool | None] = {"x": x, "y": y}
    return _never(
        case,
        "near_position, never there",
        lambda: ours.last_match(case.memory, ODOM.name, "near_position", dict(place)),
        lambda bags: plain.last_match(bags, ODOM.name, plain.near(x, y, _TOLERANCE_M)),
        Target(),
    )


def _point(case: Case, *, cached: bool) -> Question:
    asked = case.moments(_POINTS)
    needed = [floor.needed([split], ODOM) for split, _ in asked]
    newest = [
        max(each for each in floor.located(place, ODOM) if each.log_time <= moment)
        for place, (_, moment) in zip(needed, asked, strict=True)
    ]

    def mine() -> Sequence[Ask]:
        if cached:
            memory = case.memory
            for _, moment in asked:
                ours.position_at(memory, ODOM.name, moment / 1e9)
        else:
            memory = ours.forgetful(case.memory, case.settings, case.splits[0], ODOM.name)
        return [partial(ours.position_at, memory, ODOM.name, moment / 1e9) for _, moment in asked]

    return Question(
        f"point query, {'asked before' if cached else 'nothing cached'}",
        {
            OURS: mine,
            PLAIN: lambda: [
                partial(
                    plain.position_at, [split], ODOM.name, moment - _TOLERANCE_NS, moment + 1000
                )
                for split, moment in asked
            ],
            FLOOR: lambda: [
                partial(floor.pose, place[0], message)
                for place, message in zip(needed, newest, strict=True)
            ],
        },
        Target(plain=300) if cached else Target(plain=8, floor=7),
    )


def _never(
    case: Case,
    words: str,
    mine: Ask,
    theirs: Callable[[Sequence[Split]], object],
    target: Target,
) -> Question:
    """A search that finds nothing in all the bags; plain is measured on an hour of them."""
    bags, hour = len(case.splits), len(case.hour)
    return Question(
        f"{words}, {bags} bags",
        {OURS: lambda: [mine], PLAIN: lambda: [partial(theirs, case.hour)]},
        target,
        plain_bags=None if hour == bags else hour,
        plain_scale=bags / hour,
    )


QUESTIONS: Final[Mapping[str, Callable[[Case], Question]]] = {
    "index": index,
    "point-cold": point_cold,
    "point-cached": point_cached,
    "point-tool": point_tool,
    "samples": samples,
    "trajectory": trajectory,
    "never-seen": seen,
    "never-near": near,
}
