"""A robot with a privacy mode: `/odom` numbered, at most at 50 Hz; `/privacy_mode` latched.

    python -m tests.integration.private_robot TRUTH

SIGUSR1 sets the mode, SIGUSR2 ends it: the number of the next message is then appended to TRUTH.
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
    asked: list[int] = [signal.SIGUSR2]
    for sign in (signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(sign, lambda received, _: asked.append(received))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("private_robot")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    mode = node.create_publisher(Bool, "/privacy_mode", latched)
    odom = node.create_publisher(PointStamped, "/odom", QoSProfile(depth=10))
    message = PointStamped()
    while True:
        if asked:
            with truth.open("a") as stream:
                stream.write(f"{message.point.x:.0f}\n")
            mode.publish(Bool(data=asked.pop(0) == signal.SIGUSR1))
        odom.publish(message)
        message.point.x += 1.0
        # What a busy machine delayed is not made up for: so 50 numbers are a second, or more.
        time.sleep(PERIOD_S)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
