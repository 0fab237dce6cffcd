"""Metrics for Prometheus, in a registry of their own.

The process itself has no metrics here: whatever runs the server measures all its processes. Labels
are bounded: tools of this server or `unknown`, outcomes and reasons of the error tree, states, and
recorded topics that lost messages in the last hour.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import anyio
from prometheus_client import (
    CONTENT_TYPE_PLAIN_0_0_4,
    CollectorRegistry,
    Counter,
    Histogram,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.exposition import generate_latest

from ros2_memory import package_version
from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.telemetry import Answered, Exposition, Observer
from ros2_memory.core.timebase import Ns, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from prometheus_client.metrics_core import Metric

    from ros2_memory.history.context import Memory
    from ros2_memory.index.snapshot import Snapshot

TIMEOUT_S: Final = 2.0
"""How long measuring the gauges may take; after that a scrape gets the counters alone."""
BUCKETS_S: Final = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0)

_log = get_logger(__name__)


class Metrics(Observer):
    """Counts tool calls, and renders the counts with the gauges of the memory.

    Belongs to one event loop. One thread measures the gauges, also for scrapes that come after one
    timed out: a disk that hangs must not cost a thread with every scrape.
    """

    def __init__(
        self,
        measure: Callable[[], Sequence[Metric]],
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        self._measure = measure
        self._timeout_s = timeout_s
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="metrics")
        self._measuring: asyncio.Future[Sequence[Metric]] | None = None
        self._gauges: Sequence[Metric] = ()
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)
        self._answers = Counter(
            "ros2_memory_answers",
            "Finished tool calls, by outcome.",
            ("tool", "outcome", "reason"),
            registry=self._registry,
        )
        self._durations = Histogram(
            "ros2_memory_answer_duration_seconds",
            "From the arguments of a tool call to its reply.",
            ("tool",),
            buckets=BUCKETS_S,
            registry=self._registry,
        )

    def answered(self, call: Answered) -> None:
        """Counts a call."""
        self._answers.labels(call.tool, call.code, call.reason).inc()
        self._durations.labels(call.tool).observe(call.duration_s)

    def stop(self) -> None:
        """Ends the thread after the present measurement."""
        self._thread.shutdown(wait=False)

    async def exposition(self) -> Exposition:
        """Returns all metrics in Prometheus' text format, version 0.0.4.

        The gauges of the memory are missing if measuring them fails, or takes longer than the
        timeout.
        """
        if self._measuring is None or self._measuring.done():
            with suppress(RuntimeError):  # the thread was stopped
                loop = asyncio.get_running_loop()
                self._measuring = loop.run_in_executor(self._thread, self._measured)
        self._gauges = ()
        with anyio.move_on_after(self._timeout_s):
            if self._measuring is not None:
                self._gauges = await asyncio.shield(self._measuring)
        return Exposition(CONTENT_TYPE_PLAIN_0_0_4, generate_latest(self._registry))

    def _measured(self) -> Sequence[Metric]:
        """Returns the gauges; none if measuring them fails, which is logged."""
        try:
            return self._measure()
        except Exception:  # noqa: BLE001 - it must not cost the counters
            _log.exception("metrics_not_measured")
            return ()

    def collect(self) -> Iterator[Metric]:
        """Yields the version and the gauges of the memory, for the registry."""
        yield InfoMetricFamily(
            "ros2_memory_build", "The version of this server.", {"version": package_version()}
        )
        yield from self._gauges


@dataclass
class MemoryGauges:
    """Measures a memory and its recorder. Not for several threads at once."""

    _memory: Memory
    _pid: int | None = None
    _restarts: int = 0

    def __call__(self) -> list[Metric]:
        """Returns the metric families of the last scan and of the heartbeat.

        The bag directory is not scanned, and no bag is read. Unknown metrics are left out.
        """
        memory = self._memory
        now, snapshot, heartbeat = memory.clock.now(), memory.index.published, memory.heartbeat()
        families: list[Metric] = []
        if snapshot is not None:
            families += _index_families(snapshot, now)
        if memory.limits.kept is not None:
            families.append(
                GaugeMetricFamily(
                    "ros2_memory_budget_bytes",
                    "How much the recorder may keep.",
                    memory.limits.kept.max_total_bytes,
                )
            )
        if heartbeat is not None:
            if self._pid not in {None, heartbeat.pid}:
                self._restarts += 1
            self._pid = heartbeat.pid
            families += _recorder_families(heartbeat, now, self._restarts)
        return families


def _index_families(snapshot: Snapshot, now: Ns) -> Iterator[Metric]:
    kept_bytes, _ = snapshot.timeline.disk_use
    yield GaugeMetricFamily("ros2_memory_bags", "Bags that answer questions.", len(snapshot.bags))
    yield _by_state(
        "ros2_memory_files_set_aside",
        "Files in the bag directory: still being written, unreadable, or of another storage.",
        {
            "active": len(snapshot.active),
            "damaged": len(snapshot.damaged),
            "unread": len(snapshot.unread),
        },
    )
    yield GaugeMetricFamily(
        "ros2_memory_kept_bytes",
        "Size of the bags that answer questions.",
        kept_bytes,
    )
    yield GaugeMetricFamily(
        "ros2_memory_index_age_seconds",
        "Time since the last scan of the bag directory.",
        unix_from_ns(now - snapshot.scanned_at),
    )
    latest = snapshot.dating.latest
    if latest is not None:
        yield GaugeMetricFamily(
            "ros2_memory_newest_data_age_seconds",
            "Time since the newest message in a bag.",
            unix_from_ns(now - latest),
        )


def _recorder_families(heartbeat: Heartbeat, now: Ns, restarts: int) -> Iterator[Metric]:
    yield GaugeMetricFamily(
        "ros2_memory_recorder_live", "Whether the recorder is alive.", int(heartbeat.is_live(now))
    )
    yield _by_state(
        "ros2_memory_recorder_state",
        "1 for the state that the recorder last reported.",
        {str(state): int(state is heartbeat.state) for state in RecorderState},
    )
    yield GaugeMetricFamily(
        "ros2_memory_recorder_state_since_timestamp_seconds",
        "When that state began, Unix time.",
        unix_from_ns(heartbeat.since),
    )
    yield GaugeMetricFamily(
        "ros2_memory_recorder_heartbeat_age_seconds",
        "Time since the recorder last reported.",
        unix_from_ns(now - heartbeat.updated),
    )
    yield GaugeMetricFamily(
        "ros2_memory_recorder_silent_topics",
        "Subscribed topics without a message.",
        len(heartbeat.silent),
    )
    lost = GaugeMetricFamily(
        "ros2_memory_recorder_lost_messages",
        "Messages of the last hour that are known to be missing.",
        labels=("topic",),
    )
    for topic, messages in heartbeat.lost.items():
        lost.add_metric((topic,), messages)
    yield lost
    yield CounterMetricFamily(
        "ros2_memory_recorder_written_bytes",
        "Bytes that the recorder has written since it started.",
        heartbeat.bytes_written,
    )
    yield CounterMetricFamily(
        "ros2_memory_recorder_restarts",
        "Changes of the recorder's process, as seen by scrapes.",
        restarts,
    )


def _by_state(name: str, documentation: str, values: Mapping[str, int]) -> GaugeMetricFamily:
    family = GaugeMetricFamily(name, documentation, labels=("state",))
    for state, value in values.items():
        family.add_metric((state,), value)
    return family
