"""What a refused configuration says, and how a program ends over it."""

from __future__ import annotations

import re
import traceback

import pytest

from ros2_memory.config import exit_on_config_error, load_settings
from ros2_memory.core.errors import ConfigError
from tests.support.config_folders import refusal


class TestRefusals:
    @pytest.mark.parametrize(
        ("override", "fragments"),
        [
            ("datas.now=wall", ["datas: unknown key", "recording, data, reader"]),
            ("data.nwo=wall", ["data.nwo: unknown key", "now, tf_clock"]),
            ("+data.nwo=wall", ["data.nwo: unknown key"]),
            ("storage.cache=1", ["storage.cache: unknown key", "_target_"]),
            ("~data.now", ["data.now: missing"]),
            ("~server", ["server: missing"]),
            ("~nothing", ["'nothing' does not exist"]),
            ("server=3", ["server: 3 is not allowed", "must hold keys"]),
            ("data.now=walls", ["data.now: 'walls'", "wall, latest"]),
            ("recording.split_duration_s=-10", ["recording.split_duration_s: -10", "than 0"]),
            ("recording.split_duration_s=2.5", ["2.5", "must be a whole number"]),
            ("recording.split_duration_s='10'", ["'10'", "must be a whole number"]),
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
            ("retention.max_total_gb='2GB'", ["'2GB'", "must be a number in GB, such as 2"]),
            ("recorder.setup_files=[/a", ["is not a setting", "needs quotes as a whole"]),
            ("server.max_reply_chars=10", ["server.max_reply_chars: 10", "1000"]),
            ("data.now=${nothing}", ["data.now: ", "'nothing' not found"]),
            ("server.host=${oc.env:NO_SUCH_VARIABLE}", ["server.host: ", "NO_SUCH_VARIABLE"]),
            ("data.now=???", ["data.now: ", "issing"]),
            ("storage=parquet", ["storage: 'parquet'", "mcap, rosbag2"]),
            ("storage=null", ["storage: None", "mcap, rosbag2"]),
            ("storage=[mcap,rosbag2]", ["storage: ['mcap', 'rosbag2']", "mcap, rosbag2"]),
            ("recorder=fast", ["recorder: 'fast'", "none, ros2bag"]),
            ("deployment=moon", ["deployment: 'moon'", "local, query_only, replay, robot"]),
            ("server.port", ["'server.port' is not a setting", "key=value"]),
            ("/bags/monday", ["is not a setting", "recording.bag_dir=/bags/monday"]),
            ("data.now='wall", ["is not a setting", "key=value"]),
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
    def test_show_no_secret_of_what_is_no_setting(self, override: str) -> None:
        variables = [{"MEMORY_CONFIG_OVERRIDES": text} for text in (override, f"'{override}")]
        for overrides, env in (([override], {}), *(((), variable) for variable in variables)):
            with pytest.raises(ConfigError) as caught:
                load_settings(overrides, env)
            assert "s3cret" not in "".join(traceback.format_exception(caught.value))
            assert re.search("secret|shell|token", str(caught.value))


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
