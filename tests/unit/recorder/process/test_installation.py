"""Which setup file is taken, and what an RMW needs."""

from pathlib import Path

import pytest

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process.installation import (
    advice_on_rmw,
    advice_on_silence,
    find_installation,
    setup_files_here,
)

NOTHING = {"PATH": "/nonexistent"}


def distribution(root: Path, name: str, *, ros2: bool = True) -> Path:
    folder = root / name
    (folder / "bin").mkdir(parents=True)
    if ros2:
        (folder / "bin" / "ros2").touch(mode=0o755)
    (folder / "setup.bash").touch()
    return folder / "setup.bash"


def test_the_newest_distribution_is_taken_and_ros_1_never(tmp_path: Path) -> None:
    distribution(tmp_path, "humble")
    jazzy = distribution(tmp_path, "jazzy")
    distribution(tmp_path, "noetic", ros2=False)
    assert setup_files_here((), NOTHING, tmp_path) == (jazzy,)


def test_an_environment_that_is_sourced_wins_and_the_setting_over_it(tmp_path: Path) -> None:
    sourced = {"PATH": str(distribution(tmp_path, "jazzy").parent / "bin")}
    mine = Path("/home/me/ws/install/setup.bash")
    assert setup_files_here((), sourced, tmp_path) == ()
    assert setup_files_here((mine,), sourced, tmp_path) == (mine,)


def test_without_ros_2_it_is_said_where_it_was_looked_for_and_what_to_do(tmp_path: Path) -> None:
    distribution(tmp_path, "noetic", ros2=False)
    with pytest.raises(RecorderError, match="there is no ROS 2: `ros2` is not on PATH") as told:
        setup_files_here((), NOTHING, tmp_path)
    assert str(tmp_path) in str(told.value)
    assert "recorder.setup_files=[FILE]" in str(told.value)


def test_an_rmw_that_is_not_installed_is_named_with_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "ros2"
    program.write_text("#!/bin/sh\necho expected $RMW_IMPLEMENTATION >&2; exit 102\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
    with pytest.raises(RecorderError, match="status 102") as told:
        find_installation((), tmp_path)
    assert "install the package ros-$ROS_DISTRO-rmw-zenoh-cpp" in str(told.value)


def test_what_zenoh_and_cyclone_need_is_said_of_them_alone() -> None:
    zenoh, cyclone, fast = (
        {"RMW_IMPLEMENTATION": f"rmw_{name}_cpp"} for name in ("zenoh", "cyclonedds", "fastrtps")
    )
    assert "ros2 run rmw_zenoh_cpp rmw_zenohd" in str(advice_on_rmw(zenoh))
    assert "CYCLONEDDS_URI" in str(advice_on_rmw(cyclone))
    assert advice_on_rmw({}) is advice_on_rmw(fast) is None
    assert advice_on_silence(zenoh) == advice_on_rmw(zenoh)
