"""The rules of `recording.keep_when`, as they are configured."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from ros2_memory.bootstrap import rules_of
from ros2_memory.config import load_settings
from ros2_memory.core.errors import ConfigError

if TYPE_CHECKING:
    from ros2_memory.triggers.rules import Rule

ROOT: Final = Path(__file__).resolve().parents[2]
BUMPER: Final = "topic: /bumper, condition_type: equals, value: true"


def rules(tmp_path: Path, text: str, moments_bytes: int = 10**9) -> tuple[Rule, ...]:
    path = tmp_path / "triggers.yaml"
    path.write_text(text)
    return rules_of(load_settings([f"recording.keep_when={path}"]), moments_bytes)


def test_the_ready_rules_are_valid_and_none_is_on(tmp_path: Path) -> None:
    shipped = (ROOT / "config" / "triggers.yaml").read_text(encoding="utf-8")
    assert rules(tmp_path, shipped) == ()
    commented = shipped[shipped.index("# rules:") :].splitlines()
    ready = rules(tmp_path, "\n".join(line.removeprefix("# ") for line in commented))
    assert [each.name for each in ready] == [
        "bumper",
        "error in the log",
        "diagnostics error",
        "battery low",
        "path blocked",
        "recorder restarted",
        "odometry silent",
    ]
    by_topic = {each.name for each in ready if each.topic is not None}
    assert {each.name for each in ready} - by_topic == {"recorder restarted"}
    assert [each.name for each in ready if each.name in by_topic and each.condition is None] == [
        "odometry silent"
    ]
    assert sum(each.max_bytes for each in ready) <= 10**9


@pytest.mark.parametrize(
    ("rule", "reason"),
    [
        ("topic: /bumper", "must have topic, condition_type and value"),
        ("topic: /a, condition_type: like, value: x", "'like' is not one of"),
        ("topic: /a, condition_type: above, value: 1", "needs field"),
        ("kind: silent, topic: /a", "must have topic and for_s"),
        (f"kind: silent, for_s: 3, {BUMPER}", "must not have a condition"),
        ("kind: recorder_restart, topic: /a", "must have neither topic nor for_s"),
        (f"{BUMPER}, before_s: 4000", "before_s"),
        (f'{BUMPER}, label: "a\\nb"', "its label has characters"),
        (f"{BUMPER}, after: 3", "after"),
        (f"{BUMPER}, max_gb: 1.5", "max_gb of all rules together is 1.5"),
    ],
)
def test_what_is_no_rule_is_refused(tmp_path: Path, rule: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        rules(tmp_path, f"rules: {{wrong: {{{rule}}}}}")
