"""Configuration: what files, environment and command line come to."""

import dataclasses
import re
import shutil
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.bootstrap import query_settings_of
from ros2_memory.bootstrap_fleet import build_fleet
from ros2_memory.config import (
    Settings,
    load_labels,
    load_message_schemas,
    load_settings,
    plain_values,
)
from ros2_memory.config_sources import Sources, quoted
from ros2_memory.core.errors import ConfigError
from ros2_memory.core.reply import JsonObject
from tests.support.bags import odom, write_mcap
from tests.support.examples import examples
from tests.support.fleets import reply
from tests.support.memories import ROOT
from tests.support.robot_run import write_run

MCAP = "ros2_memory.storage.mcap_reader.McapReader"
ROSBAG2 = "ros2_memory.storage.rosbag2_reader.Rosbag2Reader"
ROS2BAG = "ros2_memory.recorder.ros2bag.Ros2BagRecorder"
NONE = "ros2_memory.recorder.null.NullRecorder"


def refusal(*overrides: str, **env: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_settings(overrides, env)
    return str(caught.value)


PATH_CHARACTERS = st.sampled_from("'\"\\ $#{}[](),:;=~%!&*") | st.characters(
    codec="utf-8", exclude_characters="\0"
)
"""Those that a shell, YAML or Hydra reads as its own come often."""
UNSEARCHABLE = "/" + "x" * 300
"""To look for it is an error, as in a folder that must not be searched."""


def test_defaults_do_not_read_a_dotenv_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / ".env").write_text("MCP_PORT=1\n")
    monkeypatch.chdir(tmp_path)
    assert load_settings((), {}).server.port == 9203


def test_variables_set_keys_and_the_command_line_beats_them(tmp_path: Path) -> None:
    env = {
        "MCP_TRANSPORT": "streamable_http",
        "MCP_HOST": "0.0.0.0",  # noqa: S104
        "MCP_PORT": "1",
        "MEMORY_CONFIG_OVERRIDES": "server.port=2 storage=mcap 'recording.bag_dir=/a b'",
        "MEMORY_DEPLOYMENT": "robot",
        "ROS_VISION_INTERFACES_PATH": str(tmp_path),
    }
    given = load_settings((), env)
    server = given.server
    assert (server.transport, server.host, server.port) == ("http", env["MCP_HOST"], 2)
    assert given.recording.bag_dir == Path("/a b")
    more = tmp_path / "more"
    more.mkdir()
    line = ["server.port=3", "storage=rosbag2", "storage.unpack_max_mb=7", "deployment=replay"]
    settings = load_settings([*line, f"reader.custom_msg_paths=['{more}']"], env)
    assert (settings.server.port, settings.data.now) == (3, "latest")
    storage = settings.storage
    assert (storage.target, storage.arguments) == (ROSBAG2, {"unpack_max_mb": 7})
    # The folder of interfaces joins those of the files.
    assert settings.reader.custom_msg_paths == (more, tmp_path)


@settings(max_examples=examples(30))  # each composes the whole configuration
@given(st.text(PATH_CHARACTERS, min_size=1))
def test_any_path_arrives_as_it_was_written(name: str) -> None:
    if "${" in name:
        assert "MEMORY_BAG_DIR" in refusal(MEMORY_BAG_DIR=f"/bags/{name}")
    else:
        settings = load_settings((), {"MEMORY_BAG_DIR": f"/bags/{name}"})
        assert settings.recording.bag_dir == Path(f"/bags/{name}")


@given(st.lists(PATH_CHARACTERS | st.just("${b}"), min_size=1).map("".join))
def test_any_path_of_a_command_arrives_as_it_was_written(name: str) -> None:
    settings = load_settings([f"recording.bag_dir={quoted(f'/bags/{name}')}"], {})
    assert settings.recording.bag_dir == Path(f"/bags/{name}")


def test_a_working_directory_that_was_deleted_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert "the working directory has been deleted" in refusal()


def test_an_empty_variable_counts_as_unset() -> None:
    names = ("MCP_PORT", "MEMORY_BAG_DIR", "MEMORY_DEPLOYMENT", "MEMORY_CONFIG_DIR")
    env = dict.fromkeys((*names, "ROS_DOMAIN_ID", "MEMORY_CONFIG_OVERRIDES"), "")
    assert load_settings((), env) == load_settings((), {})


@pytest.mark.parametrize("domain", ["233", "-1", "1.5", "robot", " "])
def test_a_wrong_ros_domain_is_refused(domain: str) -> None:
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
        ("ROS_VISION_INTERFACES_PATH", UNSEARCHABLE, ["existing folder"]),
        (
            "MEMORY_CONFIG_OVERRIDES",
            f"reader.custom_msg_paths=[{UNSEARCHABLE}]",
            ["reader.custom_msg_paths", "existing folder"],
        ),
        ("MEMORY_CONFIG_DIR", "/no/such", ["'/no/such'", "config.yaml"]),
        ("MEMORY_CONFIG_DIR", UNSEARCHABLE, ["config.yaml"]),
        ("MEMORY_CONFIG_OVERRIDES", "'server.port=1", ["'server.port=1", "quotation"]),
        (
            "MEMORY_CONFIG_OVERRIDES",
            "'retention.topics={mic: {max_age_h: 1}}'",
            ["retention.topics", "'mic'", "/ or *"],
        ),
        ("MEMORY_CONFIG_OVERRIDES", "memory.texts=[mic]", ["memory.texts", "/ or *"]),
    ],
)
def test_a_wrong_value_is_refused_by_name(name: str, value: str, fragments: list[str]) -> None:
    message = refusal(**{name: value})
    assert name in message
    assert "\n" not in message
    for fragment in fragments:
        assert fragment in message


def test_a_pattern_names_robots_by_what_its_star_stands_for(tmp_path: Path) -> None:
    for name in ("r1", "r2", "no bags"):
        (tmp_path / name).mkdir()
    for name in ("r1", "r2"):
        (tmp_path / name / "bags").mkdir()
    settings = fleet_of(f"{tmp_path}/*/bags")
    assert settings.fleet.robots == {name: tmp_path / name / "bags" for name in ("r1", "r2")}


def test_a_robot_out_of_reach_is_named_and_the_others_are_served(tmp_path: Path) -> None:
    write_run(tmp_path / "r1")
    (tmp_path / "r2").symlink_to(UNSEARCHABLE)
    fleet = build_fleet(fleet_of(f"{tmp_path}/*", f"fleet.places={tmp_path}/*/places.yaml"))
    assert fleet is not None
    found = reply(fleet, "list_recorded_topics", {})
    assert {name for topic in found["topics"] for name in topic["robot_names"]} == {"r1"}
    assert found["robots_failed"] == {"r2": "refused"}


def test_robots_of_a_fleet_may_differ_in_their_topic_of_poses(tmp_path: Path) -> None:
    for name, topic in (("r1", "/odom"), ("r2", "/wheel_odom")):
        poses = [
            dataclasses.replace(odom(second * 10**9, x=second), topic=topic) for second in (1, 2)
        ]
        other = dataclasses.replace(odom(10**9), topic="/other/pose")
        write_mcap(tmp_path / name / "run_0.mcap", [*poses, other])
    fleet = build_fleet(fleet_of(f"{tmp_path}/*", "fleet.pose_topics={r2: /wheel_odom}"))
    assert fleet is not None
    for name, topic in (("r1", "/odom"), ("r2", "/wheel_odom")):
        found = reply(fleet, "get_position_at", {"robot": name, "timestamp": 2})
        assert (found["topic"], found["x"]) == (topic, 2.0)


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
def test_a_fleet_refuses_names_that_could_be_paths_and_patterns_without_robots(
    robots: str, fragment: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(fragment)):
        fleet_of(robots)


def test_tokens_are_files_for_robots_that_there_are() -> None:
    settings = fleet_of("{r1: /a, r2: /b}", "fleet.tokens={/run/site: [r1]}")
    assert settings.fleet.tokens == {Path("/run/site"): ("r1",)}
    with pytest.raises(ConfigError, match="robots of the fleet, not r3"):
        fleet_of("{r1: /a}", "fleet.tokens={/run/site: [r3]}")


def test_a_lake_takes_no_secret_openly() -> None:
    for each in (
        '+lake.properties={s3.secret-access-key: "abc"}',
        '+lake.properties={s3.endpoint: "http://me:abc@nas"}',
        'lake.warehouse="s3://me:abc@bucket/lake"',
    ):
        with pytest.raises(ConfigError, match="secrets_file") as refused:
            load_settings([each], {})
        assert "abc" not in str(refused.value)


def test_a_lake_needs_the_address_of_a_rest_catalogue() -> None:
    with pytest.raises(ConfigError, match="address of the catalogue"):
        load_settings(["lake.catalog=rest"], {})


def fleet_of(robots: str, *more: str) -> Settings:
    return load_settings([f"fleet.robots={robots}", *more], {"MEMORY_DEPLOYMENT": "fleet"})


@pytest.mark.parametrize(
    ("preset", "storage", "recorder", "transport", "now"),
    [
        *((name, MCAP, ROS2BAG, "sse", "wall") for name in ("robot", "spec", "robot_live")),
        *((name, ROSBAG2, NONE, "stdio", "wall") for name in ("query_only", "fleet", "lake")),
        ("replay", ROSBAG2, NONE, "stdio", "latest"),
        ("local", MCAP, NONE, "stdio", "wall"),
    ],
)
def test_presets_set_adapters_and_keys(
    preset: str, storage: str, recorder: str, transport: str, now: str
) -> None:
    robots = ["fleet.robots={r1: /data/r1/bags}"] if preset in {"fleet", "lake"} else []
    settings = load_settings(robots, {"MEMORY_DEPLOYMENT": preset})
    assert (settings.storage.target, settings.recorder.target) == (storage, recorder)
    assert (settings.server.transport, settings.data.now) == (transport, now)


def test_spec_is_robot_without_more_tools_and_robot_live_with_the_split_being_written() -> None:
    robot, live = (
        load_settings((), {"MEMORY_DEPLOYMENT": preset}) for preset in ("robot", "robot_live")
    )
    server = load_settings((), {"MEMORY_DEPLOYMENT": "spec"}).server
    assert (server.tools, server.page, server.write_tools) == ("spec", False, False)
    assert (robot.reader.include_active, live.reader.include_active) == (False, True)
    assert dataclasses.replace(live, reader=robot.reader) == robot


@pytest.mark.parametrize("target", ["os.system", NONE])
def test_an_adapter_that_is_not_listed_is_refused(target: str) -> None:
    message = refusal(f"storage._target_={target}")
    assert message.startswith(f"storage._target_: {target!r} is not allowed")
    assert f"{MCAP}, {ROSBAG2}" in message


@pytest.mark.parametrize("number", ["1e305", f"1{'0' * 400}"])
def test_no_number_is_too_large_for_nanoseconds(number: str) -> None:
    def numbers(values: JsonObject, above: str = "") -> Iterator[str]:
        for name, value in values.items():
            if isinstance(value, dict):
                yield from numbers(value, f"{above}{name}.")
            elif isinstance(value, int | float) and not isinstance(value, bool):
                yield f"{above}{name}"

    keys = {*numbers(plain_values(load_settings((), {})))}
    message = refusal(*(f"{key}={number}" for key in keys))
    accepted = keys - {line.partition(":")[0] for line in message.split("\n")}
    assert accepted <= {"server.max_reply_chars"}


@pytest.mark.parametrize(
    ("override", "fragments"),
    [
        ("datas.now=wall", ["datas: unknown key", "recording, data, reader"]),
        ("memory.places_file=a", ["places_file: unknown key; use", "; data.places_file is a key"]),
        ("recording.required=[{topic: /odom, hz: 1}]", ["required.0.hz: unknown", "topic, min_hz"]),
        ("logging.arguments='yes'", ["logging.arguments: 'yes'", "boolean"]),
        ("storage.cache=1", ["storage.cache: storage=mcap has no such", "rosbag2"]),
        ("lake.engine.memory_mb=512", ["lake.engine: ", "choose that", "on the command line"]),
        ("~data.now", ["data.now: missing"]),
        ("~nothing", ["'nothing' does not exist"]),
        ("server=3", ["server: 3 is not allowed", "must hold keys"]),
        ("data.now=walls", ["data.now: 'walls'", "wall, latest"]),
        ("recording.split_duration_s=-10", ["recording.split_duration_s: -10", "than 0"]),
        ("recording.clear_on_startup=perhaps", ["'perhaps'", "boolean"]),
        ("recording.bag_dir=''", ["recording.bag_dir: ''", "must name a path"]),
        ("recording.bag_dir='~nobody-here/x'", ["recording.bag_dir", "can be found"]),
        ("data.time_tolerance_s=true", ["data.time_tolerance_s: True", "valid number"]),
        ("data.max_plausible_speed_mps=nan", ["nan", "finite"]),
        ("data.pose_topic=''", ["data.pose_topic: ''", "must not be empty"]),
        ("data.tf_topics=/tf", ["data.tf_topics: '/tf'", "must be a list"]),
        ("retention.max_total_gb='2GB'", ["'2GB'", "must be a number in GB, such as 2"]),
        ("recorder.setup_files=[/a", ["is not a setting", "where spaces"]),
        ("server.max_reply_chars=10", ["server.max_reply_chars: 10", "1000"]),
        ("data.now=${nothing}", ["data.now: ", "'nothing' not found"]),
        ("server.host=${oc.env:NO_SUCH_VARIABLE}", ["server.host: ", "NO_SUCH_VARIABLE"]),
        ("storage=parquet", ["storage: 'parquet'", "mcap, rosbag2"]),
        ("server.port", ["'server.port' is not a setting", "key=value"]),
        ("/bags/monday", ["is not a setting", "given as recording.bag_dir=/bags/monday"]),
        ("=3", ["'=3' is not one value for one key"]),
        ("data.now=wall,latest", ["is not one value for one key", "key=[a,b]"]),
    ],
)
def test_refusals_name_the_key_the_value_and_what_is_allowed(
    override: str, fragments: list[str]
) -> None:
    message = refusal(override)
    assert "\n" not in message
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize(
    "override",
    [
        "server={token: s3cret",
        "lake.properties={s3.secret-access-key: s3cret",
        "lake.password=s3cret,other",
        "server.api_token=s3cret",
        "+api_token=[s3cret",
        "API_TOKEN='s3cret",
    ],
)
def test_refusals_show_no_secret_of_what_is_no_setting(override: str) -> None:
    variables = [{"MEMORY_CONFIG_OVERRIDES": text} for text in (override, f"'{override}")]
    for overrides, env in (([override], {}), *(((), variable) for variable in variables)):
        with pytest.raises(ConfigError) as caught:
            load_settings(overrides, env)
        assert "s3cret" not in "".join(traceback.format_exception(caught.value))
        assert re.search("secret|shell|token", str(caught.value))


def labels(path: Path) -> object:
    return load_labels(load_settings([f"data.labels_file='{path}'"], {}))


def schemas(path: Path) -> object:
    return load_message_schemas(load_settings([f"reader.schemas_file='{path}'"], {}))


@pytest.mark.parametrize(
    ("load", "key", "text", "fragment"),
    [
        *(
            (schemas, "reader.schemas_file", *row)
            for row in (
                ("schemas: {nav_msgs/Odometry: {position: pose}}", "nav_msgs/msg/Odometry"),
                ("schemas: {a/msg/B: {position: pose..position}}", "schemas.a/msg/B.position"),
                ("schemas: {a/msg/B: position}", "schemas.a/msg/B: 'position'"),
                ("schemas:\n  a/msg/C: {x: y}\n  a/msg/B:\n    x.y: 3", "wrong.yaml, which"),
                ("schemas: {a/msg/B: {x: y}, a/msg/B: {x: z}}", "duplicate key a/msg/B"),
                ("- a list", "['a list'] is not allowed"),
                ("", "schemas: missing"),
            )
        ),
        *(
            (labels, "data.labels_file", *row)
            for row in (
                (
                    "labels: {mug: [cup], Glass: [CUP]}",
                    "'CUP' is under 'mug' (as 'cup') and 'Glass'",
                ),
                (
                    "labels: {mug: [tea_cup], cup: [Tea cup]}",
                    "is under 'mug' (as 'tea_cup') and 'cup'",
                ),
                ("labels: {mug: [cups], glass: [cup]}", "is under 'mug' (as 'cups') and 'glass'"),
                ("labels: {sofa: [couches], seat: [Couch]}", "plurals do not count"),
                ("labels: {mug: [cup], cup: []}", "'cup' is under 'mug' and 'cup'"),
                ("labels: {mug: cup}", "labels.mug: 'cup' is not allowed; must be a list"),
                ("labels: {mug: [' ']}", "empty spelling, as under 'mug'"),
                ("labels: {mug: [], mug: [cup]}", "duplicate key mug"),
                ("labels: [mug]", "labels: ['mug'] is not allowed; must hold keys"),
                ("labels: " + "[" * 1200, "maximum recursion depth"),
                ("", "labels: missing"),
            )
        ),
    ],
)
def test_a_wrong_file_is_refused_by_file_and_key(
    tmp_path: Path, load: Callable[[Path], object], key: str, text: str, fragment: str
) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert [each for each in (fragment, str(path), key) if each not in str(caught.value)] == []


def test_labels_reach_the_queries(tmp_path: Path) -> None:
    path = tmp_path / "labels.yaml"
    path.write_text("labels: {mug: [coffee mug, Mug]}")
    settings = load_settings([f"data.labels_file='{path}'", "data.min_score=0.3"], {})
    limits = query_settings_of(settings)
    assert limits.labels == {"mug": ("coffee mug", "Mug")}
    assert limits.min_score == 0.3


def test_the_shipped_examples_of_labels_are_valid(tmp_path: Path) -> None:
    shipped = (ROOT / "config/labels.yaml").read_text()
    _, commented = shipped.split("labels: {}\n\n")
    uncommented = "".join(line.removeprefix("# ") for line in commented.splitlines(True))
    path = tmp_path / "labels.yaml"
    path.write_text(uncommented)
    assert labels(path) == {
        "mug": ("coffee mug", "tea cup"),
        "sofa": ("couch", "settee"),
        "remote control": ("remote", "tv controller"),
    }


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The shipped configuration, copied into a folder."""
    return shutil.copytree(ROOT / "config", tmp_path / "config")


@pytest.mark.parametrize("content", ["[", "[" * 1200, "- 1", "", "data: 7", "defaults: 7", "\0"])
def test_files_that_make_no_sense_set_no_key(folder: Path, content: str) -> None:
    (folder / "config.yaml").write_text(content)
    replay = folder / "deployment" / "replay.yaml"  # the one other file that sets the key
    assert Sources(folder, ())("data.now") == f"in {replay}"
    replay.unlink()
    assert Sources(folder, ())("data.now") == f"in {folder}"
