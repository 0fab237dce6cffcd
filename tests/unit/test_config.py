"""Configuration: what files, environment and command line come to."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.config import Settings, load_settings
from ros2_memory.core.errors import ConfigError
from tests.support.config_folders import MCAP, NONE, ROS2BAG, ROSBAG2, refusal
from tests.support.examples import examples

PATH_CHARACTERS = st.sampled_from("'\"\\ $#{}[](),:;=~%!&*") | st.characters(
    codec="utf-8", exclude_characters="\0"
)
"""Those that a shell, YAML or Hydra reads as its own come often."""


class TestDefaults:
    def test_do_not_read_a_dotenv_file(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / ".env").write_text("MCP_PORT=1\n")
        monkeypatch.chdir(tmp_path)
        assert load_settings((), {}).server.port == 9203


class TestEnvironment:
    @pytest.mark.parametrize(
        ("name", "value", "section", "key", "expected"),
        [
            ("MEMORY_BAG_DIR", "/data/my 'bags', [1]", "recording", "bag_dir", None),
            ("MCP_TRANSPORT", "sse", "server", "transport", "sse"),
            ("MCP_TRANSPORT", "http", "server", "transport", "http"),
            ("MCP_TRANSPORT", "streamable_http", "server", "transport", "http"),
            ("MCP_TRANSPORT", "streamable-http", "server", "transport", "http"),
            ("MCP_HOST", "0.0.0.0", "server", "host", "0.0.0.0"),  # noqa: S104
            ("MCP_PORT", "9300", "server", "port", 9300),
        ],
    )
    def test_a_variable_sets_its_key(
        self, name: str, value: str, section: str, key: str, expected: object
    ) -> None:
        settings = load_settings((), {name: value})
        wanted = Path(value) if expected is None else expected
        assert getattr(getattr(settings, section), key) == wanted

    @settings(max_examples=examples(30))  # each composes the whole configuration
    @given(st.text(PATH_CHARACTERS, min_size=1))
    def test_any_path_arrives_as_it_was_written(self, name: str) -> None:
        if "${" in name:
            assert "MEMORY_BAG_DIR" in refusal(MEMORY_BAG_DIR=f"/bags/{name}")
        else:
            settings = load_settings((), {"MEMORY_BAG_DIR": f"/bags/{name}"})
            assert settings.recording.bag_dir == Path(f"/bags/{name}")

    def test_the_interface_folder_joins_those_of_the_files(self, tmp_path: Path) -> None:
        one, two = tmp_path / "one", tmp_path / "two"
        one.mkdir()
        two.mkdir()
        settings = load_settings(
            [f"reader.custom_msg_paths=['{one}']"], {"ROS_VISION_INTERFACES_PATH": str(two)}
        )
        assert settings.reader.custom_msg_paths == (one, two)

    def test_an_empty_variable_counts_as_unset(self) -> None:
        names = ("MCP_PORT", "MEMORY_BAG_DIR", "MEMORY_DEPLOYMENT", "MEMORY_CONFIG_DIR")
        env = dict.fromkeys((*names, "ROS_DOMAIN_ID", "MEMORY_CONFIG_OVERRIDES"), "")
        assert load_settings((), env) == load_settings((), {})

    @pytest.mark.parametrize("domain", ["233", "-1", "1.5", "robot", " "])
    def test_a_wrong_ros_domain_is_refused(self, domain: str) -> None:
        message = refusal(ROS_DOMAIN_ID=domain)
        assert message.startswith("ROS_DOMAIN_ID: ")
        assert repr(domain) in message
        assert "from 0 to 232" in message

    @pytest.mark.parametrize(
        ("name", "value", "fragments"),
        [
            ("MCP_PORT", "http", ["server.port", "'http'", "must be a whole number"]),
            ("MCP_PORT", "70000", ["server.port", "70000", "65535"]),
            ("MCP_TRANSPORT", "tcp", ["server.transport", "'tcp'", "stdio, sse, http"]),
            ("MEMORY_DEPLOYMENT", "moon", ["'moon'", "local, query_only, replay, robot"]),
            ("MEMORY_BAG_DIR", "${HOME}/bags", ["'${HOME}/bags'", "not expanded"]),
            ("ROS_VISION_INTERFACES_PATH", "/no/such", ["'/no/such'", "existing folder"]),
            ("ROS_VISION_INTERFACES_PATH", "~nobody-here/x", ["existing folder"]),
            ("MEMORY_CONFIG_DIR", "/no/such", ["'/no/such'", "config.yaml"]),
            ("MEMORY_CONFIG_OVERRIDES", "'server.port=1", ["'server.port=1", "quotation"]),
            (
                "MEMORY_CONFIG_OVERRIDES",
                "'retention.topics={mic: {max_age_h: 1}}'",
                ["retention.topics", "'mic'", "/ or *"],
            ),
            ("MEMORY_CONFIG_OVERRIDES", "memory.texts=[mic]", ["memory.texts", "/ or *"]),
        ],
    )
    def test_a_wrong_value_is_refused_by_name(
        self, name: str, value: str, fragments: list[str]
    ) -> None:
        message = refusal(**{name: value})
        assert name in message
        assert "\n" not in message
        for fragment in fragments:
            assert fragment in message

    def test_overrides_are_split_as_a_shell_would(self) -> None:
        text = "server.port=1 'recording.bag_dir=/a b' storage=rosbag2 recorder=none"
        settings = load_settings((), {"MEMORY_CONFIG_OVERRIDES": text})
        assert settings.server.port == 1
        assert settings.recording.bag_dir == Path("/a b")
        assert (settings.storage.target, settings.recorder.target) == (ROSBAG2, NONE)


class TestPrecedence:
    def test_the_overrides_variable_beats_a_named_one_and_a_presets_adapter(self) -> None:
        env = {
            "MEMORY_DEPLOYMENT": "replay",
            "MCP_PORT": "1",
            "MEMORY_CONFIG_OVERRIDES": "server.port=2 storage=mcap",
        }
        settings = load_settings((), env)
        assert (settings.server.port, settings.storage.target) == (2, MCAP)

    def test_the_command_line_beats_all(self) -> None:
        env = {
            "MEMORY_DEPLOYMENT": "robot",
            "MCP_PORT": "1",
            "MEMORY_CONFIG_OVERRIDES": "server.port=2 storage=mcap",
        }
        settings = load_settings(["server.port=3", "storage=rosbag2", "deployment=replay"], env)
        assert (settings.server.port, settings.storage.target) == (3, ROSBAG2)
        assert (settings.server.transport, settings.data.now) == ("stdio", "latest")


class TestFleet:
    def test_a_pattern_names_robots_by_what_its_star_stands_for(self, tmp_path: Path) -> None:
        for name in ("r1", "r2", "no bags"):
            (tmp_path / name).mkdir()
        for name in ("r1", "r2"):
            (tmp_path / name / "bags").mkdir()
        settings = fleet_of(f"{tmp_path}/*/bags")
        assert settings.fleet.robots == {name: tmp_path / name / "bags" for name in ("r1", "r2")}

    @pytest.mark.parametrize(
        ("robots", "fragment"),
        [
            ("null", "must name robots"),
            ("/data/r1", "must have one *"),
            ("/nowhere/*/bags", "matches none"),
            ("{../r1: /data}", "not '../r1'"),
            ("{a..b: /data}", "not 'a..b'"),
            ("{r/1: /data}", "not 'r/1'"),
            (f"{{{'r' * 65}: /data}}", "up to 64"),
        ],
    )
    def test_refuses_names_that_could_be_paths_and_patterns_without_robots(
        self, robots: str, fragment: str
    ) -> None:
        with pytest.raises(ConfigError, match=re.escape(fragment)):
            fleet_of(robots)

    def test_tokens_are_files_for_robots_that_there_are(self) -> None:
        settings = fleet_of("{r1: /a, r2: /b}", "fleet.tokens={/run/site: [r1]}")
        assert settings.fleet.tokens == {Path("/run/site"): ("r1",)}
        with pytest.raises(ConfigError, match="robots of the fleet, not r3"):
            fleet_of("{r1: /a}", "fleet.tokens={/run/site: [r3]}")


class TestLake:
    def test_takes_no_secret_openly(self) -> None:
        for each in (
            '+lake.properties={s3.secret-access-key: "abc"}',
            '+lake.properties={s3.endpoint: "http://me:abc@nas"}',
            'lake.warehouse="s3://me:abc@bucket/lake"',
        ):
            with pytest.raises(ConfigError, match="secrets_file") as refused:
                load_settings([each], {})
            assert "abc" not in str(refused.value)

    def test_needs_the_address_of_a_rest_catalogue(self) -> None:
        with pytest.raises(ConfigError, match="address of the catalogue"):
            load_settings(["lake.catalog=rest"], {})


def fleet_of(robots: str, *more: str) -> Settings:
    return load_settings([f"fleet.robots={robots}", *more], {"MEMORY_DEPLOYMENT": "fleet"})


class TestPresets:
    @pytest.mark.parametrize(
        ("preset", "storage", "recorder", "transport", "now"),
        [
            ("robot", MCAP, ROS2BAG, "sse", "wall"),
            ("spec", MCAP, ROS2BAG, "sse", "wall"),
            ("robot_live", MCAP, ROS2BAG, "sse", "wall"),
            ("query_only", ROSBAG2, NONE, "stdio", "wall"),
            ("replay", ROSBAG2, NONE, "stdio", "latest"),
            ("fleet", ROSBAG2, NONE, "stdio", "wall"),
            ("lake", ROSBAG2, NONE, "stdio", "wall"),
            ("local", MCAP, NONE, "stdio", "wall"),
        ],
    )
    def test_set_adapters_and_keys(
        self, preset: str, storage: str, recorder: str, transport: str, now: str
    ) -> None:
        robots = ["fleet.robots={r1: /data/r1/bags}"] if preset in {"fleet", "lake"} else []
        settings = load_settings(robots, {"MEMORY_DEPLOYMENT": preset})
        assert (settings.storage.target, settings.recorder.target) == (storage, recorder)
        assert (settings.server.transport, settings.data.now) == (transport, now)

    def test_spec_offers_what_the_specification_has_and_no_more(self) -> None:
        server = load_settings((), {"MEMORY_DEPLOYMENT": "spec"}).server
        assert (server.tools, server.page, server.write_tools) == ("spec", False, False)

    def test_robot_live_is_robot_that_answers_from_the_split_being_written(self) -> None:
        robot, live = (
            load_settings((), {"MEMORY_DEPLOYMENT": preset}) for preset in ("robot", "robot_live")
        )
        assert (robot.reader.include_active, live.reader.include_active) == (False, True)
        assert dataclasses.replace(live, reader=robot.reader) == robot


class TestAdapters:
    def test_the_node_carries_what_the_constructor_takes(self) -> None:
        settings = load_settings(["storage=rosbag2", "storage.unpack_max_mb=7"], {})
        assert settings.storage.target == ROSBAG2
        assert settings.storage.arguments == {"unpack_max_mb": 7}

    @pytest.mark.parametrize("target", ["os.system", NONE])
    def test_a_class_that_is_not_listed_is_refused(self, target: str) -> None:
        message = refusal(f"storage._target_={target}")
        assert message.startswith(f"storage._target_: {target!r} is not allowed")
        assert f"{MCAP}, {ROSBAG2}" in message

    def test_an_adapter_of_the_other_port_is_refused(self) -> None:
        assert f"{ROS2BAG}, {NONE}" in refusal(f"recorder._target_={MCAP}")

    def test_an_argument_that_it_does_not_take_is_refused(self) -> None:
        said = refusal("storage.unpack_max_mb=3")
        assert said.startswith("storage.unpack_max_mb: unknown key; use one of: _target_ (")
