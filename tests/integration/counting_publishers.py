"""Publishers of numbered messages, of any QoS, for tests of what a recorder loses.

    python -m tests.integration.counting_publishers /odom:100:reliable /scan:50:best_effort:deadline

Each argument is a topic, its messages a second, its reliability, and more of its QoS: `latched`
(transient local), `deadline` (of half a second) or `deep` (what waits is kept, not only the newest
ten). Messages are geometry_msgs/PoseStamped: `x` is
the number of the message, from 0, and the header's stamp that of its tick. `--first N` begins with
another number. `--speed N` simulates: `/clock` begins at 0 and runs N times as fast as the wall
clock, and the topics' rates and stamps are by it. `--log FILE` has a line for each message: topic,
number and when it was sent (ns). All of it ends with the process: kill it.
"""

import argparse
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import TextIO

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

CLOCK_PERIOD_S = 0.01


def main(arguments: list[str]) -> None:
    """Publishes until the process is killed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("topics", nargs="+")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--speed", type=float)
    parser.add_argument("--log", type=Path)
    given = parser.parse_args(arguments)
    # Whole lines: it is killed.
    with given.log.open("w", buffering=1) if given.log else nullcontext() as log:
        publish(given, log)


def publish(given: argparse.Namespace, log: TextIO | None) -> None:
    """Publishes for ever, and writes down when."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("counting")
    topics = []
    for argument in given.topics:
        topic, hz, reliability, *more = argument.split(":")
        depth = 10_000 if "deep" in more else 10
        profile = QoSProfile(depth=depth, reliability=ReliabilityPolicy[reliability.upper()])
        if "latched" in more:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        if "deadline" in more:
            profile.deadline = Duration(seconds=0.5)
        topics.append((node.create_publisher(PoseStamped, topic, profile), 1 / float(hz)))
    clock = node.create_publisher(Clock, "/clock", 10) if given.speed else None
    speed, origin = given.speed or 1.0, time.time()
    began = 0.0 if clock else origin
    shown = began - speed
    ticks = [0] * len(topics)
    while True:
        now = began + (time.time() - origin) * speed
        if clock and now - shown >= CLOCK_PERIOD_S * speed:
            clock.publish(Clock(clock=stamp(now)))
            shown = now
        for index, (publisher, period_s) in enumerate(topics):
            due = began + ticks[index] * period_s
            if now >= due:
                message = PoseStamped()
                message.header.stamp = stamp(due)
                message.pose.position.x = float(given.first + ticks[index])
                publisher.publish(message)
                if log is not None:
                    log.write(
                        f"{publisher.topic_name} {given.first + ticks[index]} {time.time_ns()}\n"
                    )
                ticks[index] += 1
        time.sleep(0.001)


def stamp(seconds: float) -> Time:
    return Time(sec=int(seconds), nanosec=int(seconds % 1 * 1e9))


if __name__ == "__main__":
    main(sys.argv[1:])
