"""`ros2-memory plot`: pictures of bags, and what is said where there can be none."""

import math
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.cli import plot
from ros2_memory.core.model import Geodetic, TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.places.local_map import east_north
from tests.support.bags import along_x, battery, boolean, in_order, odom, text, write_mcap
from tests.support.memories import memory_of
from tests.support.program import Program

T0 = 1_700_000_000 * NS_PER_S
S = NS_PER_S

# Not imported here: what it makes of the fonts takes each worker seconds.
pytestmark = [
    pytest.mark.usefixtures("no_deployment"),
    pytest.mark.skipif(find_spec("matplotlib") is None, reason="needs the extra plot"),
]


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
    write_mcap(folder / "rec" / "rec_0.mcap", in_order(first))
    begin = T0 + 60 * S
    second = [odom(begin + n * S // 5, 10.0, n / 5) for n in range(50)]
    write_mcap(folder / "rec" / "rec_1.mcap", second)
    return folder


def test_where_nothing_has_poses_it_says_so(tmp_path: Path, exits: Program) -> None:
    write_mcap(tmp_path / "bag.mcap", [text(T0, "hello")])
    said = exits(2, f"plot path {tmp_path} --out {tmp_path}/x.svg").err
    assert "no topic /odom is recorded" in said


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


def whole_memory(bags: Path) -> plot.PlotWindow:
    return plot.recorded_part(memory_of(bags), TimeWindow.everything())


@pytest.mark.parametrize(
    "kind", ["path", "signal /battery_state --field percentage", "timeline", "recap"]
)
def test_each_is_a_picture_of_the_asked_kind(
    bags: Path, tmp_path: Path, exits: Program, kind: str
) -> None:
    drawn = tmp_path / "drawn.svg"
    printed = exits(0, f"plot {kind} {bags} --out {drawn} --json").json
    assert printed["path"] == str(drawn)
    assert ET.parse(drawn).getroot().tag.endswith("svg")  # noqa: S314 - written just now


def test_the_path_of_a_time_that_a_wrong_clock_gave_is_drawn(
    tmp_path: Path, exits: Program
) -> None:
    for name, begin in (("rec", T0), ("unset", 1000 * S)):
        poses = along_x(begin, 600, mps=0.1)
        write_mcap(tmp_path / name / f"{name}_0.mcap", poses)
    exits(0, f"plot path {tmp_path} --out {tmp_path}/x.svg --start 1000 --end 1600")
    assert (tmp_path / "x.svg").is_file()


def test_a_time_in_which_one_moment_was_recorded_is_drawn(
    bags: Path, tmp_path: Path, exits: Program
) -> None:
    until = (T0 + 1000) / NS_PER_S
    exits(0, f"plot recap {bags} --out {tmp_path}/x.svg --start {until - 5} --end {until}")
    assert (tmp_path / "x.svg").is_file()


def test_of_very_many_topics_a_timeline_draws_the_first_and_says_how_many_there_are(
    tmp_path: Path, exits: Program
) -> None:
    topics = [f"/t{nth:03}" for nth in range(plot.MOST_TOPICS + 1)]
    write_mcap(tmp_path / "bag.mcap", [text(T0 + S, "x", topic=topic) for topic in topics])
    printed = exits(0, f"plot timeline {tmp_path} --out {tmp_path}/x.svg --json").json
    assert "200 of 201 topics are drawn, the first by name" in printed["notes"]
    drawn = (tmp_path / "x.svg").read_text()
    assert "/t199" in drawn
    assert "/t200" not in drawn


def test_a_signal_has_its_numbers_and_a_gap_where_there_is_none(bags: Path) -> None:
    signals, _ = plot.read_signals(whole_memory(bags), "/battery_state", ["percentage"])
    _, charge = signals["percentage"]
    assert (len(charge), charge[0], charge[-1]) == (30, 80.0, 51.0)
    signals, notes = plot.read_signals(whole_memory(bags), "/odom", ["position.x", "position.y"])
    assert sum(map(math.isnan, signals["position.x"][1])) == 1
    assert notes == []


def test_lanes_show_what_was_recorded_and_what_was_not(bags: Path) -> None:
    shown = whole_memory(bags)
    rows = plot.event_rows(shown, shown.recap())
    start = 1_700_000_000.0
    assert rows["recorded"] == [(start, start + 29.8), (start + 60, start + 69.8)]
    assert rows["gap"] == [(start + 29.8, start + 60)]
    assert "stop" in rows
    topics = plot.topic_rows(shown)
    assert topics["/battery_state"] == [(start, start + 29)]
    assert len(topics["/odom"]) == 2


def test_a_picture_is_of_the_time_that_was_asked_for(bags: Path) -> None:
    """Not of one that begins 2 us before it, at 23:59:59 of the day before."""
    start, end = 1_700_000_010.0, 1_700_000_020.0
    asked = whole_memory(bags)._replace(window=TimeWindow.from_unix(start, end))
    assert asked.span == (start, end)
    recap = asked.recap()
    assert (recap.start, recap.end) == (T0 + 10 * S, T0 + 20 * S)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("path --out path.jpeg", "must end in .svg, .png"),
        ("signal /chatter --out a.svg --field data", "holds no number"),
        ("signal /odom --out a.svg --field pose.no", "has no field"),
        (f"signal /odom --out a.svg {'--field position.x ' * 21}", "at most 20 are drawn"),
        ("timeline --out a.svg --end 2001-01-01", "nothing was recorded in this"),
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

    def fill_the_disk(_: object, path: Path, **_options: object) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", fill_the_disk)
    refused = exits(2, f"plot path --out {out} {bags}")
    assert refused.err == f"ros2-memory plot path: {out}: No space left on device\n"
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"before"]


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
