"""Figures for Prometheus, in a registry of their own.

Nothing of the process itself is among them: what runs the server knows its memory and its time, and
names them as for every other program. Labels are bounded: tools of this server or `unknown`, and
outcomes and reasons of the error tree.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import anyio
from prometheus_client import (
    CONTENT_TYPE_PLAIN_0_0_4,
    CollectorRegistry,
    Counter,
    Histogram,
    disable_created_metrics,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.exposition import generate_latest

from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.core.telemetry import Exposition, Observer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from prometheus_client.metrics_core import Metric

    from ros2_memory.core.telemetry import Answered
    from ros2_memory.observability.gauges import (
        IndexMeasures,
        Measures,
        RecorderMeasures,
    )

PATIENCE_S: Final = 2.0
"""How long the figures of the memory may take; the others are shown without them after that."""
BUCKETS_S: Final = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0)


class Metrics(Observer):
    """Counts answers, and shows them with the figures of the memory; for one event loop.

    One look at the memory is under way at a time, also where nobody waits for it any more.
    """

    def __init__(
        self, measure: Callable[[], Measures], version: str, patience_s: float = PATIENCE_S
    ) -> None:
        self._measure = measure
        self._version = version
        self._patience_s = patience_s
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="metrics")
        self._looking: asyncio.Future[Measures] | None = None
        # A series more for each, of no use in this format.
        disable_created_metrics()  # type: ignore[no-untyped-call]  # has no types
        self._registry = CollectorRegistry(auto_describe=False)
        self._answers = Counter(
            "ros2_memory_answers",
            "Tool calls that are over, by what became of them.",
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
        """Lets its thread go."""
        self._thread.shutdown(wait=False)

    async def exposition(self) -> Exposition:
        """All figures in Prometheus' text format, version 0.0.4.

        Those of the memory are missing where a disk lets them wait for longer than `patience_s`.
        """
        found: Measures | None = None
        with anyio.move_on_after(self._patience_s), suppress(RuntimeError):  # it has stopped
            if self._looking is None or self._looking.done():
                loop = asyncio.get_running_loop()
                self._looking = loop.run_in_executor(self._thread, self._measure)
            found = await asyncio.shield(self._looking)
        text = generate_latest(_Collected(self._registry, found, self._version))
        return Exposition(CONTENT_TYPE_PLAIN_0_0_4, text)


class _Collected:
    """What was counted, and what was measured at one moment."""

    def __init__(
        self, registry: CollectorRegistry, measures: Measures | None, version: str
    ) -> None:
        self._registry = registry
        self._measures = measures
        self._version = version

    def collect(self) -> Iterator[Metric]:
        """All families."""
        yield InfoMetricFamily(
            "ros2_memory_build", "The version of this server.", {"version": self._version}
        )
        yield from self._registry.collect()
        if self._measures is None:
            return
        if self._measures.index is not None:
            yield from _of_index(self._measures.index)
        if self._measures.budget_bytes is not None:
            yield GaugeMetricFamily(
                "ros2_memory_budget_bytes",
                "How much the recorder may keep.",
                self._measures.budget_bytes,
            )
        if self._measures.recorder is not None:
            yield from _of_recorder(self._measures.recorder)


def _of_index(index: IndexMeasures) -> Iterator[Metric]:
    yield GaugeMetricFamily("ros2_memory_bags", "Bags that answer questions.", index.bags)
    aside = GaugeMetricFamily(
        "ros2_memory_files_set_aside",
        "Files in the bag directory: still being written, unreadable, or of another storage.",
        labels=("state",),
    )
    aside.add_metric(("active",), index.active)
    aside.add_metric(("damaged",), index.damaged)
    aside.add_metric(("unread",), index.unread)
    yield aside
    yield GaugeMetricFamily(
        "ros2_memory_kept_bytes", "Size of the bags that answer questions.", index.kept_bytes
    )
    yield GaugeMetricFamily(
        "ros2_memory_index_age_seconds",
        "Since the bag directory was last looked through.",
        index.age_s,
    )
    if index.newest_age_s is not None:
        yield GaugeMetricFamily(
            "ros2_memory_newest_data_age_seconds",
            "Since the newest message in a bag.",
            index.newest_age_s,
        )


def _of_recorder(recorder: RecorderMeasures) -> Iterator[Metric]:
    yield GaugeMetricFamily(
        "ros2_memory_recorder_live", "Whether the recorder is there.", int(recorder.live)
    )
    states = GaugeMetricFamily(
        "ros2_memory_recorder_state",
        "1 for what the recorder last said it does.",
        labels=("state",),
    )
    for state in RecorderState:
        states.add_metric((str(state),), int(state is recorder.state))
    yield states
    yield GaugeMetricFamily(
        "ros2_memory_recorder_state_since_timestamp_seconds",
        "When that state began, Unix time.",
        recorder.since,
    )
    yield GaugeMetricFamily(
        "ros2_memory_recorder_heartbeat_age_seconds",
        "Since the recorder last said something of itself.",
        recorder.heartbeat_age_s,
    )
    yield GaugeMetricFamily(
        "ros2_memory_recorder_silent_topics",
        "Topics that are subscribed to and brought no message.",
        recorder.silent_topics,
    )
    yield CounterMetricFamily(
        "ros2_memory_recorder_written_bytes",
        "What the recorder has written since it started.",
        recorder.written_bytes,
    )
    yield CounterMetricFamily(
        "ros2_memory_recorder_restarts",
        "How often another process was found to be the recorder; looked at when scraped.",
        recorder.restarts,
    )
