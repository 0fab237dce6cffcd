"""What differs between two windows: things, way, standstills, time in places, errors, silences.

A thing that was seen in both windows is compared by where it was seen last in each. A thing that
was seen in the later window only *appeared* if its place was looked at in the earlier one, so often
that missing it by chance is below 1 %. A thing that was seen in the earlier window only is not seen
where expected by the same rule. Otherwise a thing of one window is not looked at in the other.

Where odometry began again between the windows, a thing of the earlier and a thing of the later with
one label may be one thing: their places cannot be compared. People and pets have no place: they are
compared by whether they were seen, how many at once, and where last.

Two numbers differ where they are apart by more than a tenth of the larger, and by more than what
noise and the rounding of what is stored may make of equal ones (`_LEAST`).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from itertools import chain, islice, zip_longest
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

from ros2_memory.analysis.facts import has_errors
from ros2_memory.analysis.motion.trajectory import length_notes
from ros2_memory.analysis.sights import Spot, apart_m
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
    shown_span,
    unix_text,
)
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.history.view import View, clamped, open_view
from ros2_memory.insights.drive import Drive, drive_in
from ros2_memory.insights.recap import events_by_topic
from ros2_memory.insights.silences import silences_in
from ros2_memory.places.placed_standstills import placed_standstills, stood_at
from ros2_memory.places.pose_frames import (
    MapPlacement,
    changing_origin,
    is_one_run,
    known_placement,
    known_track,
    origin_notes,
    places_in,
)
from ros2_memory.places.where import Where, note_unplaced, parse_where, places_asked
from ros2_memory.results import (
    ComparedMover,
    ComparedThing,
    ComparedThings,
    Comparison,
    Pair,
    StandstillPlace,
    ThingStay,
)
from ros2_memory.things.instances import Instance, Move, Mover, PlacedStay, most_at_once
from ros2_memory.things.known import KnownThings, known_things, note_other_frames
from ros2_memory.things.places import LEAST_MM
from ros2_memory.things.unseen import (
    blind_notes,
    crowded_notes,
    describe_hung,
    look_alike_notes,
    note_undecoded,
    renamed_notes,
    scatter_notes,
    shift_notes,
    unplaced_notes,
    vague_notes,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.history.context import Call, Memory

_Kind: TypeAlias = Literal[
    "appeared",
    "more_or_fewer",
    "moved",
    "not_comparable",
    "not_looked_at",
    "not_seen_where_expected",
    "same",
]
"""The lists of `ComparedThings`, or "same"."""
_Numbers: TypeAlias = defaultdict[tuple[str, str], float]
"""Numbers above 0 by the name of the fact that they count, and by its topic."""

_SHARE: Final = 0.1
_LEAST: Final = {"distance_m": 0.5, "max_speed": 0.1, "stood_s": 10.0, "standstills": 0.5}
_LEAST_MINUTES: Final = 0.2
_LEAST_SILENT_S: Final = 10.0
_LEAST_COUNT: Final = 0.5
_LEAST_RECORDED_S: Final = 10.0
_MOST_SCATTERED: Final = 300
_OF_WINDOWS: Final = ("from start to end: ", "from with_start to with_end: ")
"""How notes on one of the two windows begin."""
_SAME_MOVER_M: Final = 1.0
"""People and pets that were last seen so near to where they were before are where they were."""


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

    `where` selects the things that are in a region in either window, and the time and the
    standstills in that region.

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
    views = _views_of(memory, call, (asked, other))
    windows = clamped(views[0], asked), clamped(views[1], other)
    call.asked = windows
    this, that = sides = _side_of(views[0], windows[0]), _side_of(views[1], windows[1])
    errors, silences = _in_both(sides, _error_counts), _in_both(sides, _silent_seconds)
    frame, things = _compare_things(sides, region)
    minutes = _minutes_in_places(sides, region)
    way_frame, stood = _compare_standstills(sides, region)
    _note_lengths(sides)
    for side, of in zip(sides, _OF_WINDOWS, strict=True):
        note_unread(side.view, side.window, of=of, gaps=False)
    notes = this.view.notes
    if differ(this.recorded_s, that.recorded_s, _LEAST_RECORDED_S):
        notes.add("not as much was recorded in both windows (recorded_s): sums differ by that")
    for side in sides:
        side.view.notes.retract_outside(*windows)
    if region is not None:
        notes.add("way, errors and silent_s are not only of that place")
    return Comparison(
        oldest=min(window.start for window in windows),
        newest=max(window.stop for window in windows),
        lengths=Pair(this.length_s, that.length_s),
        recorded=Pair(this.recorded_s, that.recorded_s),
        frame_id=frame,
        things=things,
        way=_differing(*(_path_numbers(side.drive) for side in sides), least=_LEAST),
        places=_differing(*minutes, least=_LEAST_MINUTES),
        errors=_differing(*errors, least=_LEAST_COUNT),
        silences=_differing(*silences, least=_LEAST_SILENT_S),
        way_frame_id=way_frame,
        stood=stood,
        notes=tuple(dict.fromkeys([*notes.sentences(), *that.view.notes.sentences()])),
    )


def _views_of(
    memory: Memory, call: Call, windows: tuple[TimeWindow, TimeWindow]
) -> tuple[View, View]:
    """Returns the view for each window: one for both, unless it does not show the earlier one.

    Raises:
        NoDataError: nothing is recorded.
    """
    now = memory.clock.now()
    view = open_view(memory, call, min(max(window.stop for window in windows), now))

    def view_of(window: TimeWindow) -> View:
        older = view.snapshot.older
        if older is None or window.start > older:
            return view
        own = open_view(memory, call, min(window.stop, now))
        return view if own.timeline is view.timeline else own

    return view_of(windows[0]), view_of(windows[1])


class _Side(NamedTuple):
    """One of the two windows, and what is compared of it.

    Attributes:
        view: shows the days of the window.
        is_recorded: whether anything was recorded in it.
        placement: the frames of the robot's poses and of places; None without poses.
        length_s: how long the window is.
        recorded_s: how much of it was recorded.
    """

    view: View
    window: TimeWindow
    is_recorded: bool
    drive: Drive
    placement: MapPlacement | None
    length_s: float
    recorded_s: float

    def none_on(self, topics: Iterable[str]) -> float | None:
        """Returns the number of reports where none is listed: 0, or None if no topic was recorded.

        A log counts as recorded if anything was: it has messages only when something happens.
        """
        timeline = self.view.timeline
        are_recorded = any(
            timeline.is_log(topic) or any(timeline.extents(topic, self.window)) for topic in topics
        )
        return 0.0 if self.is_recorded and are_recorded else None


def _side_of(view: View, window: TimeWindow) -> _Side:
    is_recorded = gap_around(view, window) is None
    if not is_recorded:
        note_unrecorded(view, window)
    drive = drive_in(view, window)
    return _Side(
        view,
        window,
        is_recorded,
        drive,
        known_placement(view),
        unix_from_ns(drive.elapsed.between(*window.asked())),
        _recorded_seconds(view, window, drive.elapsed),
    )


def _compare_things(sides: tuple[_Side, _Side], where: Where | None) -> tuple[str, ComparedThings]:
    """Returns the frame of things, and what became of them from the earlier window to the later."""
    first, second = sorted(sides, key=lambda side: (side.window.start, side.window.stop))
    view, earlier, later = second.view, first.window, second.window
    limits = view.limits
    for side in sides:
        note_undecoded(side.view, side.window)
        side.view.notes.add(*describe_hung(side.view, side.window))
    if first.view is not view:
        view.notes.add(
            "things are not compared: so many bags lie between the two times that they are not "
            "looked at together; find_things answers about each"
        )
        return "", ComparedThings()
    things = known_things(
        view, limits.min_score, TimeWindow(earlier.start, max(earlier.stop, later.stop))
    )
    view.notes.add(*blind_notes(things, (earlier, later)))
    note_other_frames(view, things, where)
    view.notes.add(*origin_notes(view, view.pose_topic, (earlier, later)))
    epochs = [instance.epoch for instance in things.estimate.instances]
    frame = things.frames[epochs[0] if epochs else 0]
    why_not = _why_incomparable(first, second)
    if why_not:
        view.notes.add(f"things are not compared: {why_not}")
        return frame, ComparedThings()
    if later.stop < earlier.stop:
        view.notes.add(
            f"things are not compared after {unix_text(later.asked()[1])}, where one of the two "
            "times ends within the other"
        )
    has_runs = len({*epochs}) > 1 and not things.has_map
    if has_runs and not _are_of_one_run(sides):
        view.notes.add(
            "things are not recognised from one run of odometry to another, which has its own "
            "coordinates: one whose label was seen in both windows is in not_comparable"
        )
    places = places_asked(limits, where, things.frames)
    return frame, _compared_with_notes(view, _ThingsBetween(things, earlier, later, where, places))


def _why_incomparable(first: _Side, second: _Side) -> str:
    """Returns why the things of two windows cannot be compared; empty if they can."""
    if not (first.is_recorded and second.is_recorded):
        return "there is nothing to compare them with"
    if first.window.start == second.window.start:
        return "the two times begin together"
    return ""


def _compared_with_notes(view: View, between: _ThingsBetween) -> ComparedThings:
    """Returns what became of things, and notes what that does not say."""
    things, windows = between.known, (between.earlier, between.later)
    view.notes.add(*vague_notes(things, windows), *unplaced_notes(things, windows))
    view.notes.add(*crowded_notes(things))
    compared, moves = between.compare()
    view.notes.add(*look_alike_notes(things, moves), *shift_notes(moves, compared.same))
    view.notes.add(*scatter_notes(between.scattered(compared)))
    missed = {thing.label for thing in compared.not_seen_where_expected}
    instances = (thing for thing in things.estimate.instances if thing.label in missed)
    view.notes.add(*renamed_notes(things, islice(instances, _MOST_SCATTERED)))
    return compared


def _are_of_one_run(sides: tuple[_Side, _Side]) -> bool:
    """Returns whether all poses of two windows are known to be of one run of odometry."""
    this, that = sides
    if this.view is not that.view:
        return False
    return is_one_run(this.view, resolve_path_topic(this.view), (this.window, that.window))


class _StayInWindow(NamedTuple):
    """A thing's last stay in a window.

    Attributes:
        part: the part of the stay in the window.
        at_once: how many of the label were there at once.
    """

    stay: PlacedStay
    part: ThingStay
    at_once: int

    def is_elsewhere(self, other: _StayInWindow) -> bool:
        """Returns whether a thing was moved between two stays: to and fro is no move."""
        away_m = apart_m(self.part.place, other.part.place)
        return self.stay.place != other.stay.place and away_m >= LEAST_MM / 1000


@dataclass(frozen=True, slots=True)
class _ThingsBetween:
    """Compares the things of two windows.

    Slices (10 s) count as a whole. A slice of both windows counts in the later one.

    Attributes:
        earlier, later: the windows.
        where: the region in which a thing must be in either window; None for anywhere.
        places: the named places.
    """

    known: KnownThings
    earlier: TimeWindow
    later: TimeWindow
    where: Where | None
    places: Sequence[Place]

    def compare(self) -> tuple[ComparedThings, Sequence[Move]]:
        """Returns what differs, each list with the rarest labels first, and the moves."""
        lists: dict[_Kind, list[ComparedThing]] = defaultdict(list)
        not_looked_at: list[tuple[Instance, ComparedThing]] = []
        moves: list[Move] = []
        same = 0
        for instance in self.known.estimate.instances:
            before = self._last_stay(instance, self.earlier, self.later.start)
            after = self._last_stay(instance, self.later)
            if before is None and after is not None:
                shared = self._last_stay(instance, self.earlier)
                if shared is not None and shared.is_elsewhere(after):
                    before = shared  # in slices of both windows, but elsewhere
            if not self._is_inside(instance, before) and not self._is_inside(instance, after):
                continue
            kind, thing = self._difference(instance, before, after)
            if kind == "moved" and before is not None and after is not None:
                moves.append(Move(instance, before.stay, after.stay))
            if kind == "same":
                same += 1
            elif kind == "not_looked_at":
                not_looked_at.append((instance, thing))
            else:
                lists[kind].append(thing)
        lists["not_looked_at"], lists["not_comparable"] = _pair_across_runs(not_looked_at)
        ordered = {kind: _rarest_first(things) for kind, things in lists.items()}
        movers = tuple(sorted(self._movers(), key=_newest_first))
        return ComparedThings(**ordered, same=same, movers=movers), moves

    def scattered(self, compared: ComparedThings) -> Iterator[tuple[Instance, PlacedStay]]:
        """Yields the things of the labels of which one came or went, with their last stays.

        They are as many as a note can look through.
        """
        came_or_went = (*compared.appeared, *compared.not_seen_where_expected)
        labels = {thing.label for thing in (*came_or_went, *compared.not_looked_at)}
        of_labels = (
            (instance, instance.stays[-1])
            for instance in self.known.estimate.instances
            if instance.label in labels
        )
        return islice(of_labels, _MOST_SCATTERED)

    def _is_inside(self, instance: Instance, stay: _StayInWindow | None) -> bool:
        """Returns whether a thing has a stay in the region."""
        if stay is None or self.where is None:
            return stay is not None
        return self.where.contains(self.known.frames[instance.epoch], stay.part.place)

    def _is_blind(self, time: Ns) -> bool:
        """Returns whether a detector was blind at a time, which later sights may have shown."""
        return any(blind.first <= time <= blind.last for blind in self.known.by_all.estimate.blind)

    def _difference(
        self, instance: Instance, before: _StayInWindow | None, after: _StayInWindow | None
    ) -> tuple[_Kind, ComparedThing]:
        """Returns which list of `ComparedThings` a thing is in, or "same", and the thing."""
        thing = ComparedThing(
            label=instance.label,
            before=None if before is None else before.part,
            after=None if after is None else after.part,
            id=instance.id,
        )
        estimate = self.known.estimate
        if before is None and after is not None:
            window = self.earlier.start, min(self.earlier.stop, self.later.start)
            _, missed = estimate.missing(instance, after.stay, window)
            was_looked_at = missed is not None and not self._is_blind(missed)
            return "appeared" if was_looked_at else "not_looked_at", thing
        if before is not None and after is None:
            # Its last stay at the same place before the later window.
            *_, last_there = (
                stay
                for stay in instance.stays
                if stay.place == before.stay.place and stay.first < self.later.start
            )
            looks, missed = estimate.missing(instance, last_there)
            if missed is None or missed >= self.later.stop or self._is_blind(missed):
                return "not_looked_at", thing
            return "not_seen_where_expected", replace(thing, missed=missed, looks=looks)
        if before is None or after is None:
            return "moved", thing
        is_number_equal = before.at_once == after.at_once
        if not is_number_equal:
            was, now = (replace(stay.part, at_once=stay.at_once) for stay in (before, after))
            thing = replace(thing, before=was, after=now)
        if before.is_elsewhere(after):
            return "moved", thing
        return "same" if is_number_equal else "more_or_fewer", thing

    def _last_stay(
        self, instance: Instance, window: TimeWindow, before: Ns = MAX_NS
    ) -> _StayInWindow | None:
        """Returns a thing's last stay in a window, of slices that end before a time."""
        estimate, frame = self.known.estimate, self.known.frames[instance.epoch]
        for stay in reversed(instance.stays):
            rows = estimate.seen_in(stay.spots, window, before)
            if len(rows):
                place = estimate.place_of(stay, rows)
                part = self.known.describe_stay(rows, place, frame, self.places)
                return _StayInWindow(stay, part, estimate.side_by_side(rows))
        return None

    def _movers(self) -> Iterator[ComparedMover]:
        """Yields the people, pets and other movers that differ between the windows."""
        alone: dict[str, tuple[list[ThingStay], list[ThingStay]]] = {}
        for mover in self.known.estimate.movers:
            label = self.known.estimate.names[mover.key]
            before = self._last_seen(mover, self.earlier, self.later.start)
            after = self._last_seen(mover, self.later)
            befores, afters = alone.setdefault(label, ([], []))
            if before is not None and after is not None:
                away_m = apart_m(before.place, after.place)
                if before.at_once != after.at_once or away_m > _SAME_MOVER_M:
                    yield ComparedMover(label, before, after)
            elif before is not None:
                befores.append(before)
            elif after is not None:
                afters.append(after)
        for label, (befores, afters) in alone.items():
            # Each run of odometry has its own mover: one of each window make a row.
            for earlier, later in zip_longest(befores, afters):
                yield ComparedMover(label, earlier, later)

    def _last_seen(self, mover: Mover, window: TimeWindow, before: Ns = MAX_NS) -> ThingStay | None:
        """Returns where a mover was last seen in a window, in slices that end before a time."""
        estimate, frame = self.known.estimate, self.known.frames[mover.epoch]
        rows = self.known.seen_inside(mover, window, self.where, before)
        if not len(rows):
            return None
        spots = estimate.spots[rows]
        newest = spots[spots[:, Spot.LAST].argmax()]
        x, y, z = (newest[[Spot.X, Spot.Y, Spot.Z]] / 1000).tolist()
        seen = self.known.describe_stay(rows, (x, y, z), frame, self.places)
        return replace(seen, at_once=most_at_once(spots))


def _pair_across_runs(
    things: Sequence[tuple[Instance, ComparedThing]],
) -> tuple[list[ComparedThing], list[ComparedThing]]:
    """Returns the things of one window alone, and pairs that may be one thing in two runs.

    A pair has one label, a thing of the earlier window, and one of the later in other odometry.
    """
    later: dict[str, list[tuple[int, ComparedThing]]] = defaultdict(list)
    for instance, thing in things:
        if thing.before is None:
            later[instance.key].append((instance.epoch, thing))
    alone: list[ComparedThing] = []
    pairs: list[ComparedThing] = []
    for instance, thing in things:
        if thing.before is None:
            continue
        candidates = later[instance.key]
        others = [candidate for candidate in candidates if candidate[0] != instance.epoch]
        if not others:
            alone.append(thing)
            continue
        candidates.remove(others[0])
        _, partner = others[0]
        pairs.append(replace(thing, after=partner.after))
    for candidates in later.values():
        alone += [thing for _, thing in candidates]
    return alone, pairs


def _rarest_first(things: Sequence[ComparedThing]) -> tuple[ComparedThing, ...]:
    """Returns things in the order of how many have their label; of equals those seen last first.

    A reply has the first ones: a crate, and not five of a vineyard's grapes.
    """
    often = Counter(thing.label for thing in things)
    return tuple(sorted(things, key=lambda thing: (often[thing.label], *_newest_first(thing))))


def _newest_first(thing: ComparedThing | ComparedMover) -> tuple[int, str]:
    seen = thing.after or thing.before
    if seen is None:
        return 0, thing.label
    return -seen.end, thing.label


def _path_numbers(drive: Drive) -> dict[str, float | None]:
    """Returns the numbers of a path by the names in `_LEAST`; None for an unknown number."""
    trajectory, stood = drive.valid_trajectory, drive.stood
    if trajectory is None:
        return dict.fromkeys(_LEAST)
    return {
        "distance_m": trajectory.totals.distance_m,
        "max_speed": trajectory.max_speed,
        "stood_s": None if stood is None else unix_from_ns(stood),
        "standstills": None if stood is None else float(len(drive.stops)),
    }


def _note_lengths(sides: tuple[_Side, _Side]) -> None:
    """Notes what the length of each path leaves out; what holds for both windows once."""
    trajectories = [side.drive.valid_trajectory for side in sides]
    of_sides = [() if path is None else tuple(length_notes(path)) for path in trajectories]
    of_both = set.intersection(*map(set, of_sides))
    for side, own_notes, of in zip(sides, of_sides, _OF_WINDOWS, strict=True):
        side.view.notes.add(*(note if note in of_both else f"{of}{note}" for note in own_notes))


def _compare_standstills(
    sides: tuple[_Side, _Side], where: Where | None
) -> tuple[str, tuple[StandstillPlace, ...]]:
    """Returns where the robot stood longer in one window, the largest difference first.

    The frame of the places comes before them; it is empty if they cannot be compared.
    """
    view = sides[0].view
    placement, *others = {side.placement for side in sides}
    if placement is None or others or any(side.drive.path is None for side in sides):
        return "", ()
    frame = placement.frame_id
    if where is not None and where.frame_id not in {None, frame}:
        return "", ()
    if not placement.is_map and not _are_of_one_run(sides):
        view.notes.add(
            f"standstills are not compared: {changing_origin(frame)}, and no transforms lead to a "
            "map"
        )
        return "", ()
    region = None if where is None else where.region
    places = places_asked(view.limits, where, (frame,))
    stands = []
    for side in sides:
        track = known_track(side.view, frame, side.window).track
        spans = (stop.span for stop in side.drive.standstills)
        stands.append([*placed_standstills(track, spans, region)])
    stood = (
        at._replace(inside=places_at(places, {frame: at.place}))
        for at in _standstill_differences(stood_at(*stands))
    )
    return frame, tuple(stood)


def _standstill_differences(places: Iterable[StandstillPlace]) -> list[StandstillPlace]:
    """Returns the places where the robot stood longer in one window, the largest first."""
    differences: list[tuple[float, StandstillPlace]] = []
    for at in places:
        this_s, other_s = (seconds or 0.0 for seconds in at.seconds)
        if differ(this_s, other_s, _LEAST["stood_s"]):
            differences.append((abs(this_s - other_s), at))
    differences.sort(key=lambda difference: -difference[0])
    return [at for _, at in differences]


def _minutes_in_places(
    sides: tuple[_Side, _Side], where: Where | None
) -> list[dict[str, float | None]]:
    """Returns for each window the minutes in each named place, or in a region.

    A number is None if it is unknown at all times of the window where the robot was. Places where
    the robot was in neither window are left out.
    """
    minutes_of_windows: list[dict[str, float | None]] = []
    for side in sides:
        if side.placement is None:
            return [{}, {}]
        minutes_of_windows.append(_minutes_of(side, side.placement, where))
    visited = {name for minutes in minutes_of_windows for name, lasted in minutes.items() if lasted}
    return [{name: minutes.get(name) for name in visited} for minutes in minutes_of_windows]


def _minutes_of(
    side: _Side, placement: MapPlacement, where: Where | None
) -> dict[str, float | None]:
    """Returns the minutes in each named place, or in each place of a region, in a window."""
    view, window = side.view, side.window
    if where is None:
        tracks = places_in(view, view.limits.places, placement, window)
    else:
        places = where.places(placement.frame_id)
        tracks = [(place, known_track(view, place.frame_id, window)) for place in places]
    minutes: dict[str, float | None] = {}
    for place, track in tracks:
        if not track.reaches(window):
            minutes[place.name] = None
            continue
        note_unplaced(view, track, window)
        lasted = side.drive.elapsed.among(stay.span for stay in track.inside(place.region, window))
        minutes[place.name] = unix_from_ns(lasted) / 60
    return minutes


def _error_counts(view: View, window: TimeWindow) -> _Numbers:
    """Returns how often each error was reported, by its text and its topic."""
    counts: _Numbers = defaultdict(float)
    for topic, events in events_by_topic(view, window, has_errors).items():
        for error in events.errors:
            counts[Quoted(error.text), topic] += error.reports
    return counts


def _silent_seconds(view: View, window: TimeWindow) -> _Numbers:
    """Returns how many seconds each topic was silent while the robot was on, as `_Numbers`."""
    seconds: _Numbers = defaultdict(float)
    for silence in silences_in(view, window):
        seconds[silence.topic, silence.topic] += unix_from_ns(silence.length)
    return seconds


def _in_both(
    sides: tuple[_Side, _Side], count: Callable[[View, TimeWindow], _Numbers]
) -> list[dict[str, float | None]]:
    """Returns what is counted in each window by name, with the names of the other one as well."""
    numbers = [count(side.view, side.window) for side in sides]
    topics: dict[str, set[str]] = defaultdict(set)
    for name, topic in chain(*numbers):
        topics[name].add(topic)
    return [
        {
            name: sum(of_side[name, topic] for topic in among) or side.none_on(among)
            for name, among in topics.items()
        }
        for side, of_side in zip(sides, numbers, strict=True)
    ]


def _recorded_seconds(view: View, window: TimeWindow, elapsed: Elapsed) -> float:
    """Returns how many seconds of a window were recorded. Pauses shorter than a split count."""
    recorded = without([shown_span(view.snapshot, window)], united(recording_gaps(view, window)))
    return unix_from_ns(elapsed.among(recorded))


def _differing(
    this: Mapping[str, float | None],
    other: Mapping[str, float | None],
    *,
    least: Mapping[str, float] | float,
) -> tuple[tuple[str, Pair], ...]:
    """Returns the numbers that differ, the largest difference first, by name.

    Both have the same names. A number that is unknown on one side only differs.
    """
    pairs: dict[str, Pair] = {}
    differences: dict[str, float] = {}
    for name, one in this.items():
        two = other[name]
        pairs[name] = Pair(one, two)
        if one is None or two is None:
            if one is not two:
                differences[name] = 0.0
        elif differ(one, two, least if isinstance(least, float) else least[name]):
            differences[name] = abs(one - two)
    ordered = sorted(differences, key=lambda name: (-differences[name], name))
    return tuple((name, pairs[name]) for name in ordered)


def differ(one: float, two: float, least: float) -> bool:
    """Returns whether two numbers differ by more than a tenth of the larger, and than `least`."""
    return abs(one - two) > max(least, _SHARE * max(abs(one), abs(two)))
