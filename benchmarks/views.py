"""What the benchmark reads of messages whose classes rosbags makes at run time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence


class Place(Protocol):
    """`geometry_msgs/msg/Point`."""

    x: float
    y: float
    z: float


class Posed(Protocol):
    """`geometry_msgs/msg/Pose`."""

    position: Place


class PosedWithCovariance(Protocol):
    """`geometry_msgs/msg/PoseWithCovariance`."""

    pose: Posed


class OdometryMessage(Protocol):
    """`nav_msgs/msg/Odometry`."""

    pose: PosedWithCovariance


class Detected(Protocol):
    """`ros2_vision_interfaces/msg/VisionDetection`."""

    label: str


class DetectionArray(Protocol):
    """`ros2_vision_interfaces/msg/VisionDetectionArray`."""

    skill: str
    detections: Sequence[Detected]
