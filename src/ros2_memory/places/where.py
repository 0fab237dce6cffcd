"""The argument `where`: a named place, a circle or a rectangle, and when the robot was there.

Of several places any counts: a thing, or the robot, is there where it is in one of them.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.regions import AnyOf, Circle, Place, Rectangle
from ros2_memory.core.text import abbreviate
from ros2_memory.places.region_visits import track_in
from ros2_memory.places.robot_tracks import robot_inside

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.core.model import JsonValue, TimeWindow
    from ros2_memory.core.regions import Region
    from ros2_memory.history.context import QuerySettings
    from ros2_memory.history.view import View
    from ros2_memory.places.pose_frames import MapPlacement
    from ros2_memory.places.robot_tracks import Inside

PLACES_SETTING: Final = "data.places_file (for a fleet: fleet.places)"
"""Where places are named, for sentences."""
_EXPECTED: Final = (
    "give the name of a place, "
    '{"x": 1.0, "y": 2.0, "radius_m": 0.5}, or {"x": [0, 5], "y": [5, 9]} (m); '
    'several as "kitchen, hall", or by name: {"kitchen": {"x": [0, 5], "y": [5, 9]}, "hall": ...}'
)
_OF_REGION: Final = frozenset({"x", "y", "radius_m"})
_MOST_PLACES: Final = 30
_UNNAMED: Final = "where"
"""What a region without a name is called in tables."""


@dataclass(frozen=True, slots=True)
class Where:
    """A region, and the frame that it is in.

    Attributes:
        frame_id: None for the frame that places are in by default.
        name: of a named place, or of several; None for any other region.
        several: these, each with a name, where the region is that of several places.
    """

    region: Region
    frame_id: str | None = None
    name: str | None = None
    several: tuple[Where, ...] = ()

    def contains(self, frame_id: str, x: float, y: float) -> bool:
        """Whether a point (m) of a frame lies in the region."""
        return self.frame_id in {None, frame_id} and self.region.contains(x, y)

    @property
    def each(self) -> tuple[Where, ...]:
        """The places that it is made of: itself, where it is one."""
        return self.several or (self,)

    @property
    def title(self) -> str:
        """What a row about it is called."""
        return self.name or _UNNAMED

    def places(self, frame_id: str) -> tuple[Place, ...]:
        """Returns each of its places by name; `frame_id` is the frame of those that name none."""
        frame = self.frame_id or frame_id
        return tuple(Place(one.title, one.frame_id or frame, one.region) for one in self.each)

    @property
    def shown(self) -> JsonValue:
        """The argument as a reply repeats it: a place's name, or the bounds."""
        match self.region:
            case _ if self.name is not None:
                return self.name
            case Circle(x, y, radius_m):
                return {"x": x, "y": y, "radius_m": radius_m}
            case region:
                min_x, max_x, min_y, max_y = region.bounds
                return {"x": [min_x, max_x], "y": [min_y, max_y]}


def parse_where(
    limits: QuerySettings,
    value: JsonValue,
    default_radius_m: float | None = None,
    what: str = "where",
) -> Where:
    """Returns what a value of the argument `where` means.

    Args:
        limits: have the named places.
        value: as the client gave it: a place, or several.
        default_radius_m: of a circle without a radius; None where it must have one.
        what: the name of the argument.

    Raises:
        InvalidArgumentsError: it is no region, or no place has that name.
    """
    several = _several(limits, value)
    if several is None:
        return _one(limits, value, default_radius_m, what)
    if len(several) > _MOST_PLACES:
        raise InvalidArgumentsError(
            f"{what} has {len(several)} places, more than {_MOST_PLACES}: ask about some of them"
        )
    every = (
        (name, _one(limits, each, default_radius_m, f"{what}: {abbreviate(name)}"))
        for name, each in several.items()
    )
    found = tuple(
        replace(place, name=name) if place.name is None else place for name, place in every
    )
    if len(found) == 1:
        return found[0]
    region = AnyOf(tuple(each.region for each in found))
    names = ", ".join(each.title for each in found)
    return Where(region, _frame_of(found), names, found)


def _several(limits: QuerySettings, value: JsonValue) -> dict[str, JsonValue] | None:
    """Returns places by name; None of a value that is to be one place."""
    if isinstance(value, str):
        names = [name.strip() for name in value.split(",")]
        if len(names) == 1 or _place_named(limits, value) is not None:
            return None
        return {name: name for name in names if name} or None
    if isinstance(value, list) and value and all(isinstance(each, str) for each in value):
        return {str(each): each for each in value}
    if not isinstance(value, dict):
        return None
    is_one = any(not isinstance(value.get(name, {}), dict) for name in _OF_REGION)
    are_places = any(isinstance(each, str | dict) for each in value.values())
    return value if are_places and not is_one else None


def _frame_of(several: Sequence[Where]) -> str | None:
    """Returns the frame that several places share; coordinates are in that of the named ones.

    Raises:
        InvalidArgumentsError: they are in several frames.
    """
    known = {each.frame_id: each.title for each in several if each.frame_id is not None}
    if len(known) > 1:
        listed = ", ".join(f"{name} is in {frame}" for frame, name in known.items())
        raise InvalidArgumentsError(f"where: {listed}: ask about places of one frame")
    return next(iter(known), None)


def _one(
    limits: QuerySettings, value: JsonValue, default_radius_m: float | None, what: str
) -> Where:
    if isinstance(value, str):
        return _named(limits, value, what)
    if not isinstance(value, dict):
        raise InvalidArgumentsError(f"{what} was {abbreviate(value)}; {_EXPECTED}")
    unknown = value.keys() - _OF_REGION
    if unknown:
        raise InvalidArgumentsError(f"{what} has no {abbreviate(min(unknown))}; {_EXPECTED}")
    x, y = value.get("x"), value.get("y")
    if isinstance(x, list) or isinstance(y, list):
        if "radius_m" in value:
            raise InvalidArgumentsError(f"{what} has a radius_m and a range; {_EXPECTED}")
        return Where(Rectangle(*_bounds(f"{what}: x", x), *_bounds(f"{what}: y", y)))
    radius = value.get("radius_m", default_radius_m)
    numbers = [_number(each) for each in (x, y, radius)]
    if None in numbers or not (numbers[2] or 0) > 0:
        raise InvalidArgumentsError(f"{what} was {abbreviate(value)}; {_EXPECTED}")
    at_x, at_y, size = (each or 0.0 for each in numbers)
    return Where(Circle(at_x, at_y, size))


def places_asked(
    limits: QuerySettings, where: Where | None, frames: Iterable[str]
) -> tuple[Place, ...]:
    """Returns the named places, and those that a question names in any of some frames."""
    asked = [] if where is None or where.name is None else [where.places(one) for one in frames]
    return tuple(dict.fromkeys(chain(limits.places, *asked)))


def places_setting(limits: QuerySettings) -> str:
    """Returns where places are named, with the file that was read."""
    return f"{PLACES_SETTING}, here {limits.places_file}" if limits.places_file else PLACES_SETTING


def _place_named(limits: QuerySettings, name: str) -> Place | None:
    asked = " ".join(name.split()).casefold()
    same = (one for one in limits.places if " ".join(one.name.split()).casefold() == asked)
    return next(same, None)


def _named(limits: QuerySettings, name: str, what: str) -> Where:
    place = _place_named(limits, name)
    if place is not None:
        return Where(place.region, place.frame_id, place.name)
    known = ", ".join(sorted(each.name for each in limits.places))
    none = f"none are named in {places_setting(limits)}; {_EXPECTED}"
    listed = f"there are: {known}" if known else none
    raise InvalidArgumentsError(f"{what}: no place is named {abbreviate(name)}; {listed}")


def _bounds(axis: str, value: JsonValue) -> tuple[float, float]:
    ends = [_number(each) for each in value] if isinstance(value, list) else []
    if len(ends) != 2 or ends[0] is None or ends[1] is None or ends[0] > ends[1]:
        raise InvalidArgumentsError(
            f"{axis} was {abbreviate(value)}, which is not a range [from, to]; {_EXPECTED}"
        )
    return ends[0], ends[1]


def _number(value: JsonValue) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:  # an integer of hundreds of digits
        return None
    return number if math.isfinite(number) else None


def times_inside(view: View, where: Where, frame_id: str, window: TimeWindow) -> list[Inside]:
    """Returns when the robot was in a region, in order; a note says where that is not all known.

    `frame_id` is the frame of regions that name none.

    Raises:
        QueryTimeoutError: the call's time runs out before any result.
    """
    track = track_in(view, where.frame_id or frame_id, window)
    return robot_inside(track, where.region, window)


def note_other_frame(
    view: View, where: Where, placement: MapPlacement, window: TimeWindow, ask: str
) -> None:
    """Notes that coordinates without a frame, where nothing is in the map, are those of poses.

    As replies of get_position_* give them. `ask` says how to ask for what is there.
    """
    own = placement.pose_frame
    if where.frame_id is not None or own == placement.frame_id:
        return
    with suppress(QueryTimeoutError):
        if times_inside(view, replace(where, frame_id=own), own, window):
            view.notes.add(
                f"x and y were taken in {placement.frame_id}; the robot was at those in {own}, "
                f"the frame of get_position_*: {ask}"
            )
