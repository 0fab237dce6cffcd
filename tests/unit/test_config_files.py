"""Configuration folders and schema files of one's own."""

from __future__ import annotations

import shutil
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
from tests.support.config_folders import ROOT, copied, edit, refusal

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.fixture
def own_config(tmp_path: Path) -> Path:
    """A configuration folder of one's own to change."""
    return copied(tmp_path)


class TestConfigFolder:
    def test_files_in_the_working_directory_win_over_those_that_are_shipped(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        own = tmp_path / "config"
        own.mkdir()
        (own / "topics.yaml").write_text("topics: [/odom]\n")
        monkeypatch.chdir(tmp_path)
        settings = load_settings((), {})
        assert settings.recording.topics_file == own / "topics.yaml"
        assert settings.reader.schemas_file == ROOT / "config" / "message_schemas.yaml"
        chosen = load_settings((), {"MEMORY_CONFIG_DIR": str(ROOT / "config")})
        assert chosen.recording.topics_file == ROOT / "config" / "topics.yaml"

    def test_one_beside_is_named_as_unused_unless_it_says_the_same(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.delenv("MEMORY_CONFIG_DIR", raising=False)
        monkeypatch.chdir(copied(tmp_path).parent)
        assert unused_config() is None
        edit(Path("config/config.yaml"), "name: episodic", "name: mine")
        assert "is not used" in (unused_config() or "")

    def test_may_be_relative(self, own_config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(own_config.parent)
        edit(own_config / "config.yaml", "name: episodic", "name: mine")
        assert load_settings((), {"MEMORY_CONFIG_DIR": "config"}).server.name == "mine"

    def test_holds_the_files_that_begin_with_config(self, own_config: Path) -> None:
        env = {"MEMORY_CONFIG_DIR": str(own_config)}
        settings = load_settings(["recording.topics_file=elsewhere/topics.yaml"], env)
        assert settings.reader.schemas_file == own_config / "message_schemas.yaml"
        assert settings.recording.topics_file == Path("elsewhere/topics.yaml")

    @pytest.mark.parametrize(
        ("old", "new", "fragments"),
        [
            ("now: wall ", "now: walls ", ["data.now: 'walls'", "wall, latest"]),
            ("now: wall ", "new: wall ", ["data.new: unknown key", "data.now: missing"]),
            ("server:", "servers:", ["servers: unknown key", "server: missing"]),
            ("port: 9203", "port: [", ["config.yaml", "line"]),
            ("port: 9203", "name: again", ["config.yaml", "duplicate key name"]),
            ("- storage: mcap ", "- storage: tape ", ["storage/tape", "mcap rosbag2"]),
            ("now: wall ", "now: ${data.then} ", ["data.now: ", "data.then"]),
        ],
    )
    def test_a_fault_in_its_files_names_the_place(
        self, own_config: Path, old: str, new: str, fragments: list[str]
    ) -> None:
        edit(own_config / "config.yaml", old, new)
        message = refusal(MEMORY_CONFIG_DIR=str(own_config))
        assert str(own_config) in message
        for fragment in fragments:
            assert fragment in message

    @pytest.mark.parametrize(
        "damage",
        [
            lambda file: file.write_bytes(b"\xff\xfe\x00"),
            lambda file: file.write_text("- a list\n"),
            lambda file: file.write_text("3\n"),
            lambda file: file.write_text(""),
        ],
    )
    def test_a_file_that_is_no_configuration_is_refused(
        self, own_config: Path, damage: Callable[[Path], object]
    ) -> None:
        damage(own_config / "config.yaml")
        assert str(own_config) in refusal(MEMORY_CONFIG_DIR=str(own_config))

    def test_may_lack_presets(self, own_config: Path) -> None:
        shutil.rmtree(own_config / "deployment")
        env = {"MEMORY_CONFIG_DIR": str(own_config)}
        assert load_settings((), env).server.name == "episodic"
        assert "'robot' is not allowed" in refusal(MEMORY_DEPLOYMENT="robot", **env)

    def test_may_bring_a_preset_of_its_own(self, own_config: Path) -> None:
        (own_config / "deployment/warehouse.yaml").write_text(
            "# @package _global_\ndata:\n  pose_topic: /amcl_pose\n"
        )
        env = {"MEMORY_CONFIG_DIR": str(own_config), "MEMORY_DEPLOYMENT": "warehouse"}
        assert load_settings((), env).data.pose_topic == "/amcl_pose"


class TestMessageSchemas:
    @staticmethod
    def load(text: str, tmp_path: Path) -> object:
        path = tmp_path / "schemas.yaml"
        path.write_text(text)
        return load_message_schemas(load_settings([f"reader.schemas_file='{path}'"], {}))

    def test_are_a_mapping_of_types_to_fields(self, tmp_path: Path) -> None:
        text = "schemas:\n  nav_msgs/msg/Odometry:\n    position: pose.pose.position\n"
        assert self.load(text, tmp_path) == {
            "nav_msgs/msg/Odometry": {"position": "pose.pose.position"}
        }

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
        with pytest.raises(ConfigError) as caught:
            self.load(text, tmp_path)
        assert fragment in str(caught.value)
        assert str(tmp_path / "schemas.yaml") in str(caught.value)
        assert "reader.schemas_file" in str(caught.value)

    def test_a_missing_file_is_refused_by_file_and_key(self, tmp_path: Path) -> None:
        path = tmp_path / "none.yaml"
        settings = load_settings([f"reader.schemas_file='{path}'"], {})
        with pytest.raises(ConfigError, match="No such file") as caught:
            load_message_schemas(settings)
        assert f"reader.schemas_file: {path}" in str(caught.value)


class TestLabels:
    @staticmethod
    def load(text: str, tmp_path: Path) -> object:
        path = tmp_path / "labels.yaml"
        path.write_text(text)
        return load_labels(load_settings([f"data.labels_file='{path}'"], {}))

    def test_are_spellings_by_the_name_that_is_shown(self, tmp_path: Path) -> None:
        text = "labels: {mug: [coffee mug, Mug], remote control: [tv-remote]}\n"
        assert self.load(text, tmp_path) == {
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
        with pytest.raises(ConfigError) as caught:
            self.load(text, tmp_path)
        assert fragment in str(caught.value)
        assert str(tmp_path / "labels.yaml") in str(caught.value)
        assert "data.labels_file" in str(caught.value)

    def test_the_shipped_examples_are_valid(self, tmp_path: Path) -> None:
        shipped = (ROOT / "config/labels.yaml").read_text()
        _, commented = shipped.split("labels: {}\n\n")
        uncommented = "".join(line.removeprefix("# ") for line in commented.splitlines(True))
        assert self.load(uncommented, tmp_path) == {
            "mug": ("coffee mug", "tea cup"),
            "sofa": ("couch", "settee"),
            "remote control": ("remote", "tv controller"),
        }
