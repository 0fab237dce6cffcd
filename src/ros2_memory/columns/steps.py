"""How exactly a column of floats is stored: by the name and the message type of its field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.columns.plan import fields_at
from ros2_memory.storage.base import Definition

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_RELATIVE: Final = 1e-6


@dataclass(frozen=True, slots=True)
class Step:
    """How the values of a column of floats are rounded. Other columns are always exact.

    Attributes:
        per_unit: values become multiples of `1 / per_unit`; 0 if they do not.
        relative: whether each value may change by a millionth (`MOST_RELATIVE`) of itself.
    """

    per_unit: int = 0
    relative: bool = False

    def nearest(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the nearest multiples of an absolute step; a value too large for one stays."""
        with np.errstate(over="ignore", invalid="ignore"):
            multiples = np.rint(values * self.per_unit) / self.per_unit
        return np.where(np.isinf(multiples), values, multiples)


EXACT: Final = Step()
RELATIVE: Final = Step(relative=True)
METRES: Final = Step(per_unit=10_000)
"""0.1 mm."""
RADIANS: Final = Step(per_unit=10_000)
"""0.1 mrad."""
VELOCITY: Final = Step(per_unit=10_000)
"""0.1 mm/s, or 0.1 mrad/s."""
QUATERNION: Final = Step(per_unit=20_000)
"""5e-5. A component then changes by at most 2.5e-5, so a unit quaternion by at most 5e-5, and the
rotation by twice that (its angle is twice that of the quaternion): 0.1 mrad."""
DEGREES: Final = Step(per_unit=1_000_000_000)
"""1e-9 degree: 0.1 mm on the ground."""

_OF_ARRAYS: Final = frozenset({"", "least", "greatest"})
_POINTS: Final = frozenset({"geometry_msgs/msg/Point", "geometry_msgs/msg/Point32"})
_POSES_2D: Final = frozenset({"geometry_msgs/msg/Pose2D", "vision_msgs/msg/Point2D"})
_VECTOR: Final = "geometry_msgs/msg/Vector3"
_QUATERNION: Final = "geometry_msgs/msg/Quaternion"
_JOINTS: Final = {
    "sensor_msgs/msg/JointState": frozenset({"position"}),
    "trajectory_msgs/msg/JointTrajectoryPoint": frozenset({"positions"}),
}
_VELOCITIES: Final = frozenset({"linear", "angular", "linear_velocity", "angular_velocity"})
_PLACES: Final = frozenset(
    {"position", "translation", "point", "points", "location", "origin", "center", "centroid"}
)
_GLOBE: Final = frozenset({"latitude", "longitude"})
_ON_THE_GLOBE: Final = frozenset({"sensor_msgs/msg/NavSatFix", "geographic_msgs/msg/GeoPoint"})
_ANGLES: Final = frozenset({"roll", "pitch", "yaw", "theta", "heading", "azimuth", "angle"})
_ENDS_OF_ANGLES: Final = ("_angle", "_yaw", "_heading")


def step_of(path: str, definition: Definition | None) -> Step:
    """Returns how exactly a column of floats is stored.

    Args:
        path: the field, as `pose.pose.position.x`; of elements `<sequence>.<field>`.
        definition: that of the topic.

    Returns:
        0.1 mm for coordinates of points and for vectors that are named as positions are, 0.1 mrad
        for angles and joints, what keeps rotations within 0.1 mrad for quaternions, 1e-9 degree for
        latitude and longitude and 0.1 mm for the altitude beside them, 0.1 mm/s and 0.1 mrad/s for
        velocities; otherwise a millionth of the value.
    """
    around, _, name = path.rpartition(".")
    if name.isdigit() or name in _OF_ARRAYS:
        around, _, name = around.rpartition(".")
    owner = _type_at(around, definition)
    if owner in _JOINTS and name in _JOINTS[owner]:
        return RADIANS
    if name in "xyz":
        return _axis(name, owner, around.rpartition(".")[2])
    if name == "w" and owner == _QUATERNION:
        return QUATERNION
    if name in _GLOBE:
        return DEGREES
    if owner in _ON_THE_GLOBE and name == "altitude":
        return METRES
    return RADIANS if name in _ANGLES or name.endswith(_ENDS_OF_ANGLES) else RELATIVE


def _type_at(path: str, definition: Definition | None) -> str:
    """Returns the type of the message at a path; "" if it is not known."""
    names = path.split(".") if path else []
    fields = fields_at(definition, names)
    if len(fields) < len(names):
        return ""
    kind = fields[-1].kind if fields else definition
    return kind.type if isinstance(kind, Definition) else ""


def _axis(name: str, owner: str, field: str) -> Step:
    """Returns the step of x, y or z.

    Args:
        name: of the axis.
        owner: the type of the message that has the axis.
        field: the name of the field that has this message.
    """
    if owner == _QUATERNION:
        return QUATERNION
    if owner in _POINTS or (owner in _POSES_2D and name != "z"):
        return METRES
    if owner == _VECTOR and field in _PLACES:
        return METRES
    return VELOCITY if owner == _VECTOR and field in _VELOCITIES else RELATIVE
