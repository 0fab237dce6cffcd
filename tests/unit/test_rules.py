"""Named places, and the rules of `recording.keep_when` and `exclude_when`, as configured."""

import math
from pathlib import Path
from typing import get_args

import pytest

from ros2_memory.bootstrap import exclusions_of, places_of, query_settings_of, rules_of
from ros2_memory.config import load_settings
from ros2_memory.core.errors import ConfigError
from ros2_memory.core.regions import Circle, Place, Polygon, Rectangle, Storey
from ros2_memory.triggers import RuleKind
from ros2_memory.triggers.exclusion import ExclusionRule
from ros2_memory.triggers.rules import Rule
from tests.support.memories import ROOT

BUMPER = "topic: /bumper, condition_type: equals, value: true"


def rules(tmp_path: Path, text: str) -> tuple[Rule, ...]:
    path = tmp_path / "triggers.yaml"
    path.write_text(text)
    return rules_of(load_settings([f"recording.keep_when={path}"]), 10**9)


def test_the_ready_rules_are_valid_and_none_is_on(tmp_path: Path) -> None:
    shipped = (ROOT / "config" / "triggers.yaml").read_text()
    assert rules(tmp_path, shipped) == ()
    commented = shipped[shipped.index("# rules:") :].splitlines()
    ready = rules(tmp_path, "\n".join(line.removeprefix("# ") for line in commented))
    assert {each.kind for each in ready} == {*get_args(RuleKind)}
    assert len(ready) == 7
    assert sum(each.max_bytes for each in ready) <= 10**9


@pytest.mark.parametrize(
    ("rule", "reason"),
    [
        ("topic: /bumper", "must have topic, condition_type and value"),
        ("topic: /a, condition_type: like, value: x", "'like' is not one of"),
        ("topic: /a, condition_type: above, value: 1", "needs field"),
        ("topic: /a, condition_type: equals, value: [1]", "wrong.value: .1. .* must be a text"),
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


PRIVACY = "topic: /privacy_mode, condition_type: equals, value: true"


def exclusions(tmp_path: Path, text: str, *overrides: str) -> tuple[ExclusionRule, ...]:
    path, topics = tmp_path / "exclusions.yaml", tmp_path / "topics.yaml"
    path.write_text(text)
    topics.write_text("topics: [/odom, /privacy_mode, /mission_zone]")
    given = [f"recording.exclude_when={path}", f"recording.topics_file={topics}", *overrides]
    return exclusions_of(load_settings(given))


def test_a_rule_has_what_its_file_says(tmp_path: Path) -> None:
    [rule] = exclusions(tmp_path, f"rules: {{a: {{{PRIVACY}, margin_s: 2.5, stale_s: 4}}}}")
    assert (rule.margin, rule.stale, rule.excludes_unknown) == (2_500_000_000, 4 * 10**9, True)
    assert rule.condition.matches({"value": True})
    [rule] = exclusions(tmp_path, f"rules: {{a: {{{PRIVACY}, on_unknown: keep}}}}")
    assert not rule.excludes_unknown


@pytest.mark.parametrize(
    ("rule", "reason"),
    [
        ("topic: /privacy_mode", "condition_type"),
        ("topic: /p*, condition_type: equals, value: true", "must name one topic"),
        ("topic: /unheard, condition_type: equals, value: true", "/unheard is not recorded"),
        ("topic: /odom, condition_type: like, value: x", "'like' is not one of"),
        (f"{PRIVACY}, margin_s: -1", "margin_s"),
        (f"{PRIVACY}, stale_s: 0", "stale_s"),
        (f"{PRIVACY}, on_unknown: ignore", "on_unknown"),
    ],
)
def test_what_cannot_be_is_refused_with_the_reason(tmp_path: Path, rule: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as refused:
        exclusions(tmp_path, f"rules: {{a: {{{rule}}}}}")
    assert "exclusions.yaml" in str(refused.value)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("rules:\n  a:\n    topic: /x\n    conditon_type: equals\n", "conditon_type: unknown key"),
        ("rules:\n  a: {topic: /x}\n", "condition_type: missing; give it a value .*which"),
        ("rules:\n  a\n    topic: /x\n", "line 3, column"),
        ("rulez: {}\n", "rulez: unknown key.*which"),
    ],
)
def test_a_server_does_not_start_with_rules_that_it_cannot_read(
    tmp_path: Path, text: str, where: str
) -> None:
    """Fails closed: what they exclude could be served. The error names file, line and remedy."""
    path = tmp_path / "exclusions.yaml"
    path.write_text(text)
    settings = load_settings([f"recording.exclude_when={path}", f"recording.bag_dir={tmp_path}"])
    with pytest.raises(ConfigError, match=where) as refused:
        query_settings_of(settings)
    assert str(path) in str(refused.value)
    assert "to exclude nothing, let it contain only `rules: {}`" in str(refused.value)
    path.write_text("rules: {}\n")
    assert not query_settings_of(settings).screened


def test_a_recording_of_too_many_splits_is_refused(tmp_path: Path) -> None:
    text = f"rules: {{a: {{{PRIVACY}}}}}"
    assert exclusions(tmp_path, text, "recording.session_duration_s=50000")
    with pytest.raises(ConfigError, match="5000 splits at most"):
        exclusions(tmp_path, text, "recording.session_duration_s=50001")


def places(folder: Path, text: str) -> tuple[Place, ...]:
    path = folder / "places.yaml"
    path.write_text(text)
    return places_of(load_settings([f"data.places_file={path}"]))


def test_each_place_is_a_circle_a_rectangle_or_a_polygon(tmp_path: Path) -> None:
    found = places(
        tmp_path,
        "places:\n"
        "  dock: {x: 6, y: 0.6, radius_m: 0.4}\n"
        "  kitchen: {x: [0, 5], y: [5.5, 9]}\n"
        "  corner: {frame: yard, polygon: [[0, 0], [2, 0], [0, 2]]}\n"
        "  loft: {x: 6, y: 0.6, radius_m: 0.4, z: [2.2, 5]}\n"
        "  bedroom: {x: [0, 5], y: [5.5, 9], z: [2.2, null]}\n"
        "  cellar: {polygon: [[0, 0], [2, 0], [0, 2]], z: [null, -1]}\n"
        "  tower: {x: 6, y: 0.6, radius_m: 0.4, z: [null, null]}\n",
    )
    assert found == (
        Place("dock", "map", Circle(6.0, 0.6, 0.4)),
        Place("kitchen", "map", Rectangle(0.0, 5.0, 5.5, 9.0)),
        Place("corner", "yard", corner := Polygon(((0.0, 0.0), (2.0, 0.0), (0.0, 2.0)))),
        Place("loft", "map", Storey(Circle(6.0, 0.6, 0.4), 2.2, 5.0)),
        Place("bedroom", "map", Storey(Rectangle(0.0, 5.0, 5.5, 9.0), 2.2, math.inf)),
        Place("cellar", "map", Storey(corner, -math.inf, -1.0)),
        Place("tower", "map", Storey(Circle(6.0, 0.6, 0.4), -math.inf, math.inf)),
    )


@pytest.mark.parametrize(
    "shape",
    [
        "{x: 6, y: 0.6}",
        "{x: [5, 0], y: [0, 9]}",
        "{polygon: [[0, 0], [2, 0]]}",
        "{x: true, y: 1, radius_m: 1}",
        "{x: [0, 1, 2], y: 1}",
        "{polygon: [[0, 0, 0], [2, 0], [0, 2]]}",
        "{x: [0, '2'], y: [0, 1]}",
        "{polygon: [[0, 0], [2, 2], [5, 5], [1, 1]]}",
        "{x: 1, y: 1, radius_m: 1, polygon: [[0, 0], [2, 0], [0, 2]]}",
        "{x: [0, 1], y: [0, 1], radius_m: 1}",
        "{x: .nan, y: 0, radius_m: 1}",
        "{radius_m: 0, x: 1, y: 1}",
        "{colour: red}",
        "{x: 6, y: 0.6, radius_m: 0.4, z: 2}",
        "{x: 6, y: 0.6, radius_m: 0.4, z: [2, 2]}",
        "{x: 6, y: 0.6, radius_m: 0.4, z: [.nan, 2]}",
        "{z: [0, 2]}",
    ],
)
def test_what_is_no_shape_is_refused(tmp_path: Path, shape: str) -> None:
    with pytest.raises(ConfigError, match="places") as caught:
        places(tmp_path, f"places: {{dock: {shape}}}\n")
    assert "\n" not in str(caught.value)
    assert " should " not in str(caught.value)
