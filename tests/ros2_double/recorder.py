"""The node: finds topics, subscribes to them as their publishers allow, and writes what comes."""

from __future__ import annotations

import re
import sys
import threading
import time
from contextlib import suppress
from queue import Empty, Queue
from typing import TYPE_CHECKING, Any, Final

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.parameter import Parameter
from rclpy.qos import qos_policy_name_from_kind
from rclpy.signals import SignalHandlerOptions

from tests.ros2_double.bag import Bag
from tests.ros2_double.definitions import package_is_known, type_hash
from tests.ros2_double.metadata import Topic, qos_text
from tests.ros2_double.qos import adapted, offered, overrides, refused
from tests.support.ros_types import subscription

if TYPE_CHECKING:
    from tests.ros2_double.arguments import Options
    from tests.ros2_double.signals import Signals

_POLLING_S: Final = 0.1
_DRAINING_S: Final = 0.1
_LATE_S: Final = 0.1
"""Messages that are taken later than this are near to being overtaken by those behind them."""


def record(options: Options, signals: Signals) -> None:
    """Records until a signal comes. The directory is complete when this returns.

    Raises:
        RefusedError: the overrides are no profiles; nothing was begun.
        OSError: the next split cannot be opened.
    """
    profiles = overrides(options.overrides)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    recorder = _Recorder(options, profiles, signals)
    try:
        recorder.run()
    finally:
        recorder.destroy()
        rclpy.shutdown()


class _Recorder:
    def __init__(self, options: Options, profiles: dict[str, Any], signals: Signals) -> None:
        self._options = options
        self._profiles = profiles
        self._signals = signals
        self._regex = re.compile(options.regex)
        self._asked: dict[str, Any] = {}  # what was asked for, by subscribed topic
        self._warned: set[str] = set()
        self._late_s = 0.0  # how long a message had to wait, at worst
        self._name = options.node_name
        self._node = rclpy.create_node(
            options.node_name,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[Parameter("use_sim_time", value=options.use_sim_time)],
        )
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._taken: Queue[tuple[str, bytes, dict[str, int], int]] = Queue()
        # Finding topics and writing must not hold up what is received: the real one has threads.
        self._receiver = threading.Thread(target=self._executor.spin, daemon=True)

    def run(self) -> None:
        self._greet()
        self._signals.take_over()
        self._bag = Bag(self._options, _say)
        self._log("Listening for topics...")
        self._log("Event publisher thread: Starting")
        self._log("Recording...")
        self._receiver.start()
        if self._options.use_sim_time:
            self._await_clock()
        due = 0.0
        while not self._signals.received:
            if time.monotonic() >= due:
                self._discover()
                due = time.monotonic() + _POLLING_S
            self._write_taken(_POLLING_S / 2)
        self._end()

    def destroy(self) -> None:
        self._executor.shutdown()
        if self._receiver.is_alive():
            self._receiver.join()
        self._node.destroy_node()

    def _greet(self) -> None:
        if not self._options.keyboard:
            return
        if not sys.stdin.isatty():
            sys.stderr.write("stdin is not a terminal device. Keyboard handling disabled.")
            sys.stderr.flush()
        self._log("Press SPACE for pausing/resuming")

    def _await_clock(self) -> None:
        self._log("use_sim_time set, waiting for /clock before starting recording...")
        while not self._signals.received and not self._node.get_clock().now().nanoseconds:
            time.sleep(_POLLING_S / 2)
        if not self._signals.received:
            self._log("Sim time /clock found, starting recording.")

    def _end(self) -> None:
        self._log("Pausing recording.")
        self._drain()
        if self._late_s > _LATE_S:
            _say("warn", self._name, f"Messages were taken late, by {self._late_s:.2f} s at worst")
        self._bag.close()
        self._log("Event publisher thread: Exiting")
        self._log("Recording stopped")
        _say("info", "rclcpp", f"signal_handler(signum={self._signals.received[-1]})")

    def _drain(self) -> None:
        """Writes what had already arrived."""
        until = time.monotonic() + _DRAINING_S
        while (left_s := until - time.monotonic()) > 0:
            self._write_taken(left_s)

    def _write_taken(self, patience_s: float) -> None:
        """Writes what was received; waits so long for the first message."""
        with suppress(Empty):
            while True:
                self._write(*self._taken.get(timeout=patience_s))
                patience_s = 0.0

    def _discover(self) -> None:
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self._asked:
                self._check(topic)
            elif self._wants(topic, types):
                self._subscribe(topic, types[0])

    def _wants(self, topic: str, types: list[str]) -> bool:
        if not self._regex.search(topic):
            return False
        if len(types) > 1:
            self._warn_once(
                topic,
                f"Topic '{topic}' has more than one type associated. "
                "Only topics with one type are supported",
            )
            return False
        package = types[0].split("/")[0]
        if not package_is_known(package):
            self._warn_once(
                types[0],
                f"Topic '{topic}' has unknown type '{types[0]}' . Only topics with known type are "
                f"supported. Reason: 'package '{package}' not found",
            )
            return False
        is_hidden = any(part.startswith("_") for part in topic.split("/"))
        if is_hidden and not self._options.include_hidden:
            self._warn_once(
                topic, "Hidden topics are not recorded. Enable them with --include-hidden-topics"
            )
            return False
        return bool(self._node.get_publishers_info_by_topic(topic))

    def _subscribe(self, topic: str, type_name: str) -> None:
        publishers = self._node.get_publishers_info_by_topic(topic)
        if not publishers:
            return
        offers = [publisher.qos_profile for publisher in publishers]
        hashes = {bytes(p.topic_type_hash.value) for p in publishers if p.topic_type_hash.version}
        named = f"RIHS01_{hashes.pop().hex()}" if len(hashes) == 1 else ""
        self._bag.subscribe(Topic(topic, type_name, qos_text(map(offered, offers)), named))
        if topic in self._profiles:
            self._log(f"Overriding subscription profile for {topic}")
            asked = self._profiles[topic]
        else:
            asked = adapted(topic, offers, lambda text: _say("warn", "rosbag2_storage", text))
        self._asked[topic] = asked

        def take(payload: bytes, info: dict[str, int]) -> None:
            waited_s = (time.time_ns() - info["received_timestamp"]) / 1e9
            self._late_s = max(waited_s, self._late_s)
            self._taken.put((topic, payload, info, self._node.get_clock().now().nanoseconds))

        def warn(event: Any) -> None:
            policy = f"{qos_policy_name_from_kind(event.last_policy_kind)}_QOS_POLICY"
            text = (
                f"New publisher discovered on topic '{topic}', offering incompatible QoS. "
                f"No messages will be sent to it. Last incompatible policy: {policy}"
            )
            _say("warn", self._name, text)

        kind = (type_name, type_hash(type_name))
        subscription(self._node, topic, kind, asked, take, incompatible=warn)
        self._log(f"Subscribed to topic '{topic}'")

    def _write(self, topic: str, payload: bytes, info: dict[str, int], now: int) -> None:
        log_time = now if self._options.use_sim_time else info["received_timestamp"]
        self._bag.write(topic, payload, log_time, info["source_timestamp"])

    def _check(self, topic: str) -> None:
        publishers = self._node.get_publishers_info_by_topic(topic)
        warning = refused(topic, [p.qos_profile for p in publishers], self._asked[topic])
        if warning is not None:
            self._warn_once(f"qos {topic}", warning)

    def _warn_once(self, about: str, text: str) -> None:
        if about not in self._warned:
            self._warned.add(about)
            _say("warn", self._name, text)

    def _log(self, text: str) -> None:
        _say("info", self._name, text)


def _say(level: str, logger: str, text: str) -> None:
    getattr(get_logger(logger), level)(text)
