"""docs/how-to/metrics.md speaks of figures that the server shows, and of what its spans say."""

from __future__ import annotations

import re
import shutil
import subprocess
from typing import TYPE_CHECKING, Any

import anyio
import pytest
import yaml

from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.core.errors import EpisodicError, NoDataReason
from ros2_memory.core.telemetry import Answered
from ros2_memory.observability.gauges import (
    IndexMeasures,
    Measures,
    RecorderMeasures,
)
from tests.support.memories import ROOT

if TYPE_CHECKING:
    from pathlib import Path

pytest.importorskip("prometheus_client", reason="needs the extra observability")
pytest.importorskip("opentelemetry.sdk", reason="needs the extra observability")

from prometheus_client.parser import text_string_to_metric_families

from ros2_memory.observability.opentelemetry import SERVICE, _attributes
from ros2_memory.observability.prometheus import BUCKETS_S, Metrics

PAGE = (ROOT / "docs/how-to/metrics.md").read_text(encoding="utf-8")
SCRAPING, RULES = (
    yaml.safe_load(each) for each in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
)
SAMPLES = re.search(r"```text\n(.*?)```", PAGE, re.DOTALL)
QUERIES = [
    *(rule["expr"] for rule in RULES["groups"][0]["rules"]),
    *re.findall(r"^\| [^|]+ \| `(.*?)` \|$", PAGE, re.MULTILINE),
]
CALL = Answered("ask", "no_data: gap", 0.03, 12, "abc", {"read": 2.0})


def codes(cls: type[EpisodicError] = EpisodicError) -> set[str]:
    return {cls.code}.union(*(codes(each) for each in cls.__subclasses__()))


def shown() -> dict[str, dict[str, set[str]]]:
    """Every series of a memory that has a recorder, with its labels and their values."""
    index = IndexMeasures(3, 1, 2, 0, 4096, 7.5, 0.5)
    recorder = RecorderMeasures(RecorderState.RECORDING, True, 1.7e9, 1.0, 700, 1, 2)
    metrics = Metrics(lambda: Measures(index, recorder, 5000), "1")
    metrics.answered(CALL)
    text = anyio.run(metrics.exposition).body.decode()
    metrics.stop()
    found: dict[str, dict[str, set[str]]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            series = found.setdefault(sample.name, {})
            for label, value in sample.labels.items():
                series.setdefault(label, set()).add(value)
    answers = found["ros2_memory_answers_total"]
    answers["outcome"] = codes() | {"ok", "cancelled"}
    answers["reason"] = {""} | {reason.value for reason in NoDataReason}
    for series in found.values():
        series.pop("tool", None)  # any name of a tool
    return found


def chosen(text: str) -> list[tuple[str, list[tuple[str, str]]]]:
    """The series that a text names, each with the labels that choose among them."""
    return [
        (name, re.findall(r'(\w+)=~?"([^"]*)"', labels))
        for name, labels in re.findall(r"(ros2_memory_\w+)(?:\{([^}]*)\})?", text)
    ]


@pytest.mark.parametrize("query", QUERIES)
def test_a_query_asks_for_what_there_is(query: str) -> None:
    known = shown()
    for name, labels in chosen(query):
        assert name in known
        for label, value in labels:
            assert set(value.split("|")) <= known[name][label]


def test_the_sample_is_what_a_scrape_shows() -> None:
    assert SAMPLES is not None
    known = shown()
    named = chosen(SAMPLES[1])
    assert len(named) > 10
    for name, labels in named:
        assert name in known
        for label, value in labels:
            assert label == "tool" or value in known[name][label]
    assert f'le="{BUCKETS_S[0]}"' in SAMPLES[1]


def test_the_configuration_scrapes_this_server_and_takes_the_rules() -> None:
    [job] = SCRAPING["scrape_configs"]
    [group] = RULES["groups"]
    assert job["job_name"] == group["name"]
    assert f'up{{job="{job["job_name"]}"}}' in group["rules"][0]["expr"]
    for each in job["static_configs"]:
        assert each["targets"][0].endswith(":9203")
        assert set(each["labels"]) == {"robot"}
    [rules] = SCRAPING["rule_files"]
    assert f"`{rules}`" in PAGE


def test_what_a_span_says_stands_there() -> None:
    assert {name for name in _attributes(CALL) if f"`{name}`" not in PAGE} == set()
    assert f"`{SERVICE}`" in PAGE


def test_prometheus_itself_takes_configuration_and_rules(tmp_path: Path) -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not on the PATH")
    token = tmp_path / "token"
    token.write_text("x", encoding="utf-8")
    given: Any = yaml.safe_load(yaml.safe_dump(SCRAPING))
    given["scrape_configs"][0]["authorization"]["credentials_file"] = str(token)
    (tmp_path / given["rule_files"][0]).write_text(yaml.safe_dump(RULES), encoding="utf-8")
    (tmp_path / "prometheus.yml").write_text(yaml.safe_dump(given), encoding="utf-8")
    ran = subprocess.run(
        [promtool, "check", "config", tmp_path / "prometheus.yml"],
        check=False,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
