"""Configuration: what files, environment and command line come to, and what is refused."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.config import (
    config_dir,
    exit_on_config_error,
    load_message_schemas,
    load_settings,
)
from ros2_memory.errors import ConfigError
from ros2_memory.settings import NullRecorderNode

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).resolve().parents[2]
MCAP = "ros2_memory.storage.mcap_reader.McapReader"
ROSBAG2 = "ros2_memory.storage.rosbag2_reader.Rosbag2Reader"
ROS2BAG = "ros2_memory.recorder.ros2bag.Ros2BagRecorder"
NONE = "ros2_memory.recorder.null.NullRecorder"


def refusal(*overrides: str, **env: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_settings(overrides, env)
    return str(caught.value)


@pytest.fixture
def own_config(tmp_path: Path) -> Path:
    """A configuration folder of one's own to change."""
    return shutil.copytree(ROOT / "config", tmp_path / "config")


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


class TestDefaults:
    def test_are_those_of_the_specification(self) -> None:
        settings = load_settings((), {})
        assert dataclasses.asdict(settings) == {
            "recording": {
                "bag_dir": Path("data/bags"),
                "split_duration_s": 10,
                "session_duration_s": 600.0,
                "use_sim_time": False,
                "clear_on_startup": False,
                "topics_file": ROOT / "config/topics.yaml",
            },
            "data": {
                "max_array_length": 50,
                "position_tolerance_m": 0.5,
                "time_tolerance_s": 0.1,
                "pose_topic": "/odom",
                "map_frame": "map",
                "tf_topics": ("/tf",),
                "tf_static_topics": ("/tf_static",),
                "now": "wall",
                "tf_clock": "auto",
                "max_plausible_speed_mps": 10.0,
            },
            "reader": {
                "index_refresh_s": 5.0,
                "include_active": False,
                "custom_msg_paths": (),
                "chunk_cache_mb": 64,
                "max_chunk_mb": 64,
                "schemas_file": ROOT / "config/message_schemas.yaml",
            },
            "retention": {
                "max_total_gb": 5.0,
                "max_age_h": 168.0,
                "min_free_gb": 1.0,
                "max_moments_gb": 1.0,
            },
            "server": {
                "name": "episodic",
                "transport": "stdio",
                "host": "127.0.0.1",
                "port": 9203,
                "call_timeout_s": 25.0,
                "max_reply_chars": 24000,
                "tools": "all",
                "write_tools": False,
                "metrics": False,
                "traces": False,
            },
            "logging": {"level": "info", "format": "json"},
            "storage": {
                "target": MCAP,
                "custom_msg_paths": (),
                "cache_mb": 64,
                "max_chunk_mb": 64,
            },
            "recorder": {
                "target": ROS2BAG,
                "bag_dir": Path("data/bags"),
                "topics_file": ROOT / "config/topics.yaml",
                "split_duration_s": 10,
                "session_duration_s": 600.0,
                "use_sim_time": False,
                "min_free_gb": 1.0,
                "setup_files": (),
                "latched_topics": ("/tf_static",),
                "repeat_latched": (),
                "chunk_bytes": 16384,
            },
        }

    def test_are_frozen(self) -> None:
        settings = load_settings((), {})
        with pytest.raises(dataclasses.FrozenInstanceError):
            settings.server.port = 1  # type: ignore[misc]
        with pytest.raises(dataclasses.FrozenInstanceError):
            settings.server = settings.server  # type: ignore[misc]

    def test_leave_no_trace_in_hydra_or_in_the_working_directory(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        load_settings((), {})
        assert not GlobalHydra.instance().is_initialized()
        assert list(tmp_path.iterdir()) == []

    def test_do_not_read_a_dotenv_file(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / ".env").write_text("MCP_PORT=1\n")
        monkeypatch.chdir(tmp_path)
        assert load_settings((), {}).server.port == 9203

    def test_the_environment_of_the_process_counts_where_none_is_given(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("MCP_PORT", "9300")
        assert load_settings().server.port == 9300


class TestEnvironment:
    @pytest.mark.parametrize(
        ("name", "value", "section", "key", "expected"),
        [
            ("MEMORY_BAG_DIR", "/data/my 'bags', [1]", "recording", "bag_dir", None),
            ("MCP_TRANSPORT", "sse", "server", "transport", "sse"),
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

    @given(st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1))
    def test_any_path_arrives_as_it_was_written(self, name: str) -> None:
        if "${" in name:
            assert "MEMORY_BAG_DIR" in refusal(MEMORY_BAG_DIR=f"/bags/{name}")
        else:
            settings = load_settings((), {"MEMORY_BAG_DIR": f"/bags/{name}"})
            assert settings.recording.bag_dir == Path(f"/bags/{name}")

    def test_home_is_expanded(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("HOME", "/home/robot")
        assert load_settings((), {"MEMORY_BAG_DIR": "~/bags"}).recording.bag_dir == Path(
            "/home/robot/bags"
        )

    def test_the_interface_folder_joins_those_of_the_files(self, tmp_path: Path) -> None:
        one, two = tmp_path / "one", tmp_path / "two"
        one.mkdir()
        two.mkdir()
        settings = load_settings(
            [f"reader.custom_msg_paths=['{one}']"], {"ROS_VISION_INTERFACES_PATH": str(two)}
        )
        assert settings.reader.custom_msg_paths == (one, two)
        assert settings.storage.arguments["custom_msg_paths"] == (one, two)

    def test_an_empty_variable_counts_as_unset(self) -> None:
        names = ("MCP_PORT", "MEMORY_BAG_DIR", "MEMORY_DEPLOYMENT", "MEMORY_CONFIG_DIR")
        env = dict.fromkeys((*names, "ROS_DOMAIN_ID", "MEMORY_CONFIG_OVERRIDES"), "")
        assert load_settings((), env) == load_settings((), {})

    @pytest.mark.parametrize("domain", ["0", "42", "232"])
    def test_a_ros_domain_is_accepted(self, domain: str) -> None:
        assert load_settings((), {"ROS_DOMAIN_ID": domain}) == load_settings((), {})

    @pytest.mark.parametrize("domain", ["233", "-1", "1.5", "robot", " "])
    def test_a_wrong_ros_domain_is_refused(self, domain: str) -> None:
        message = refusal(ROS_DOMAIN_ID=domain)
        assert message.startswith("ROS_DOMAIN_ID: ")
        assert repr(domain) in message
        assert "from 0 to 232" in message

    @pytest.mark.parametrize(
        ("name", "value", "fragments"),
        [
            ("MCP_PORT", "http", ["server.port", "'http'", "valid integer"]),
            ("MCP_PORT", "70000", ["server.port", "70000", "65535"]),
            ("MCP_TRANSPORT", "http", ["server.transport", "'http'", "stdio, sse"]),
            ("MEMORY_DEPLOYMENT", "moon", ["'moon'", "local, query_only, replay, robot"]),
            ("MEMORY_BAG_DIR", "${HOME}/bags", ["'${HOME}/bags'", "not expanded"]),
            ("ROS_VISION_INTERFACES_PATH", "/no/such", ["'/no/such'", "existing folder"]),
            ("ROS_VISION_INTERFACES_PATH", "~nobody-here/x", ["existing folder"]),
            ("MEMORY_CONFIG_DIR", "/no/such", ["'/no/such'", "config.yaml"]),
            ("MEMORY_CONFIG_OVERRIDES", "'server.port=1", ["'server.port=1", "quotation"]),
            ("MEMORY_CONFIG_OVERRIDES", "server.port=x", ["server.port", "'x'", "integer"]),
            ("MEMORY_CONFIG_OVERRIDES", "recorder=fast", ["'fast'", "none, ros2bag"]),
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
    def test_a_preset_beats_the_file(self) -> None:
        assert load_settings((), {"MEMORY_DEPLOYMENT": "robot"}).server.transport == "sse"

    def test_a_named_variable_beats_a_preset(self) -> None:
        env = {"MEMORY_DEPLOYMENT": "robot", "MCP_TRANSPORT": "stdio"}
        assert load_settings((), env).server.transport == "stdio"

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


class TestPresets:
    @pytest.mark.parametrize(
        ("preset", "storage", "recorder", "transport", "now"),
        [
            ("robot", MCAP, ROS2BAG, "sse", "wall"),
            ("robot_live", MCAP, ROS2BAG, "sse", "wall"),
            ("query_only", MCAP, NONE, "stdio", "wall"),
            ("replay", ROSBAG2, NONE, "stdio", "latest"),
            ("local", MCAP, NONE, "stdio", "wall"),
        ],
    )
    def test_set_adapters_and_keys(
        self, preset: str, storage: str, recorder: str, transport: str, now: str
    ) -> None:
        settings = load_settings((), {"MEMORY_DEPLOYMENT": preset})
        assert (settings.storage.target, settings.recorder.target) == (storage, recorder)
        assert (settings.server.transport, settings.data.now) == (transport, now)

    def test_each_shipped_one_is_tested_here(self) -> None:
        shipped = {path.stem for path in (ROOT / "config/deployment").iterdir()}
        assert shipped == {"robot", "robot_live", "query_only", "replay", "local"}

    def test_robot_live_is_robot_that_answers_from_the_split_being_written(self) -> None:
        robot, live = (
            load_settings((), {"MEMORY_DEPLOYMENT": preset}) for preset in ("robot", "robot_live")
        )
        assert (robot.reader.include_active, live.reader.include_active) == (False, True)
        assert dataclasses.replace(live, reader=robot.reader) == robot


class TestAdapters:
    def test_the_node_carries_what_the_constructor_takes(self) -> None:
        overrides = ["storage=rosbag2", "reader.chunk_cache_mb=7", "reader.max_chunk_mb=9"]
        settings = load_settings(overrides, {})
        assert settings.storage.target == ROSBAG2
        assert settings.storage.arguments == {
            "custom_msg_paths": (),
            "cache_mb": 7,
            "max_chunk_mb": 9,
            "unpack_max_mb": 1024,
        }

    def test_hydra_builds_what_the_node_names(self) -> None:
        node = load_settings(["recorder=none"], {}).recorder
        assert isinstance(node, NullRecorderNode)
        built = instantiate({"_target_": node.target, **node.arguments})
        assert f"{type(built).__module__}.{type(built).__qualname__}" == NONE

    @pytest.mark.parametrize("target", ["os.system", NONE])
    def test_a_class_that_is_not_listed_is_refused(self, target: str) -> None:
        message = refusal(f"storage._target_={target}")
        assert message.startswith(f"storage._target_: {target!r} is not allowed")
        assert f"{MCAP}, {ROSBAG2}" in message

    def test_an_adapter_of_the_other_port_is_refused(self) -> None:
        assert f"{ROS2BAG}, {NONE}" in refusal(f"recorder._target_={MCAP}")

    def test_an_argument_that_it_does_not_take_is_refused(self) -> None:
        said = refusal("storage.unpack_max_mb=3")
        assert "_target_, custom_msg_paths, cache_mb, max_chunk_mb" in said


class TestRefusals:
    @pytest.mark.parametrize(
        ("override", "fragments"),
        [
            ("datas.now=wall", ["datas: there is no such key", "recording, data, reader"]),
            ("data.nwo=wall", ["data.nwo: there is no such key", "now, tf_clock"]),
            ("+data.nwo=wall", ["data.nwo: there is no such key"]),
            ("storage.cache=1", ["storage.cache: there is no such key", "cache_mb"]),
            ("~data.now", ["data.now: missing"]),
            ("~server", ["server: missing"]),
            ("~nothing", ["'nothing' does not exist"]),
            ("server=3", ["server: 3 is not allowed", "must hold keys"]),
            ("data.now.deep=1", ["data.now: {'deep': 1}", "wall, latest"]),
            ("data.now=walls", ["data.now: 'walls'", "wall, latest"]),
            ("data.tf_clock=sim", ["data.tf_clock: 'sim'", "auto, stamp, log"]),
            ("logging.level=loud", ["'loud'", "debug, info, warning, error"]),
            ("logging.format=xml", ["'xml'", "json, pretty"]),
            ("recording.split_duration_s=-10", ["recording.split_duration_s: -10", "than 0"]),
            ("recording.split_duration_s=0", ["recording.split_duration_s: 0", "than 0"]),
            ("recording.split_duration_s=2.5", ["2.5", "valid integer"]),
            ("recording.split_duration_s='10'", ["'10'", "valid integer"]),
            ("recording.clear_on_startup=perhaps", ["'perhaps'", "boolean"]),
            ("recording.bag_dir=''", ["recording.bag_dir: ''", "must name a path"]),
            ("recording.bag_dir=7", ["recording.bag_dir: 7", "must be a path"]),
            ("recording.bag_dir='~nobody-here/x'", ["recording.bag_dir", "can be found"]),
            ("data.time_tolerance_s=true", ["data.time_tolerance_s: True", "valid number"]),
            ("data.time_tolerance_s=-0.1", ["-0.1", "greater than or equal to 0"]),
            ("data.max_plausible_speed_mps=nan", ["nan", "finite"]),
            ("data.pose_topic=''", ["data.pose_topic: ''", "must not be empty"]),
            ("data.tf_topics=/tf", ["data.tf_topics: '/tf'", "must be a list"]),
            ("data.tf_topics=[1]", ["data.tf_topics.0: 1", "valid string"]),
            ("reader.index_refresh_s=0", ["reader.index_refresh_s: 0", "than 0"]),
            ("retention.max_age_h=inf", ["retention.max_age_h: inf", "finite"]),
            ("retention.max_total_gb=0", ["retention.max_total_gb: 0", "than 0"]),
            ("server.call_timeout_s=-1", ["server.call_timeout_s: -1", "than 0"]),
            ("server.max_reply_chars=10", ["server.max_reply_chars: 10", "1000"]),
            ("server.port=-1", ["server.port: -1", "equal to 0"]),
            ("data.now=${nothing}", ["data.now: ", "'nothing' not found"]),
            ("server.host=${oc.env:NO_SUCH_VARIABLE}", ["server.host: ", "NO_SUCH_VARIABLE"]),
            ("data.now=???", ["data.now: ", "issing"]),
            ("storage=parquet", ["storage: 'parquet'", "mcap, rosbag2"]),
            ("storage=null", ["storage: None", "mcap, rosbag2"]),
            ("storage=[mcap,rosbag2]", ["storage: ['mcap', 'rosbag2']", "mcap, rosbag2"]),
            ("recorder=fast", ["recorder: 'fast'", "none, ros2bag"]),
            ("deployment=moon", ["deployment: 'moon'", "local, query_only, replay, robot"]),
            ("server.port", ["'server.port' is no override", "key=value"]),
            ("data.now='wall", ["is no override", "key=value"]),
            ("=3", ["'=3' is not one value for one key"]),
            ("data.now=wall,latest", ["is not one value for one key", "key=[a,b]"]),
        ],
    )
    def test_name_the_key_the_value_and_what_is_allowed(
        self, override: str, fragments: list[str]
    ) -> None:
        message = refusal(override)
        assert "\n" not in message
        for fragment in fragments:
            assert fragment in message

    def test_are_all_listed_each_with_its_source(self, own_config: Path) -> None:
        edit(own_config / "config.yaml", "max_age_h: 168", "max_age_h: -1")
        message = refusal(
            "data.now=walls",
            MCP_TRANSPORT="http",
            MEMORY_CONFIG_OVERRIDES="server.call_timeout_s=0",
            MEMORY_CONFIG_DIR=str(own_config),
        )
        lines = sorted(message.splitlines())
        assert [line.split(":")[0] for line in lines] == [
            "data.now",
            "retention.max_age_h",
            "server.call_timeout_s",
            "server.transport",
        ]
        assert lines[0].endswith("(set on the command line)")
        assert lines[1].endswith(f"(set in {own_config / 'config.yaml'})")
        assert lines[2].endswith("(set by MEMORY_CONFIG_OVERRIDES)")
        assert lines[3].endswith("(set by MCP_TRANSPORT)")

    @pytest.mark.parametrize(
        "override", ["reader.chunk_cache_mb=-1", "reader.custom_msg_paths=[/no/such/folder]"]
    )
    def test_come_once_for_a_value_that_an_adapter_repeats(self, override: str) -> None:
        assert refusal(override).splitlines() == [refusal(override)]
        assert refusal(override).startswith("reader.")

    def test_long_values_are_cut(self) -> None:
        message = refusal(f"data.now={'x' * 500}")
        assert len(message) < 200
        assert "xxx..." in message


class TestConfigFolder:
    def test_is_the_checkouts_without_a_variable(self) -> None:
        assert config_dir({}) == ROOT / "config"

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
            ("now: wall ", "new: wall ", ["data.new: there is no such key", "data.now: missing"]),
            ("server:", "servers:", ["servers: there is no such key", "server: missing"]),
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
            ("schemas: {a/msg/B: {'': position}}", "must not be empty"),
            ("schemas: {a/msg/B: {x: y}, a/msg/B: {x: z}}", "duplicate key a/msg/B"),
            ("schema: {}", "schema: there is no such key"),
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


class TestExit:
    def test_a_refused_configuration_is_explained_on_stderr_with_exit_code_2(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with pytest.raises(SystemExit) as caught, exit_on_config_error("ros2-memory-server"):
            load_settings(["data.now=walls"], {})
        assert caught.value.code == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err.splitlines() == [
            "ros2-memory-server cannot start, its configuration is refused:",
            "data.now: 'walls' is not allowed; use one of: wall, latest (set on the command line)",
        ]

    def test_any_other_error_passes(self) -> None:
        with pytest.raises(ZeroDivisionError), exit_on_config_error("ros2-memory"):
            raise ZeroDivisionError
