"""The detector: what is in its view, and what it makes of that.

In view is what is in range, in the field of view, and behind no wall. Of what is in view a fifth is
dropped; places have a noise that grows with the range; two labels in a hundred are wrong, two names
that are near each other are confused, and one label has several spellings.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ros2_memory.core.arrays import Floats
from tests.home.days import Person
from tests.home.flat import clear_lines
from tests.home.paths import Pose
from tests.home.things import LABELS, NEAR_NAMES, NONSENSE, PLURALS, Thing

CAMERA = (0.15, 0.0, 0.40)
"""The camera's position (m) in `base_link`; it looks straight ahead."""
RANGE_M = (0.4, 4.0)
HALF_VIEW = math.radians(40.0)
DROPPED = 0.2
FALSE = 0.02
CONFUSED = 0.03
NEAR_NOISE_M = 0.05
FAR_NOISE_M = 0.30
"""The root mean square of the horizontal error right at the camera, and at the end of its range."""
PERSON = "person"
PERSON_Z = 1.1

_VARIANT = 0.25
_CAPITAL = 0.08
_PLURAL = 0.05
_PHANTOM = 0.25  # of the false ones: there is nothing at all


class Targets(NamedTuple):
    """All that may be seen, at each moment: columns are things, then people; NaN is absent."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: Floats


class Detected(NamedTuple):
    """One detection: of which target (-1: of nothing), and what the detector makes of it."""

    message: int
    target: int
    label: str
    score: float
    right: bool
    point: tuple[float, float, float]
    """Where it is put (m) in the camera's axes: x ahead, y left, z up."""


@dataclass(frozen=True)
class Sights:
    """What was in view in each message (rows), of each target (columns), and what was detected."""

    in_view: NDArray[np.bool_]
    detected: tuple[Detected, ...]


def targets(things: Sequence[Thing], people: Sequence[Person], t: Floats) -> Targets:
    """Returns where everything is at each moment."""
    shape = (len(t), len(things) + len(people))
    x, y = np.full(shape, np.nan), np.full(shape, np.nan)
    z = np.full(shape[1], PERSON_Z)
    for nth, thing in enumerate(things):
        for stay in thing.stays:
            here = (t >= stay.start) & (t < stay.stop)
            if stay.place is not None:
                x[here, nth], y[here, nth], z[nth] = stay.place.x, stay.place.y, stay.place.z
    for nth, person in enumerate(people, len(things)):
        pose = person.path.at(t)
        x[:, nth], y[:, nth] = pose.x, pose.y
        for start, stop in person.out:
            away = (t >= start) & (t < stop)
            x[away, nth] = y[away, nth] = np.nan
    return Targets(x, y, z)


def in_camera(
    robot: Pose, x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns how far ahead of the camera and to its left points of the map are."""
    cos, sin = np.cos(robot.yaw)[:, None], np.sin(robot.yaw)[:, None]
    east, north = x - robot.x[:, None], y - robot.y[:, None]
    return cos * east + sin * north - CAMERA[0], cos * north - sin * east - CAMERA[1]


def in_view(robot: Pose, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns which points of the map the camera has in view, with no wall between."""
    ahead, left = in_camera(robot, x, y)
    with np.errstate(invalid="ignore"):
        distance = np.hypot(ahead, left)
        view = (distance >= RANGE_M[0]) & (distance <= RANGE_M[1])
        view &= np.abs(np.arctan2(left, ahead)) <= HALF_VIEW
    rows, columns = np.nonzero(view)
    camera_x = robot.x[rows] + CAMERA[0] * np.cos(robot.yaw[rows])
    camera_y = robot.y[rows] + CAMERA[0] * np.sin(robot.yaw[rows])
    view[rows, columns] = clear_lines(camera_x, camera_y, x[rows, columns], y[rows, columns])
    return view


def look(robot: Pose, seen: Targets, labels: Sequence[str], chance: np.random.Generator) -> Sights:
    """Returns what the detector sees and reports from each pose."""
    ahead, left = in_camera(robot, seen.x, seen.y)
    view = in_view(robot, seen.x, seen.y)
    rows, columns = np.nonzero(view)
    kept = chance.random(len(rows)) >= DROPPED
    rows, columns = rows[kept], columns[kept]
    detector = _Detector(chance, sorted(set(labels)))
    detected = [
        detector.report(row, column, labels[column], (right_ahead, right_left, float(height)))
        for row, column, right_ahead, right_left, height in zip(
            rows.tolist(),
            columns.tolist(),
            ahead[rows, columns].tolist(),
            left[rows, columns].tolist(),
            (seen.z[columns] - CAMERA[2]).tolist(),
            strict=True,
        )
    ]
    return Sights(view, tuple(detected))


@dataclass(frozen=True)
class _Detector:
    chance: np.random.Generator
    labels: Sequence[str]

    def report(
        self, message: int, target: int, label: str, true: tuple[float, float, float]
    ) -> Detected:
        distance = math.hypot(true[0], true[1])
        noise = noise_m(distance) / math.sqrt(2.0)
        errors = self.chance.normal(size=3)
        point = (
            true[0] + noise * float(errors[0]),
            true[1] + noise * float(errors[1]),
            true[2] + 0.5 * noise * float(errors[2]),
        )
        fate, score = self.chance.random(2).tolist()
        if fate < FALSE * _PHANTOM:
            away = float(self.chance.uniform(*RANGE_M))
            to_side = float(self.chance.uniform(-HALF_VIEW, HALF_VIEW))
            point = (away * math.cos(to_side), away * math.sin(to_side), true[2])
            return Detected(message, -1, self._wrong(label), self._score(0.45, score), False, point)
        if fate < FALSE:
            wrong = self._wrong(label)
            return Detected(message, target, wrong, self._score(0.5, score), False, point)
        if fate < FALSE + CONFUSED and label in NEAR_NAMES:
            near = NEAR_NAMES[label]
            return Detected(message, target, near, self._score(0.55, score), False, point)
        sure = 0.95 - 0.06 * distance
        return Detected(message, target, self._spelt(label), self._score(sure, score), True, point)

    def _wrong(self, label: str) -> str:
        among = [each for each in (*self.labels, *NONSENSE) if each != label]
        return among[int(self.chance.integers(len(among)))]

    def _spelt(self, label: str) -> str:
        fate = float(self.chance.random())
        if fate < _VARIANT and label in LABELS:
            return LABELS[label][0]
        if fate > 1.0 - _CAPITAL:
            return label.capitalize()
        if fate > 1.0 - _CAPITAL - _PLURAL and label in PLURALS:
            return PLURALS[label]
        return label

    @staticmethod
    def _score(centre: float, drawn: float) -> float:
        return round(min(max(centre + 0.3 * (drawn - 0.5), 0.2), 0.99), 3)


def noise_m(distance: float) -> float:
    """Returns the root mean square (m) of the horizontal error at a distance from the camera."""
    share = min(max(distance / RANGE_M[1], 0.0), 1.0)
    return NEAR_NOISE_M + (FAR_NOISE_M - NEAR_NOISE_M) * share
