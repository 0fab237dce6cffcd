"""A robot with a privacy mode: `/odom` numbered, at most at 50 Hz; `/privacy_mode`, `/map` latched.

    python -m tests.integration.private_robot TRUTH

SIGUSR1 sets the mode and makes a map, SIGUSR2 ends it, SIGHUP makes a map: the number of the next
message is then appended to TRUTH, and is that of the map.
"""

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
    asked: list[signal.Signals] = [signal.SIGUSR2]
    for sign in (signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP):
        signal.signal(sign, lambda received, _: asked.append(signal.Signals(received)))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("private_robot")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    mode = node.create_publisher(Bool, "/privacy_mode", latched)
    area = node.create_publisher(PointStamped, "/map", latched)
    odom = node.create_publisher(PointStamped, "/odom", QoSProfile(depth=10))
    number = 0
    while True:
        if asked:
            with truth.open("a") as stream:
                stream.write(f"{number}\n")
            wanted = asked.pop(0)
            if wanted is not signal.SIGHUP:
                mode.publish(Bool(data=wanted is signal.SIGUSR1))
            if wanted is not signal.SIGUSR2:
                area.publish(numbered(number))
        message = numbered(number)
        odom.publish(message)
        number += 1
        # What a busy machine delayed is not made up for: so 50 numbers are a second, or more.
        time.sleep(PERIOD_S)


def numbered(number: int) -> PointStamped:
    message = PointStamped()
    message.point.x = float(number)
    return message


if __name__ == "__main__":
    main(Path(sys.argv[1]))
