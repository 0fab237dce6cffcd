"""What programs do not import, which would have them start later, and take more memory."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import along_x, text, write_mcap
from tests.support.housekeepers import own_all

T0 = 1_700_000_000 * NS_PER_S
SERVING = {"mcp", "mcp_types", "sse_starlette", "starlette", "uvicorn"}
ANSWERING = {
    "anyio",
    "numpy",
    "rosbags",
    *(
        f"ros2_memory.{room}"
        for room in ("columns", "history.context", "queries", "serving.dispatch", "tools")
    ),
}
CONFIGURING = {"hydra", "omegaconf", "yaml"}
LOOKING = {"rich", "structlog"}
DELETING = {
    "ros2_memory.recorder.housekeeping",
    "ros2_memory.retention.repair",
    "ros2_memory.retention.saved_moments",
    "ros2_memory.storage.mcap.writer",
}
RECORDING = {
    f"ros2_memory.{room}" for room in ("recorder.ros2bag", "recorder.supervisor", "retention.clear")
}
FLEET = {"ros2_memory.fleet"}
PEOPLE = {"pyarrow", "ros2_memory.cli", "ros2_memory.demo", "typer"}


@pytest.fixture
def env(tmp_path: Path) -> dict[str, str]:
    messages = along_x(T0, 5, mps=1.0)
    write_mcap(tmp_path / "bags" / "rec_0" / "rec_0.mcap", [*messages, text(T0, "a word")])
    own_all(tmp_path / "bags")
    return {
        **os.environ,
        "MEMORY_BAG_DIR": str(tmp_path / "bags"),
        "MEMORY_DEPLOYMENT": "robot",
        "MEMORY_CONFIG_OVERRIDES": "data.now=latest",
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }


def imported(program: str, env: dict[str, str]) -> list[list[str]]:
    """Modules that are there at each `seen()` of a program, in an interpreter of its own."""
    begun = "import json, sys\ntold = []\ndef seen():\n    told.append([*sys.modules])\n"
    ended = "\nsys.stderr.write(chr(10) + json.dumps(told))"
    done = subprocess.run(
        [sys.executable, "-c", begun + program + ended],
        env=env,
        capture_output=True,
        text=True,
        check=True,
    )
    told: list[list[str]] = json.loads(done.stderr.splitlines()[-1])
    return told


def test_a_command_imports_what_it_needs(env: dict[str, str]) -> None:
    """Each is run after those that need less, in one interpreter: it need not start for each."""
    nearly_all = SERVING | DELETING | RECORDING
    without = {
        "--help": nearly_all | ANSWERING | CONFIGURING | LOOKING,
        "--version": nearly_all | ANSWERING | CONFIGURING | LOOKING,
        "config show": nearly_all | ANSWERING,
        "index": nearly_all,
        "topics": nearly_all,
        "info": nearly_all,
        "ask get_position_seconds_ago seconds_ago=0": nearly_all | FLEET,
        "forget --last 100 --dry-run": SERVING | RECORDING,
    }
    program = (
        "from ros2_memory import cli\n"
        f"for line in {[*without]}:\n"
        "    assert cli.main(line.split()) == 0, line\n"
        "    seen()\n"
    )
    for (line, absent), there in zip(without.items(), imported(program, env), strict=True):
        assert absent.isdisjoint(there), line


def test_the_recorder_imports_nothing_that_answers(env: dict[str, str]) -> None:
    program = (
        "import ros2_memory.recorder.__main__\n"
        "from ros2_memory import bootstrap, config\n"
        "settings = config.load_settings()\n"
        "reader = bootstrap.build_reader(settings)\n"
        "from ros2_memory.bag_dir.own_recordings import OwnRecordings\n"
        "bag_dir = settings.recording.bag_dir\n"
        "from ros2_memory.recorder.background import Background\n"
        "own = OwnRecordings(bag_dir)\n"
        "bootstrap.build_housekeeper(settings, bag_dir, reader, own, Background())\n"
        "seen()\n"
    )
    ((*there,),) = imported(program, env)
    rooms = {f"ros2_memory.{room}" for room in ("columns", "history.context", "queries")}
    assert (SERVING | PEOPLE | rooms | {"anyio"}) & {*there} == set()


def test_the_server_imports_nothing_that_records_deletes_or_is_for_people(
    env: dict[str, str],
) -> None:
    program = (
        "from ros2_memory import bootstrap, bootstrap_fleet, config, server\n"
        "settings = config.load_settings()\n"
        "memory = bootstrap.build_memory(settings)\n"
        "assert bootstrap_fleet.build_fleet(settings) is None\n"
        "bootstrap.build_server(settings, memory, bootstrap.build_telemetry(settings, memory))\n"
        "bootstrap.build_backfill(settings, memory)\n"
        "seen()\n"
    )
    ((*there,),) = imported(program, env)
    observing = {"opentelemetry.sdk", "prometheus_client", "ros2_memory.observability.prometheus"}
    absent = DELETING | RECORDING | PEOPLE | FLEET | observing | {"httpx", "jsonschema"}
    assert absent & {*there} == set()
