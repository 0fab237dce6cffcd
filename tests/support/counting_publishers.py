"""Publishers of numbered messages, of any QoS, for tests of what a recorder loses.

    python -m tests.support.counting_publishers /odom:100:reliable /scan:50:best_effort:deadline

Each argument is a topic, its messages a second, its reliability, and more of its QoS: `latched`
(transient local) or `deadline` (of half a second). Messages are geometry_msgs/PointStamped: `x` is
the number of the message, from 0, and the header's stamp that of its tick. `--first N` begins with
another number. All of it ends with the process: kill it.
"""

from __future__ import annotations

import sys
import time

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions


def main(arguments: list[str]) -> None:
    """Publishes until the process is killed."""
    number = 0
    if arguments[0] == "--first":
        number, arguments = int(arguments[1]), arguments[2:]
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("counting")
    topics = []
    for argument in arguments:
        topic, hz, reliability, *more = argument.split(":")
        profile = QoSProfile(depth=10, reliability=ReliabilityPolicy[reliability.upper()])
        if "latched" in more:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        if "deadline" in more:
            profile.deadline = Duration(seconds=0.5)
        topics.append((node.create_publisher(PointStamped, topic, profile), 1 / float(hz)))
    began = time.time()
    ticks = [0] * len(topics)
    while True:
        now = time.time()
        for index, (publisher, period_s) in enumerate(topics):
            due = began + ticks[index] * period_s
            if now >= due:
                message = PointStamped()
                message.header.stamp.sec = int(due)
                message.header.stamp.nanosec = int(due % 1 * 1e9)
                message.point.x = float(number + ticks[index])
                publisher.publish(message)
                ticks[index] += 1
        time.sleep(0.001)


if __name__ == "__main__":
    main(sys.argv[1:])
