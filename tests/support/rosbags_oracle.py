"""Plain rosbags reads of standard types from public bags: an oracle beside the project's own."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from ros2_memory.core.model import StampedTransform, Transform
from tests.support.shared_bags import REAL

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rosbags.typesys.store import Typestore


@cache
def _standard_types() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)


def messages(file: str, topic: str) -> Iterator[tuple[int, Any]]:
    """(log time, message) of one topic in one bag file under the folder of public bags."""
    with Reader(REAL / file) as reader:
        wanted = [held for held in reader.connections if held.topic == topic]
        for connection, log_time, payload in reader.messages(wanted):
            yield log_time, _standard_types().deserialize_cdr(payload, connection.msgtype)


def stamped_transforms(file: str) -> list[StampedTransform]:
    """Every transform on /tf and /tf_static of one bag file."""
    return [
        StampedTransform(
            held.header.frame_id,
            held.child_frame_id,
            held.header.stamp.sec * 10**9 + held.header.stamp.nanosec,
            log_time,
            Transform(
                (
                    held.transform.translation.x,
                    held.transform.translation.y,
                    held.transform.translation.z,
                ),
                (
                    held.transform.rotation.x,
                    held.transform.rotation.y,
                    held.transform.rotation.z,
                    held.transform.rotation.w,
                ),
            ),
            static=topic == "/tf_static",
        )
        for topic in ("/tf", "/tf_static")
        for log_time, message in messages(file, topic)
        for held in message.transforms
    ]
