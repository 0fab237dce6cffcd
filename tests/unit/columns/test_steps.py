"""How exactly a column of floats is stored, by its name and type."""

import pytest

from ros2_memory.columns.steps import (
    DEGREES,
    METRES,
    QUATERNION,
    RADIANS,
    RELATIVE,
    VELOCITY,
    Step,
    step_of,
)
from ros2_memory.storage.base import SEQUENCE, Definition, Field


def message(name: str, **fields: str | Definition) -> Definition:
    return Definition(name, tuple(Field(field, kind) for field, kind in fields.items()))


POINT = message("geometry_msgs/msg/Point", x="float64", y="float64", z="float64")
VECTOR = message("geometry_msgs/msg/Vector3", x="float64", y="float64", z="float64")
QUATERNIONS = message(
    "geometry_msgs/msg/Quaternion", x="float64", y="float64", z="float64", w="float64"
)
FIX = message("sensor_msgs/msg/NavSatFix", latitude="float64", altitude="float64")
ROBOT = Definition(
    "demo_msgs/msg/Robot",
    (
        Field("corner", POINT),
        Field("translation", VECTOR),
        Field("linear", VECTOR),
        Field("facing", QUATERNIONS),
        Field("fix", FIX),
        Field("yaw", "float64"),
        Field("altitude", "float64"),
        Field("steering_angle", "float32"),
        Field("points", POINT, SEQUENCE),
        Field("joints", message("sensor_msgs/msg/JointState", position="float64")),
    ),
)


@pytest.mark.parametrize(
    ("path", "step"),
    [
        ("corner.x", METRES),
        ("translation.z", METRES),
        ("linear.x", VELOCITY),
        ("facing.w", QUATERNION),
        ("facing.x", QUATERNION),
        ("fix.latitude", DEGREES),
        ("fix.altitude", METRES),
        ("altitude", RELATIVE),
        ("yaw", RADIANS),
        ("steering_angle", RADIANS),
        ("points.y", METRES),
        ("joints.position.", RADIANS),
        ("joints.position.least", RADIANS),
        ("unheard.of", RELATIVE),
    ],
)
def test_steps_follow_the_type_of_the_message(path: str, step: Step) -> None:
    assert step_of(path, ROBOT) == step
