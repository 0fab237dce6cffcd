"""A robot with a privacy mode: `/odom` numbered at 50 Hz, and `/privacy_mode`, latched.

    python -m tests.integration.private_robot TRUTH

SIGUSR1 sets the mode, SIGUSR2 ends it: the number of the next message is then appended to TRUTH.
"""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Bool

PERIOD_S = 0.02


def main(truth: Path) -> None:
    """Publishes until the process is killed."""
    asked: list[bool] = [False]
    signal.signal(signal.SIGUSR1, lambda *_: asked.append(True))
    signal.signal(signal.SIGUSR2, lambda *_: asked.append(False))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("private_robot")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    mode = node.create_publisher(Bool, "/privacy_mode", latched)
    odom = node.create_publisher(PointStamped, "/odom", QoSProfile(depth=10))
    began, number = time.monotonic(), 0
    while True:
        if asked:
            with truth.open("a") as stream:
                stream.write(f"{number}\n")
            mode.publish(Bool(data=asked.pop(0)))
        message = PointStamped()
        message.point.x = float(number)
        odom.publish(message)
        number += 1
        time.sleep(max(began + number * PERIOD_S - time.monotonic(), 0))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
