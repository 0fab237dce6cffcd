"""Configuration folders and schema files of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ros2_memory.bootstrap import query_settings_of
from ros2_memory.config import (
    load_labels,
    load_message_schemas,
    load_settings,
    unused_config,
)
from ros2_memory.core.errors import ConfigError
from tests.support.config_folders import ROOT, copied, edit

if TYPE_CHECKING:
    from collections.abc import Callable


class TestConfigFolder:
    def test_one_beside_is_named_as_unused_unless_it_says_the_same(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.delenv("MEMORY_CONFIG_DIR", raising=False)
        monkeypatch.chdir(copied(tmp_path).parent)
        assert unused_config() is None
        edit(Path("config/config.yaml"), "name: episodic", "name: mine")
        assert "is not used" in (unused_config() or "")


def labels(text: str, tmp_path: Path) -> object:
    path = tmp_path / "labels.yaml"
    path.write_text(text)
    return load_labels(load_settings([f"data.labels_file='{path}'"], {}))


def schemas(text: str, tmp_path: Path) -> object:
    path = tmp_path / "schemas.yaml"
    path.write_text(text)
    return load_message_schemas(load_settings([f"reader.schemas_file='{path}'"], {}))


def require_refused(
    load: Callable[[str, Path], object], tmp_path: Path, text: str, *fragments: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        load(text, tmp_path)
    assert [each for each in fragments if each not in str(caught.value)] == []


class TestMessageSchemas:
    @pytest.mark.parametrize(
        ("text", "fragment"),
        [
            ("schemas: {nav_msgs/Odometry: {position: pose}}", "nav_msgs/msg/Odometry"),
            ("schemas: {a/msg/B: {position: pose..position}}", "schemas.a/msg/B.position"),
            ("schemas: {a/msg/B: {position: 3}}", "schemas.a/msg/B.position: 3"),
            ("schemas: {a/msg/B: position}", "schemas.a/msg/B: 'position'"),
            ("schemas:\n  a/msg/C: {x: y}\n  a/msg/B:\n    x.y: 3", "schemas.yaml, line 4,"),
            ("schemas: {a/msg/B: {'': position}}", "must not be empty"),
            ("schemas: {a/msg/B: {x: y}, a/msg/B: {x: z}}", "duplicate key a/msg/B"),
            ("schema: {}", "schema: unknown key"),
            ("schemas: [", "line 1"),
            ("- a list", "['a list'] is not allowed"),
            ("", "schemas: missing"),
        ],
    )
    def test_a_wrong_file_is_refused_by_file_and_key(
        self, text: str, fragment: str, tmp_path: Path
    ) -> None:
        named = str(tmp_path / "schemas.yaml"), "reader.schemas_file"
        require_refused(schemas, tmp_path, text, fragment, *named)


class TestLabels:
    def test_are_spellings_by_the_name_that_is_shown(self, tmp_path: Path) -> None:
        text = "labels: {mug: [coffee mug, Mug], remote control: [tv-remote]}\n"
        assert labels(text, tmp_path) == {
            "mug": ("coffee mug", "Mug"),
            "remote control": ("tv-remote",),
        }

    def test_reach_the_queries(self, tmp_path: Path) -> None:
        path = tmp_path / "labels.yaml"
        path.write_text("labels: {mug: [coffee mug]}")
        settings = load_settings([f"data.labels_file='{path}'", "data.min_score=0.3"], {})
        limits = query_settings_of(settings)
        assert limits.labels == {"mug": ("coffee mug",)}
        assert limits.min_score == 0.3

    @pytest.mark.parametrize(
        ("text", "fragment"),
        [
            ("labels: {mug: [cup], Glass: [CUP]}", "'CUP' is under 'mug' (as 'cup') and 'Glass'"),
            ("labels: {mug: [tea_cup], cup: [Tea cup]}", "is under 'mug' (as 'tea_cup') and 'cup'"),
            ("labels: {mug: [cups], glass: [cup]}", "is under 'mug' (as 'cups') and 'glass'"),
            ("labels: {mug: [], Mugs: []}", "'Mugs' is under 'mug' (as 'mug') and 'Mugs'"),
            ("labels: {sofa: [couches], seat: [Couch]}", "plurals do not count"),
            ("labels: {mug: [cup], cup: []}", "'cup' is under 'mug' and 'cup'"),
            ("labels: {mug: cup}", "labels.mug: 'cup' is not allowed; must be a list"),
            ("labels: {mug: [3]}", "labels.mug.0: 3 is not allowed"),
            ("labels: {mug: ['']}", "must not be empty"),
            ("labels: {mug: [' ']}", "empty spelling, as under 'mug'"),
            ("labels: {mug: [], mug: [cup]}", "duplicate key mug"),
            ("labels: [mug]", "labels: ['mug'] is not allowed; must hold keys"),
            ("label: {}", "label: unknown key; use one of: labels"),
            ("", "labels: missing"),
        ],
    )
    def test_a_wrong_file_is_refused_by_file_and_key(
        self, text: str, fragment: str, tmp_path: Path
    ) -> None:
        named = str(tmp_path / "labels.yaml"), "data.labels_file"
        require_refused(labels, tmp_path, text, fragment, *named)

    def test_the_shipped_examples_are_valid(self, tmp_path: Path) -> None:
        shipped = (ROOT / "config/labels.yaml").read_text()
        _, commented = shipped.split("labels: {}\n\n")
        uncommented = "".join(line.removeprefix("# ") for line in commented.splitlines(True))
        assert labels(uncommented, tmp_path) == {
            "mug": ("coffee mug", "tea cup"),
            "sofa": ("couch", "settee"),
            "remote control": ("remote", "tv controller"),
        }
