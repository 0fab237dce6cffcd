"""What differs between two windows: things, way, standstills, time in places, errors, silences.

A thing that was seen in both is compared by where it was seen last in each. One that was seen in
the later alone *appeared* only where its place was looked at in the earlier one, from where it is
seen, so often that missing it by chance is below 1 %. One that was seen in the earlier alone is
reported as not seen where expected by the same rule, and else as not looked at. One of each kind,
with one label, in odometry that began again between them may be one thing: it was seen in both, and
its places cannot be compared. What moves by itself has no place: it is compared by whether it was
seen, how many at once, and where last.

Two numbers differ where they are apart by more than a tenth of the larger, and by more than what
noise and the rounding of what is stored may make of equal ones (`_LEAST`).
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.analysis.facts import has_errors
from ros2_memory.analysis.sights import Spot
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import Place, places_at
from ros2_memory.core.spans import united, without
from ros2_memory.core.text import Quoted
from ros2_memory.core.timebase import MAX_NS, Ns, unix_from_ns
from ros2_memory.history.coverage import (
    gap_around,
    note_unread,
    note_unrecorded,
    recording_gaps,
    unix_text,
)
from ros2_memory.history.driven_path import length_notes, resolve_path_topic
from ros2_memory.history.view import View, clamped, open_view
from ros2_memory.insights.drive import Drive, drive_in
from ros2_memory.insights.recap import found_events
from ros2_memory.insights.silences import silences_in
from ros2_memory.places.pose_frames import (
    MapPlacement,
    changing_origin,
    is_one_run,
    known_placement,
    known_track,
    places_in,
)
from ros2_memory.places.two_paths import farthest_apart, placed_standstills, stood_at
from ros2_memory.places.where import Where, parse_where, places_asked
from ros2_memory.results import (
    ComparedMover,
    ComparedThing,
    ComparedThings,
    Comparison,
    FarFromOther,
    MoverSeen,
    Pair,
    StandstillPlace,
    ThingStay,
)
from ros2_memory.things.instances import Instance, Mover, PlacedStay, most_at_once
from ros2_memory.things.known import KnownThings, known_things, note_other_frames
from ros2_memory.things.places import LEAST_MM
from ros2_memory.things.unseen import describe_hung, note_undecoded, unplaced_notes, vague_notes

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.history.context import Call, Memory

_SHARE: Final = 0.1
_LEAST: Final = {"distance_m": 0.5, "max_speed": 0.1, "stood_s": 10.0, "standstills": 0.5}
_LEAST_APART_M: Final = 0.5
_LEAST_MINUTES: Final = 0.2
_LEAST_SILENT_S: Final = 10.0
_LEAST_COUNT: Final = 0.5
_SAME_MOVER_M: Final = 1.0
"""What moves by itself, and was last seen so near to where it was before, is where it was."""


def compare(
    memory: Memory,
    call: Call,
    *,
    start_s: float,
    end_s: float,
    with_start_s: float,
    with_end_s: float,
    where: JsonValue = None,
) -> Comparison:
    """Returns what differs in a window (Unix seconds, inclusive) from another one.

    `where` takes the things that are in a region in either window, and the time, the standstills
    and the points of the way in that region.

    Raises:
        InvalidArgumentsError: the bounds make no window, or `where` is no region.
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    region = None if where is None else parse_where(memory.limits, where)
    asked = TimeWindow.from_unix(start_s, end_s)
    try:
        other = TimeWindow.from_unix(with_start_s, with_end_s)
    except InvalidArgumentsError as error:
        raise InvalidArgumentsError(f"with_start and with_end: {error}") from error
    reach = min(max(asked.stop, other.stop), memory.clock.now())
    view = open_view(memory, call, reach)
    # What is not listed there is not known, rather than 0.
    unlisted: list[float | None] = [0.0, 0.0]
    for nth, window in enumerate((asked, other)):
        if gap_around(view, window) is not None:
            note_unrecorded(view, window)
            unlisted[nth] = None
    windows = call.asked = clamped(view, asked), clamped(view, other)
    frame, things = _compare_things(view, windows, region)
    drives = [drive_in(view, window) for window in windows]
    elapsed = [drive.elapsed for drive in drives]
    way = [_path_numbers(view, *of_one) for of_one in zip(drives, windows, strict=True)]
    placement = known_placement(view)
    minutes = _minutes_in_places(view, placement, windows, region, elapsed)
    way_frame, stood, farthest = _path_differences(view, placement, drives, windows, region)
    errors = [_error_counts(view, window) for window in windows]
    silences = [_silent_seconds(view, window) for window in windows]
    note_unread(view, windows[0], of="from start to end: ", gaps=False)
    note_unread(view, windows[1], of="from with_start to with_end: ", gaps=False)
    recorded = [_recorded_seconds(view, *of_one) for of_one in zip(windows, elapsed, strict=True)]
    if differ(recorded[0], recorded[1], 10.0):
        view.notes.add("not as much was recorded in both windows (recorded_s): sums differ by that")
    view.notes.retract_outside(*windows)
    if region is not None:
        view.notes.add("way, errors and silent_s are not only of that place")
    lengths = [
        passed.between(*window.asked()) for window, passed in zip(windows, elapsed, strict=True)
    ]
    return Comparison(
        oldest=min(window.start for window in windows),
        newest=max(window.stop for window in windows),
        lengths=Pair(*map(unix_from_ns, lengths)),
        recorded=Pair(*recorded),
        frame_id=frame,
        things=things,
        way=_differing(*way, least=_LEAST),
        places=_differing(*minutes, least=_LEAST_MINUTES),
        errors=_differing(*errors, least=_LEAST_COUNT, unlisted=unlisted),
        silences=_differing(*silences, least=_LEAST_SILENT_S, unlisted=unlisted),
        way_frame_id=way_frame,
        stood=stood,
        farthest=farthest,
        notes=view.notes.sentences(),
    )


def _compare_things(
    view: View, windows: tuple[TimeWindow, TimeWindow], where: Where | None
) -> tuple[str, ComparedThings]:
    """Returns the frame of things, and what became of them from the earlier window to the later."""
    limits = view.limits
    both = TimeWindow(
        min(window.start for window in windows), max(window.stop for window in windows)
    )
    for window in windows:
        note_undecoded(view, window)
        view.notes.add(*describe_hung(view, window))
    things = known_things(view, limits.min_score, both)
    note_other_frames(view, things, where)
    first, second = sorted(windows, key=lambda window: (window.start, window.stop))
    frame = next(
        (things.frames[instance.epoch] for instance in things.estimate.instances), things.frames[0]
    )
    if any(gap_around(view, window) is not None for window in windows):
        view.notes.add("things are not compared: there is nothing to compare them with")
        return frame, ComparedThings()
    if first.start == second.start:
        view.notes.add("things are not compared: the two times begin together")
        return frame, ComparedThings()
    if second.stop < first.stop:
        view.notes.add(
            f"things are not compared after {unix_text(second.asked()[1])}, where one of the two "
            "times ends within the other"
        )
    runs = {instance.epoch for instance in things.estimate.instances}
    if (
        len(runs) > 1
        and not things.has_map
        and not is_one_run(view, resolve_path_topic(view), windows)
    ):
        view.notes.add(
            "things are not recognised from one run of odometry to another, which has its own "
            "coordinates: one whose label was seen in both windows is in not_comparable"
        )
    view.notes.add(*vague_notes(things, windows), *unplaced_notes(things, (first, second)))
    places = places_asked(limits, where, things.frames)
    return frame, _ThingsBetween(things, first, second, where, places).compared()


class _StayInWindow(NamedTuple):
    """A thing's last stay in a window, and that part of the stay; how many there were at once."""

    stay: PlacedStay
    part: ThingStay
    at_once: int

    def is_elsewhere(self, other: _StayInWindow) -> bool:
        """Whether a thing was moved between this and another: to and fro is no move."""
        away_m = math.dist(self.part.place[:2], other.part.place[:2])
        return self.stay.place != other.stay.place and away_m >= LEAST_MM / 1000


@dataclass(frozen=True, slots=True)
class _ThingsBetween:
    """Compares the things of two windows. Slices (10 s) count whole, a shared one in the later.

    Attributes:
        earlier, later: the windows.
        where: what was there in either window counts; None for all.
        places: the named ones.
    """

    known: KnownThings
    earlier: TimeWindow
    later: TimeWindow
    where: Where | None
    places: Sequence[Place]

    def compared(self) -> ComparedThings:
        """Returns what differs, each list with those seen last first."""
        kinds: dict[str, list[tuple[Instance, ComparedThing]]] = defaultdict(list)
        for instance in self.known.estimate.instances:
            before = self._stay_in(instance, self.earlier, self.later.start)
            after = self._stay_in(instance, self.later)
            shared = self._stay_in(instance, self.earlier)
            if before is None and after and shared and shared.is_elsewhere(after):
                before = shared  # in slices of both windows, but elsewhere
            frame = self.known.frames[instance.epoch]
            if any(
                self.where is None or self.where.contains(frame, *stay.part.place[:2])
                for stay in (before, after)
                if stay is not None
            ):
                kind, thing = self._difference(instance, before, after)
                kinds[kind].append((instance, thing))
        same = len(kinds.pop("same", ()))
        alone, both = _paired(kinds.pop("not_looked_at", ()))
        lists = {kind: [thing for _, thing in things] for kind, things in kinds.items()}
        lists |= {"not_looked_at": alone, "not_comparable": both}
        ordered = {kind: tuple(sorted(things, key=_newest_first)) for kind, things in lists.items()}
        movers = tuple(sorted(self._movers(), key=_newest_first))
        return ComparedThings(**ordered, same=same, movers=movers)

    def _difference(
        self, instance: Instance, before: _StayInWindow | None, after: _StayInWindow | None
    ) -> tuple[str, ComparedThing]:
        """Returns what became of a thing: kind and description."""
        thing = ComparedThing(
            label=instance.label,
            before=None if before is None else before.part,
            after=None if after is None else after.part,
        )
        estimate = self.known.estimate
        if before is None and after is not None:
            window = self.earlier.start, min(self.earlier.stop, self.later.start)
            _, crossed = estimate.missing(instance, after.stay, window)
            return "not_looked_at" if crossed is None else "appeared", thing
        if before is not None and after is None:
            # At its place of the earlier window, before the later one.
            *_, last_there = (
                stay
                for stay in instance.stays
                if stay.place == before.stay.place and stay.first < self.later.start
            )
            looks, crossed = estimate.missing(instance, last_there)
            if crossed is None or crossed >= self.later.stop:
                return "not_looked_at", thing
            return "not_seen_where_expected", replace(thing, missed=crossed, looks=looks)
        if before is None or after is None or before.is_elsewhere(after):
            return "moved", thing
        if before.at_once == after.at_once:
            return "same", thing
        was, now = (replace(stay.part, at_once=stay.at_once) for stay in (before, after))
        return "more_or_fewer", replace(thing, before=was, after=now)

    def _stay_in(
        self, instance: Instance, window: TimeWindow, before: Ns = MAX_NS
    ) -> _StayInWindow | None:
        estimate, frame = self.known.estimate, self.known.frames[instance.epoch]
        for stay in reversed(instance.stays):
            rows = estimate.seen_in(stay.spots, window, before)
            if len(rows):
                place = estimate.place_of(stay, rows)
                part = self.known.stay(rows, place, frame, self.places)
                return _StayInWindow(stay, part, estimate.side_by_side(rows))
        return None

    def _movers(self) -> Iterator[ComparedMover]:
        """Yields what moves by itself and was not seen alike in both windows."""
        by_label: dict[str, tuple[list[MoverSeen], list[MoverSeen]]] = {}
        for mover in self.known.estimate.movers:
            label = self.known.estimate.names[mover.key]
            before = self._mover_in(mover, self.earlier, self.later.start)
            after = self._mover_in(mover, self.later)
            if before and after:
                away_m = math.dist(before.place[:2], after.place[:2])
                if before.at_once != after.at_once or away_m > _SAME_MOVER_M:
                    yield ComparedMover(label, before, after)
                continue
            befores, afters = by_label.setdefault(label, ([], []))
            befores += filter(None, [before])
            afters += filter(None, [after])
        for label, (befores, afters) in by_label.items():
            # In each run of odometry it is another mover: one of each window is one row.
            for before, after in zip_longest(befores, afters):
                yield ComparedMover(label, before, after)

    def _mover_in(self, mover: Mover, window: TimeWindow, before: Ns = MAX_NS) -> MoverSeen | None:
        estimate, frame = self.known.estimate, self.known.frames[mover.epoch]
        rows = self.known.seen_there(mover, window, self.where, before)
        if not len(rows):
            return None
        spots = estimate.spots[rows]
        newest = spots[spots[:, Spot.LAST].argmax()]
        x, y, z, last = newest[[Spot.X, Spot.Y, Spot.Z, Spot.LAST]].tolist()
        place = x / 1000, y / 1000, z / 1000
        return MoverSeen(
            at_once=most_at_once(spots),
            count=int(estimate.counts[rows].sum()),
            place=place,
            inside=places_at(self.places, frame, *place[:2]),
            last=last,
        )


def _paired(
    things: Sequence[tuple[Instance, ComparedThing]],
) -> tuple[list[ComparedThing], list[ComparedThing]]:
    """Returns the things that were seen in one window alone, and those that were seen in both.

    A thing of the earlier window and one of the later with its label, in another odometry, are
    taken as one.
    """
    later: dict[str, list[tuple[int, ComparedThing]]] = {}
    for instance, thing in things:
        if thing.before is None:
            later.setdefault(instance.key, []).append((instance.epoch, thing))
    alone: list[ComparedThing] = []
    both: list[ComparedThing] = []
    for instance, thing in things:
        if thing.before is None:
            continue
        candidates = later.get(instance.key, [])
        for position, (epoch, candidate) in enumerate(candidates):
            if epoch != instance.epoch:
                del candidates[position]
                both.append(replace(thing, after=candidate.after))
                break
        else:
            alone.append(thing)
    return alone + [thing for rest in later.values() for _, thing in rest], both


def _newest_first(thing: ComparedThing | ComparedMover) -> tuple[int, str]:
    seen = thing.after or thing.before
    if seen is None:
        return 0, thing.label
    return -(seen.end if isinstance(seen, ThingStay) else seen.last), thing.label


def _path_numbers(view: View, drive: Drive, window: TimeWindow) -> dict[str, float | None]:
    """Returns the numbers of the path; None for unknown ones."""
    trajectory = drive.valid_trajectory
    if trajectory is None:
        return dict.fromkeys(_LEAST)
    view.notes.add(*length_notes(trajectory))
    start, end = window.asked()
    stood = drive.stood(end - start)
    return {
        "distance_m": trajectory.totals.distance_m,
        "max_speed": trajectory.max_speed,
        "stood_s": None if stood is None else unix_from_ns(stood),
        "standstills": None if stood is None else float(len(drive.stops(end - start))),
    }


_Farthest: TypeAlias = tuple[FarFromOther | None, FarFromOther | None]
_PathDifferences: TypeAlias = tuple[str, tuple[StandstillPlace, ...], _Farthest]


def _path_differences(
    view: View,
    placement: MapPlacement | None,
    drives: Sequence[Drive],
    windows: tuple[TimeWindow, TimeWindow],
    where: Where | None,
) -> _PathDifferences:
    """Returns where the robot stood, and where it drove, in one window and not in the other.

    First the frame of these places.
    """
    unknown: _PathDifferences = "", (), (None, None)
    if placement is None or any(drive.path is None for drive in drives):
        return unknown
    frame = placement.frame_id
    if where is not None and where.frame_id not in {None, frame}:
        return unknown
    if not placement.is_map and not is_one_run(view, resolve_path_topic(view), windows):
        view.notes.add(
            f"standstills and paths are not compared: {changing_origin(frame)}, and no transforms "
            "lead to a map"
        )
        return unknown
    region = None if where is None else where.region
    places = places_asked(view.limits, where, (frame,))
    tracks = [known_track(view, frame, window).track for window in windows]
    stands = [
        [
            *placed_standstills(
                track,
                ((standstill.start, standstill.end) for standstill, _ in drive.standstills),
                region,
            )
        ]
        for track, drive in zip(tracks, drives, strict=True)
    ]
    stood: list[tuple[float, StandstillPlace]] = []
    for at in stood_at(*stands):
        this_s, other_s = (seconds or 0.0 for seconds in at.seconds)
        if differ(this_s, other_s, _LEAST["stood_s"]):
            named = at._replace(inside=places_at(places, frame, *at.place))
            stood.append((abs(this_s - other_s), named))
    stood.sort(key=lambda row: -row[0])
    points = farthest_apart((tracks[0], windows[0]), (tracks[1], windows[1]), region)
    this, other = (
        None
        if point is None or point.away_m < _LEAST_APART_M
        else point._replace(inside=places_at(places, frame, *point.place))
        for point in points
    )
    return frame, tuple(at for _, at in stood), (this, other)


def _minutes_in_places(
    view: View,
    placement: MapPlacement | None,
    windows: tuple[TimeWindow, TimeWindow],
    where: Where | None,
    elapsed: Sequence[Elapsed],
) -> list[dict[str, float | None]]:
    """Returns the minutes in each named place, or in a region, of each window.

    None where it is not known at any time of a window where the robot was.
    """
    places = view.limits.places
    if placement is None or (where is None and not places):
        return [{}, {}]
    minutes_of_windows: list[dict[str, float | None]] = []
    for window, passed in zip(windows, elapsed, strict=True):
        if where is None:
            tracks = places_in(view, places, placement, window)
            asked = [(place.name, place.region, joined) for place, joined in tracks]
        else:
            frame = placement.frame_id
            asked = [
                (place.title, place.region, known_track(view, place.frame_id or frame, window))
                for place in where.each
            ]
        minutes: dict[str, float | None] = {}
        for name, region, joined in asked:
            lasted = passed.among(stay[:2] for stay in joined.inside(region, window))
            minutes[name] = unix_from_ns(lasted) / 60 if joined.reaches(window) else None
        minutes_of_windows.append(minutes)
    # Where it was in neither window, as far as is known, nothing differs.
    been = {name for minutes in minutes_of_windows for name, lasted in minutes.items() if lasted}
    return [
        {name: lasted for name, lasted in minutes.items() if name in been}
        for minutes in minutes_of_windows
    ]


def _error_counts(view: View, window: TimeWindow) -> Mapping[str, float]:
    """Returns how often each error was reported."""
    counts: dict[str, float] = defaultdict(float)
    for events in found_events(view, window, has_errors).values():
        for error in () if events is None else events.errors:
            counts[Quoted(error.text)] += error.reports
    return counts


def _silent_seconds(view: View, window: TimeWindow) -> Mapping[str, float]:
    """Returns for how many seconds each topic was silent while the robot was on."""
    seconds: dict[str, float] = defaultdict(float)
    for silence in silences_in(view, window):
        seconds[silence.topic] += unix_from_ns(silence.length)
    return seconds


def _recorded_seconds(view: View, window: TimeWindow, elapsed: Elapsed) -> float:
    """Returns how many seconds of a window were recorded, but for pauses of less than a split."""
    start, end = window.asked()
    earliest, latest = view.snapshot.earliest, view.snapshot.latest
    if earliest is None or latest is None:
        return 0.0
    recorded = without(
        [(max(start, earliest), min(end, latest))], united(recording_gaps(view, window))
    )
    return unix_from_ns(elapsed.among(recorded))


def _differing(
    this: Mapping[str, float | None],
    other: Mapping[str, float | None],
    *,
    least: Mapping[str, float] | float,
    unlisted: Sequence[float | None] = (0.0, 0.0),
) -> tuple[tuple[str, Pair], ...]:
    """Returns the numbers that differ, those that differ most first.

    A name that one side lacks is `unlisted` there; a number that is not known on one side is
    listed.
    """
    differing: list[tuple[float, str, Pair]] = []
    for name in dict.fromkeys([*this, *other]):
        one, two = this.get(name, unlisted[0]), other.get(name, unlisted[1])
        floor = least if isinstance(least, float) else least[name]
        if one is None or two is None:
            if one is not two:
                differing.append((0.0, name, Pair(one, two)))
        elif differ(one, two, floor):
            differing.append((abs(one - two), name, Pair(one, two)))
    differing.sort(key=lambda row: (-row[0], row[1]))
    return tuple((name, pair) for _, name, pair in differing)


def differ(one: float, two: float, least: float) -> bool:
    """Whether two numbers differ by more than noise: by a tenth of the larger, and by `least`."""
    return abs(one - two) > max(least, _SHARE * max(abs(one), abs(two)))
