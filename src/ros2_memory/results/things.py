"""Results about things: where they are and were, and what differs between two windows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.reply import (
    AGO,
    COUNTS_BY_NAME,
    INSIDE,
    LOCAL_OF_DAYS,
    NAME,
    NAMES,
    OBJECT,
    OBJECTS,
    PAIRS,
    PLAIN,
    TIME,
    TOTAL,
    YAW,
    Absent,
    AnswerWithNotes,
    JsonObject,
    Keys,
    Scope,
    Unit,
    an_object,
    by_name,
    digits,
    itself_if,
    keys,
    moment,
    objects,
    result,
    shown,
    unit,
    vector,
)
from ros2_memory.core.text import named, shortened

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue, Vector3
    from ros2_memory.core.timebase import Ns

_XY: Final = vector("xy", 2)
_LONGEST_NAME: Final = 100
"""Characters of the text of an error."""
_MISSED: Final = "not_seen_where_expected"
_MOST_STAYS: Final = 8
"""Newest places of a thing that are listed, unless a reply becomes too long."""
_MOST_DIFFERENCES: Final = 5
"""Things of each kind of difference that are listed, unless a reply becomes too long."""
_DIFFERENCES: Final = (
    "moved",
    "appeared",
    _MISSED,
    "not_looked_at",
    "not_comparable",
    "more_or_fewer",
    "movers",
)
"""What may differ of things between two windows, in the order of the reply."""
_LABEL: Final = unit(lambda label: shortened(named(label), 40))


@result(
    TIME("from", "start"),
    TIME("to", "end"),
    LOCAL_OF_DAYS("local", "start", "end"),
    _XY("place"),
    INSIDE("inside"),
    PLAIN("times", "count"),
)
class ThingStay:
    """An interval in which a thing was at a place.

    Attributes:
        start: when it was first seen there.
        end: when it was last seen there.
        place: in metres.
        count: how often it was seen there.
        inside: the named places around it, the smallest first.
        at_once: how many such things were there; None if they are not compared.
    """

    start: Ns
    end: Ns
    place: Vector3
    count: int
    inside: tuple[str, ...] = ()
    at_once: int | None = None


@result(
    _XY("place"),
    INSIDE("inside"),
    digits(2)("share"),
    PLAIN("hours").if_any,
    digits(2)("likely_now", "likely"),
)
class UsualPlace:
    """A place where a thing usually is.

    Attributes:
        place: in metres.
        inside: the named places around it, the smallest first.
        share: of the hours in which the thing was seen, 0 to 1.
        hours: when it is there by the local clock, as "07-09, 16-23": until 09:00 and 23:00.
        likely: how likely it is there now, 0 to 1.
    """

    place: Vector3
    inside: tuple[str, ...]
    share: float
    hours: str
    likely: float


@result(PAIRS.spread("state", "by_state"), PLAIN("looks").if_any)
class StillThere:
    """The state of a thing since it was last seen, as in the reply.

    Attributes:
        state: `in_view`, `seen_since`, `not_looked_at_since` or `not_seen_where_expected`.
        at: when it was seen again, last seen, or known to be missed.
        looks: detector messages that should have had it.
    """

    state: str
    at: Ns
    looks: int = 0

    @property
    def by_state(self) -> JsonObject:
        """The time under its state."""
        return {self.state: moment(self.at)}


def _usual_places(places: tuple[UsualPlace, ...], scope: Scope) -> JsonValue:
    return [shown(place, scope) for place in places] or "no pattern"


_USUALLY: Final = Unit(_usual_places)


def _other_frame(frame_id: str, scope: Scope) -> JsonValue | Absent:
    """Returns a frame, unless it is that of the whole reply."""
    return Absent.ABSENT if frame_id == getattr(scope.answer, "frame_id", None) else named(frame_id)


def thing(most_stays: int) -> Keys:
    """Returns the keys of a thing with the `most_stays` newest of its places."""
    return keys(
        NAME("label").in_short,
        NAME("id").if_any.in_short,
        COUNTS_BY_NAME("labels").if_any,
        NAMES("misread_as").if_any,
        PLAIN("moves").if_any.in_short,
        PLAIN("at_once").if_known.in_short,
        vector("xyz", 2)("place").in_short,
        digits(2)("spread_m"),
        Unit(_other_frame)("frame_id").in_short,
        INSIDE("inside").in_short,
        digits(2)("near_m").if_known,
        TIME("first_seen", "first"),
        TIME("last_seen", "last").in_short,
        LOCAL_OF_DAYS("local", "first", "last").in_short,
        AGO("ago_s", "last"),
        "count",
        an_object(keys(digits(3)("best"), digits(3)("median")))(
            "score", itself_if("best")
        ).if_known,
        an_object(keys(_XY.spread("robot"), YAW("yaw")))("seen_from", itself_if("robot")).if_known,
        OBJECT("still_there").if_known,
        PLAIN("moved_times").if_known.in_short,
        OBJECTS("moved").last(most_stays, "").if_any,
        _USUALLY("usually").if_known,
    )


@result()
class Thing:
    """One thing that detectors saw, or one label of things that move by themselves.

    Attributes:
        label: its name.
        id: what detectors tell it by from others of its name; empty if nothing lasts.
        place: its last place (m), in `frame_id`.
        spread_m: root mean square distance of its detections from `place`.
        inside: the named places that it is in, the smallest first.
        best, median: of its scores; None without scores.
        robot: x, y (m) and yaw (rad) from which it was last seen; None if that is not known.
        still_there: what is known of it since then.
        moved: its places in order; empty if it has one place.
        misread_as: labels of other things that were given to it.
        labels: how often each of several labels was given to it, the commonest first.
        at_once: how many were seen at the same time, of movers and of several things at one place;
            else None.
        moves: whether it moves by itself.
        near_m: its distance from the thing or point that was asked about.
        usually: where it usually is, by the hour. None if too little is known to say; empty if the
            hours say no more than its last place.
    """

    label: str
    place: Vector3
    spread_m: float
    frame_id: str
    inside: tuple[str, ...]
    first: Ns
    last: Ns
    count: int
    best: float | None
    median: float | None
    robot: tuple[float, float, float] | None
    still_there: StillThere | None
    id: str = ""
    moved: tuple[ThingStay, ...] = ()
    misread_as: tuple[str, ...] = ()
    labels: tuple[tuple[str, int], ...] = ()
    at_once: int | None = None
    moves: bool = False
    near_m: float | None = None
    usually: tuple[UsualPlace, ...] | None = None

    @property
    def yaw(self) -> float | None:
        """The heading (rad) of the robot when it last saw the thing."""
        return None if self.robot is None else self.robot[2]

    @property
    def moved_times(self) -> int | None:
        """How often the thing moved; None if it has one place."""
        return len(self.moved) - 1 if self.moved else None

    @property
    def since(self) -> Ns | None:
        """When the thing was first seen at its last place; None if it has one place."""
        return self.moved[-1].start if self.moved else None

    @property
    def before(self) -> str:
        """The named place in which the thing was before; empty if none, or if it did not move."""
        return next(iter(self.moved[-2].inside), "") if len(self.moved) > 1 else ""

    @property
    def missed_there(self) -> StillThere | None:
        """What is known of the thing since it was last seen, if it was missed."""
        known = self.still_there
        return known if known is not None and known.state == _MISSED else None


SHORT_THING: Final = Keys(
    (
        *thing(1).short.keys,
        TIME("since").if_known,
        NAME("before").if_any,
        OBJECT("still_there", "missed_there").if_known,
    )
)
"""The label of a thing, its last place, since when, the place before, and whether it was missed."""


def listed_things(form: Keys) -> Keys:
    """Returns the keys of `Things`; `form` are those of each thing."""
    return keys(
        NAME("frame_id"),
        objects(form)("things").along("last_seen"),
        TOTAL("total", "total", "all_counted").added,
        COUNTS_BY_NAME("labels").added,
        span=("oldest", "now"),
    )


@result(*listed_things(thing(_MOST_STAYS)).keys, span=("oldest", "now"))
class Things(AnswerWithNotes):
    """Things, the last seen first. `total` and `labels` count those that are not listed, too."""

    frame_id: str
    things: tuple[Thing, ...]
    total: int
    labels: tuple[tuple[str, int], ...]
    now: Ns
    all_counted: bool = True

    @property
    def oldest(self) -> Ns | None:
        """The oldest time of the reply."""
        return min((thing.first for thing in self.things), default=None)


class Pair(NamedTuple):
    """A number in each of two compared windows; None if it is not known."""

    this: float | None
    other: float | None


def _unit_of_pairs(places: int) -> Unit:
    """Returns the unit of a pair with numbers of so many decimal places."""
    return an_object(keys(digits(places)("this"), digits(places)("with", "other")))


def _named_pairs(places: int) -> Unit:
    """Returns the unit of pairs by name, with numbers of so many decimal places."""
    return by_name(_unit_of_pairs(places), _LONGEST_NAME)


def _spot(name: str, time: str) -> Unit:
    """Returns the unit of a stay: its place, and the time in the attribute `time` as `name`."""
    place = (_XY.spread("place"), INSIDE("inside"))
    seen = (TIME(name, time), LOCAL_OF_DAYS("local", time))
    return an_object(keys(*place, *seen, PLAIN("at_once").if_known))


@result(
    _LABEL("label"),
    NAME("id").if_any,
    _spot("last_seen", "end")("was", "before").if_known,
    _spot("first_seen", "start")("is", "after").if_known,
    TIME("missed_by", "missed").if_known,
    PLAIN("looks").when("missed"),
)
class ComparedThing:
    """A thing in the earlier and in the later window.

    Attributes:
        before: where it was in the earlier window; None if it was not known then.
        after: where it was in the later window; None if it was not seen then.
        missed: when it was not seen where expected.
        looks: detector messages that should have had it.
        id: as of `Thing`.
    """

    label: str
    before: ThingStay | None
    after: ThingStay | None
    missed: Ns | None = None
    looks: int = 0
    id: str = ""


_MOVER: Final = an_object(
    keys(
        PLAIN("times", "count"),
        "at_once",
        _XY.spread("place"),
        INSIDE("inside"),
        TIME("last_seen", "end"),
        LOCAL_OF_DAYS("local", "end"),
    )
)
"""A mover in a window: how many at most at once, how often seen, and its last place (m)."""


@result(_LABEL("label"), _MOVER("was", "before").if_known, _MOVER("is", "after").if_known)
class ComparedMover:
    """A mover in the earlier and in the later window; None where it was not seen."""

    label: str
    before: ThingStay | None
    after: ThingStay | None


def _differences(most: int) -> Keys:
    """Returns the keys of `ComparedThings` with at most so many of each; twice as many moved."""
    others = (OBJECTS(name).first(most, "total").if_any for name in _DIFFERENCES[1:])
    return keys(OBJECTS("moved").first(2 * most, "total").if_any, *others)


@result()
class ComparedThings:
    """The things that differ between two windows.

    Attributes:
        moved, appeared, not_seen_where_expected, not_looked_at: in the later window.
        same: how many things do not differ.
        movers: what moves by itself.
        not_comparable: seen in both, in the coordinates of different runs of odometry.
        more_or_fewer: things at one place whose number differs.
    """

    moved: tuple[ComparedThing, ...] = ()
    appeared: tuple[ComparedThing, ...] = ()
    not_seen_where_expected: tuple[ComparedThing, ...] = ()
    not_looked_at: tuple[ComparedThing, ...] = ()
    same: int = 0
    movers: tuple[ComparedMover, ...] = ()
    not_comparable: tuple[ComparedThing, ...] = ()
    more_or_fewer: tuple[ComparedThing, ...] = ()

    @property
    def is_any(self) -> bool:
        """Whether anything differs."""
        return any(getattr(self, name) for name in _DIFFERENCES)


class StandstillPlace(NamedTuple):
    """A place where the robot stood in one window longer than in the other.

    Attributes:
        place: in metres.
        inside: the named places around it, the smallest first.
        seconds: for how long it stood there in each window.
    """

    place: Vector3
    inside: tuple[str, ...]
    seconds: Pair


_STANDSTILLS: Final = objects(
    keys(
        _XY.spread("place"),
        INSIDE("inside"),
        _unit_of_pairs(0).spread("seconds"),
    )
)


def compared(most: int) -> Keys:
    """Returns the keys of a `Comparison` with at most so many rows of each kind.

    A part without differences is left out.
    """
    return keys(
        _unit_of_pairs(1)("duration_s", "lengths"),
        _unit_of_pairs(1)("recorded_s", "recorded").in_short,
        PAIRS.spread("frames"),
        an_object(_differences(most))("things"),
        PLAIN("things_unchanged", "things.same").in_short,
        _named_pairs(2)("way").if_any.in_short,
        _STANDSTILLS("stood_at", "stood").first(most, "total").if_any,
        _named_pairs(2)("minutes", "places").first(most, "total").if_any,
        _named_pairs(0)("errors").first(most, "total").if_any.in_short,
        _named_pairs(0)("silent_s", "silences").first(most, "total").if_any,
        span=("oldest", "newest"),
    )


@result(*compared(_MOST_DIFFERENCES).keys, span=("oldest", "newest"))
class Comparison(AnswerWithNotes):
    """What differs between two windows.

    Attributes:
        oldest: where the earlier window begins.
        newest: where the later window ends.
        lengths: of the windows (s).
        recorded: how much of each window was recorded (s).
        frame_id: of the places of things.
        things: that differ.
        way: numbers of the path by name: metres, m/s, seconds and counts.
        places: minutes in each named place.
        errors: how often each error was reported.
        silences: for how many seconds each topic was silent.
        way_frame_id: of the places where the robot stood.
        stood: where it stood in one window longer than in the other.
    """

    oldest: Ns
    newest: Ns
    lengths: Pair
    recorded: Pair
    frame_id: str
    things: ComparedThings
    way: tuple[tuple[str, Pair], ...]
    places: tuple[tuple[str, Pair], ...]
    errors: tuple[tuple[str, Pair], ...]
    silences: tuple[tuple[str, Pair], ...]
    way_frame_id: str = ""
    stood: tuple[StandstillPlace, ...] = ()

    @property
    def frames(self) -> JsonObject:
        """The frames of the places shown: of things, and of standstills if it is another."""
        frames: list[str | None] = []
        if self.things.is_any:
            frames.append(self.frame_id or None)
        if self.stood and self.way_frame_id not in frames:
            frames.append(self.way_frame_id)
        names = [frame and named(frame) for frame in frames]
        return dict(zip(("frame_id", "way_frame_id"), names, strict=False))
