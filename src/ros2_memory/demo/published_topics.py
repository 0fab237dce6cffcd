"""The topics of the simulated robot, and when each has a message.

Message k of a stream is published, and stamped, at `t0 + k * period`, and reaches the recorder a
fraction of a millisecond later, its own fraction for each message. Both times are closed forms, so
the message that answers a question is known without looking into a bag.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import merge
from typing import TYPE_CHECKING, Final

from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Ns

if TYPE_CHECKING:
    from collections.abc import Iterator

ODOM: Final = "/odom"
TF: Final = "/tf"
TF_STATIC: Final = "/tf_static"
CMD_VEL: Final = "/cmd_vel"
SCAN: Final = "/scan"
BATTERY: Final = "/battery_state"
PATH_CLEAR: Final = "/path_clear"
SCENE_OBJECTS: Final = "/vision/scene/scene_objects"
SCENE_DESCRIPTION: Final = "/vision/scene/scene_description"
FOUND: Final = "/vision/find_object/detections_meta"


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic: its type and the time between two messages; a latched one is published once."""

    topic: str
    type: str
    period: Ns
    latched: bool = False
    reliable: bool = True


STREAMS: Final = (
    Stream(TF_STATIC, "tf2_msgs/msg/TFMessage", NS_PER_S, latched=True),
    Stream(ODOM, "nav_msgs/msg/Odometry", 50 * NS_PER_MS),
    Stream(TF, "tf2_msgs/msg/TFMessage", 50 * NS_PER_MS),
    Stream(CMD_VEL, "geometry_msgs/msg/Twist", 100 * NS_PER_MS),
    Stream(SCAN, "sensor_msgs/msg/LaserScan", 200 * NS_PER_MS, reliable=False),
    Stream(PATH_CLEAR, "std_msgs/msg/Bool", 500 * NS_PER_MS),
    Stream(SCENE_OBJECTS, "ros2_vision_interfaces/msg/VisionDetectionArray", 500 * NS_PER_MS),
    Stream(FOUND, "ros2_vision_interfaces/msg/VisionDetectionArray", NS_PER_S),
    Stream(SCENE_DESCRIPTION, "ros2_vision_interfaces/msg/StampedString", NS_PER_S),
    Stream(BATTERY, "sensor_msgs/msg/BatteryState", NS_PER_S),
)


@dataclass(frozen=True, slots=True)
class Message:
    """Message `k` of a stream; `t` is the robot's time (s since its start) that it describes."""

    stream: Stream
    k: int
    log_time: Ns
    publish_time: Ns
    t: float


@dataclass(frozen=True, slots=True)
class MessageSchedule:
    """The messages of a robot that started at `t0`, as a recorder receives them from `start` on.

    A latched message was published at `t0` and reaches the recorder at `start`.
    """

    t0: Ns
    start: Ns

    def message(self, stream: Stream, k: int) -> Message:
        """Returns message `k` of the stream."""
        published = self.t0 + k * stream.period
        heard = max(published, self.start) + _delay(stream, k)
        return Message(stream, k, heard, published, (published - self.t0) / NS_PER_S)

    def messages(self, stream: Stream) -> Iterator[Message]:
        """Yields the stream's messages from the start on, without end; one if it is latched."""
        k = self._first(stream)
        yield self.message(stream, k)
        while not stream.latched:
            k += 1
            yield self.message(stream, k)

    def everything(self) -> Iterator[Message]:
        """Yields all streams' messages in the order in which they are received, without end."""
        return merge(*map(self.messages, STREAMS), key=lambda message: message.log_time)

    def newest(self, stream: Stream, at: Ns) -> Message | None:
        """Returns the newest message with a log time at or before `at`; None before the first."""
        first = self._first(stream)
        k = first if stream.latched else max((at - self.t0) // stream.period, first)
        newest = self.message(stream, k)
        if newest.log_time > at and k > first:
            newest = self.message(stream, k - 1)
        return newest if newest.log_time <= at else None

    def newest_first(self, stream: Stream, at: Ns) -> Iterator[Message]:
        """Yields the stream's messages with a log time at or before `at`, newest first."""
        newest = self.newest(stream, at)
        if newest is not None:
            for k in range(newest.k, self._first(stream) - 1, -1):
                yield self.message(stream, k)

    def count(self, stream: Stream, at: Ns) -> int:
        """Returns how many messages the recorder has received by `at`."""
        newest = self.newest(stream, at)
        return 0 if newest is None else newest.k - self._first(stream) + 1

    def _first(self, stream: Stream) -> int:
        return 0 if stream.latched else -((self.t0 - self.start) // stream.period)


def _delay(stream: Stream, k: int) -> Ns:
    """Returns the time from publication to the recorder: 0.06 to 0.46 ms, in a fixed pattern."""
    return (60 + 19 * STREAMS.index(stream) + (k * 7919) % 211) * NS_PER_US
