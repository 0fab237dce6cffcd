"""`ros2-memory plot`: pictures of bags, and what is said where there can be none."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.cli.output import format_time
from ros2_memory.core.model import Geodetic, TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import Msg, battery, boolean, make, odom, text, tf, transform, write_mcap
from tests.support.memories import memory_of
from tests.unit.test_positions import fix

pytest.importorskip("matplotlib", reason="needs the extra plot")

from matplotlib.figure import Figure

from ros2_memory.cli import plot
from ros2_memory.cli.options import day_of
from ros2_memory.places.local_map import east_north

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.program import Program

T0 = 1_700_000_000 * NS_PER_S
Capture = pytest.CaptureFixture[str]
S = NS_PER_S


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot that drives 10 m, stands for 20 s and drives on; two bags, half a minute apart."""
    folder = tmp_path_factory.mktemp("bags")
    first = [odom(T0 + n * S // 5, min(n / 5, 10.0), 0.0) for n in range(150)]
    first += [battery(T0 + n * S, 80.0 - n) for n in range(30)]
    first += [
        boolean(T0 + 5 * S, data=False),
        boolean(T0 + 12 * S, data=True),
        text(T0, "a $word$"),
    ]
    write_mcap(folder / "rec" / "rec_0.mcap", sorted(first, key=lambda each: each.log_time))
    begin = T0 + 60 * S
    second = [odom(begin + n * S // 5, 10.0, n / 5) for n in range(50)]
    write_mcap(folder / "rec" / "rec_1.mcap", second)
    return folder


@pytest.fixture(autouse=True)
def no_deployment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MEMORY_DEPLOYMENT", raising=False)
    monkeypatch.delenv("MEMORY_BAG_DIR", raising=False)


def test_where_the_poses_are_on_several_other_topics_it_names_the_option(
    tmp_path: Path, exits: Program
) -> None:
    other = [odom(T0, 0.0, 0.0, topic=name) for name in ("/base/odometry", "/slam/odometry")]
    write_mcap(tmp_path / "bag.mcap", other)
    assert (
        "set data.pose_topic to one of them, or give --topic"
        in exits(2, f"plot path {tmp_path} --out {tmp_path}/x.svg").err
    )


def test_where_nothing_has_poses_it_names_the_command_that_lists_topics(
    tmp_path: Path, exits: Program
) -> None:
    write_mcap(tmp_path / "bag.mcap", [text(T0, "hello")])
    said = exits(2, f"plot path {tmp_path} --out {tmp_path}/x.svg").err
    assert "no topic /odom is recorded; `ros2-memory topics` lists all" in said


def test_where_no_cache_can_be_written_a_plot_leaves_nothing_in_the_temporary_folder(
    bags: Path, tmp_path: Path
) -> None:
    (tmp_path / "no_folder").write_text("")
    (tmp_path / "temporary").mkdir()
    env = os.environ | {
        "XDG_CACHE_HOME": str(tmp_path / "no_folder"),
        "TMPDIR": str(tmp_path / "temporary"),
    }
    env.pop("MPLCONFIGDIR", None)
    program = [sys.executable, "-m", "ros2_memory.cli", "plot", "path", str(bags)]
    out = tmp_path / "path.svg"
    subprocess.run([*program, "--out", str(out)], env=env, check=True, capture_output=True)
    assert out.is_file()
    assert [*(tmp_path / "temporary").iterdir()] == []


def test_without_poses_the_path_is_that_of_the_transforms(tmp_path: Path, exits: Program) -> None:
    """The map jumps by 1 m, as it does when the robot finds where it is."""
    messages = [
        tf(
            T0 + n * S // 2,
            transform(T0 + n * S // 2, "map", "odom", (float(n >= 10), 0.0, 0.0)),
            transform(T0 + n * S // 2, "odom", "base_link", (n / 2, 0.0, 0.0)),
            transform(T0 + n * S // 2, "base_link", "arm", (0.0, n / 2, 0.0)),
        )
        for n in range(21)
    ]
    write_mcap(tmp_path / "bag.mcap", messages)
    asked = asked_in(tmp_path)
    path = plot.path_in(asked)
    assert path.frame == "map"
    assert (path.xs[0], path.xs[-1]) == pytest.approx((0.0, 11.0))
    drawn = f"plot path {tmp_path} --out {tmp_path}/drawn.svg"
    exits(0, f"{drawn} --frame odom")
    assert ">x (m, odom)<" in unwrapped(tmp_path / "drawn.svg")
    assert "kitchen" in exits(2, f"{drawn} --frame kitchen").err


def test_without_poses_and_transforms_it_is_that_of_the_satellite_receiver(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag.mcap", [fix(T0 + n * S, n * 1e-4, -n * 2e-4) for n in (0, 1, 2)])
    path = plot.path_in(asked_in(tmp_path))
    assert path.frame == "east and north of 48.123457, 11.765432"
    # One minute of latitude is a nautical mile, 1852 m, within 1 %.
    east = -2 * 1852 * 0.012 * math.cos(math.radians(48.12))
    assert (path.xs[0], path.ys[0]) == (0.0, 0.0)
    assert (path.xs[-1], path.ys[-1]) == pytest.approx((east, 2 * 1852 * 0.006), rel=0.01)


def test_a_path_of_another_topic_than_the_one_asked_for_is_not_drawn(
    tmp_path: Path, exits: Program
) -> None:
    fixes = [fix(T0 + n * S, n * 1e-4, 0.0) for n in range(3)]
    write_mcap(tmp_path / "a" / "a_0.mcap", fixes)
    drawn = f"--out {tmp_path}/drawn.svg"
    refused = exits(2, f"plot path {tmp_path}/a --topic /fixed {drawn}").err
    assert "no topic /fixed is recorded; similar: /fix" in refused
    poses = [odom(T0, 0.0, 0.0, topic=topic) for topic in ("/a/odom", "/b/odom")]
    write_mcap(tmp_path / "b" / "b_0.mcap", [*fixes, *poses])
    refused = exits(2, f"plot path {tmp_path}/b {drawn}").err
    assert "poses are on /a/odom (nav_msgs/msg/Odometry), /b/odom" in refused
    nowhere = [odom(T0 + n * S, math.nan, math.nan) for n in range(3)]
    write_mcap(tmp_path / "c" / "c_0.mcap", nowhere)
    assert "no pose of /odom has a place" in exits(2, f"plot path {tmp_path}/c {drawn}").err


@given(
    latitude=st.floats(-80, 80),
    longitude=st.floats(-180, 180),
    metres=st.tuples(st.floats(-5000, 5000), st.floats(-5000, 5000)),
)
def test_metres_east_and_north_lead_back_to_the_fix(
    latitude: float, longitude: float, metres: tuple[float, float]
) -> None:
    """By the distance along the great circle, of a sphere that is off by 0.6 % at most."""
    origin = Geodetic(latitude, longitude, 0.0)
    radius = 6_371_000.0
    north = latitude + math.degrees(metres[1] / radius)
    east = longitude + math.degrees(metres[0] / radius / math.cos(math.radians(latitude)))
    wrapped = (east + 180) % 360 - 180
    found = east_north(origin, Geodetic(north, wrapped, 0.0))
    assert math.dist(found, metres) <= 0.007 * math.hypot(*metres) + 1e-3


def test_times_in_errors_are_printed_as_they_are_typed(bags: Path, exits: Program) -> None:
    window = "--start 1700000040 --end 1700000050"
    shown = exits(2, f"plot path {bags} {window} --out {bags}/none.svg").err
    assert format_time(1_700_000_060.0) in shown
    assert "1700000060" not in shown


def unwrapped(picture: Path) -> str:
    """The texts of a picture, whose letters are drawn as paths, are comments in it."""
    return re.sub(r"<!-- (.*?) -->", r">\1<", picture.read_text())


def asked_in(bags: Path) -> plot.Asked:
    return plot.asked_in(memory_of(bags), TimeWindow.everything())


@pytest.mark.parametrize("kind", ["path", "signal /battery_state", "timeline", "recap"])
def test_each_is_a_picture_of_the_asked_kind(
    bags: Path, tmp_path: Path, exits: Program, kind: str
) -> None:
    drawn = tmp_path / "drawn.svg"
    printed = exits(0, f"plot {kind} {bags} --out {drawn} --json").json
    assert printed["path"] == str(drawn)
    assert ET.parse(drawn).getroot().tag.endswith("svg")  # noqa: S314 - written just now


def test_the_path_is_that_of_the_poses(bags: Path) -> None:
    path = plot.path_in(asked_in(bags))
    assert (path.frame, path.xs[0], path.ys[0]) == ("odom", 0.0, 0.0)
    assert (path.xs[-1], path.ys[-1]) == (10.0, 9.8)
    assert np.interp(1_700_000_005.0, path.times, path.xs) == pytest.approx(5.0, abs=0.06)
    assert np.count_nonzero(path.begins) == 2  # nothing was recorded in between


def test_a_curve_is_drawn_to_the_millimetre(tmp_path: Path) -> None:
    turns = [n * math.tau / 100 for n in range(101)]
    circle = [
        odom(T0 + n * S // 10, 2 * math.sin(turn), 2 - 2 * math.cos(turn))
        for n, turn in enumerate(turns)
    ]
    write_mcap(tmp_path / "bag.mcap", circle)
    path = plot.path_in(asked_in(tmp_path))
    middles = [(column[1:] + column[:-1]) / 2 for column in (path.xs, path.ys)]
    assert np.hypot(middles[0], middles[1] - 2) == pytest.approx(2, abs=4e-3)


def test_a_signal_has_its_numbers_and_a_gap_where_there_is_none(bags: Path) -> None:
    total, signals, _ = plot.signals_of(asked_in(bags), "/battery_state", ["percentage"])
    _, charge = signals["percentage"]
    assert (total, charge[0], charge[-1]) == (30, 80.0, 51.0)
    _, signals, notes = plot.signals_of(asked_in(bags), "/odom", [])
    assert [*signals] == ["position.x", "position.y"]  # nothing else changes
    assert sum(map(math.isnan, signals["position.x"][1])) == 1
    assert notes == []


def test_lanes_show_what_was_recorded_and_what_was_not(bags: Path) -> None:
    asked = asked_in(bags)
    rows = {name: spans for name, spans, _ in plot.event_rows(asked, asked.recap())}
    start = 1_700_000_000.0
    assert rows["recorded"] == [(start, start + 29.8), (start + 60, start + 69.8)]
    assert rows["gaps"] == [(start + 29.8, start + 60)]
    assert "stood" in rows
    topics = {name: spans for name, spans, _ in plot.topic_rows(asked)}
    assert topics["/battery_state"] == [(start, start + 29)]
    assert len(topics["/odom"]) == 2


def test_a_day_is_one_of_this_machines_calendar(bags: Path) -> None:
    memory = memory_of(bags)
    window = day_of(memory, None)
    assert window.start <= T0 < window.stop
    assert 23 * 3600 * S <= window.stop - window.start <= 25 * 3600 * S
    assert day_of(memory, "2023-11-15T12:00").start == window.stop


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("path --out path.jpeg", "must end in .svg, .png, .pdf"),
        ("path --out path.svg --topic /chatter", "/chatter"),
        ("signal /chatter --out a.svg --field data", "holds no number"),
        ("signal /odom --out a.svg --field pose.no", "has no field"),
        ("timeline --out a.svg --end 2001-01-01", "nothing was recorded in this"),
        ("recap --out a.svg --day today --last 5", "not both"),
    ],
)
def test_where_there_can_be_no_picture_it_says_why(
    bags: Path,
    tmp_path: Path,
    exits: Program,
    monkeypatch: pytest.MonkeyPatch,
    words: str,
    reason: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert reason in exits(2, f"plot {words} recording.bag_dir={bags}").err
    assert [*tmp_path.iterdir()] == []


def test_a_picture_that_cannot_be_written_leaves_the_one_before(
    bags: Path, tmp_path: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "path.svg"
    out.write_bytes(b"before")

    def fill_the_disk(_: Figure, path: Path, **_options: object) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", fill_the_disk)
    refused = exits(2, f"plot path --out {out} {bags}")
    assert refused.err == f"ros2-memory plot path: {out}: No space left on device\n"
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"before"]


def test_without_the_extra_it_names_the_command_that_installs_it(
    bags: Path, tmp_path: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ros2_memory.bootstrap.find_spec", lambda name: None)
    assert "pip install '.[plot]'" in exits(2, f"plot path {bags} --out {tmp_path}/a.svg").err


def test_a_field_that_is_not_known_at_first_is_drawn(tmp_path: Path) -> None:
    kind = "std_msgs/msg/Float32"
    values = [math.nan, *range(20, 40)]
    messages = [
        Msg("/f", kind, T0 + nth * NS_PER_S, make(kind, data=float(each)))
        for nth, each in enumerate(values)
    ]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", messages)
    _, signals, _ = plot.signals_of(asked_in(tmp_path), "/f", ())
    assert [len(drawn) for _, drawn in signals.values()] == [len(values)]
