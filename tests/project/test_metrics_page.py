"""The page on metrics and the alerts ask for series that there are; what spans contain."""

import re
from pathlib import Path

import anyio
import pytest
import yaml

from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.core.errors import EpisodicError, NoDataReason
from ros2_memory.core.telemetry import Answered
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import QuerySettings
from ros2_memory.retention.policy import RetentionLimits
from tests.project.reference_tables import codes
from tests.support.bags import text, write_mcap
from tests.support.heartbeats import beat
from tests.support.memories import ROOT, memory_of

pytest.importorskip("prometheus_client", reason="needs the extra observability")
pytest.importorskip("opentelemetry.sdk", reason="needs the extra observability")

from prometheus_client.parser import text_string_to_metric_families

from ros2_memory.observability.prometheus import MemoryGauges, Metrics

PAGE = (ROOT / "docs/how-to/metrics.md").read_text()
RULES = yaml.safe_load((ROOT / "deploy/ros2-memory.rules.yml").read_text())
QUERIES = [
    *(rule["expr"] for rule in RULES["groups"][0]["rules"]),
    *re.findall(r"^\| [^|]+ \| `(.*?)` \|$", PAGE, re.MULTILINE),
    *re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL),
]
CALL = Answered("ask", "no_data: gap", 0.03, 12, "abc", {"read": 2.0})


def shown(bag_dir: Path) -> dict[str, dict[str, set[str]]]:
    """Every series of a memory that has a recorder, with its labels and their values."""
    write_mcap(bag_dir / "a" / "a_0.mcap", [text(1_700_000_000 * NS_PER_S, "x")])
    beat(bag_dir, 0, RecorderState.RECORDING, lost={"/odom": 3})
    kept = RetentionLimits(max_total_bytes=5000, max_age_ns=NS_PER_S, min_free_bytes=0)
    memory = memory_of(bag_dir, limits=QuerySettings(kept=kept))
    memory.index.refresh()
    metrics = Metrics(MemoryGauges(memory))
    metrics.answered(CALL)
    exposition = anyio.run(metrics.exposition).body.decode()
    metrics.stop()
    found: dict[str, dict[str, set[str]]] = {}
    for family in text_string_to_metric_families(exposition):
        for sample in family.samples:
            series = found.setdefault(sample.name, {})
            for label, value in sample.labels.items():
                series.setdefault(label, set()).add(value)
    answers = found["ros2_memory_answers_total"]
    answers["outcome"] = codes(EpisodicError) | {"ok", "cancelled"}
    answers["reason"] = {""} | {reason.value for reason in NoDataReason}
    return found


def test_a_query_and_the_sample_name_what_there_is(tmp_path: Path) -> None:
    known = shown(tmp_path)
    named = [
        each for query in QUERIES for each in re.findall(r"(ros2_memory_\w+)(\{.*?\})?", query)
    ]
    assert len(named) > 10
    for name, labels in named:
        assert name in known
        for label, value in re.findall(r'(\w+)=~?"([^"]*)"', labels):
            assert label == "tool" or {*value.split("|")} <= known[name][label], (name, label)
