"""`ros2-memory export`: what comes out is what was recorded, and other programs read it."""

import shutil
from collections import Counter
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import duckdb
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as McapFile
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from ros2_memory import cli
from ros2_memory.cli.export import write_mcap as export_mcap
from ros2_memory.cli.options import parse_time
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.bag_access import StoredMessage
from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.bags import McapLayout, Msg, along_x, odom, text, tf_of, write_db3, write_mcap
from tests.support.mcap_surgery import raw_mcap
from tests.support.memories import memory_of
from tests.support.program import Program
from tests.support.shared_bags import REAL, RECORDED, needs_real, needs_recorded
from tests.unit.cli.conftest import Using, left

T0 = 1_700_000_000 * NS_PER_S
NOW = datetime.fromisoformat("2023-11-14T20:00:00").timestamp()
EMPTY = "std_msgs/msg/Empty"
Row = tuple[str, int, bytes]


def driven(start: int, number: int) -> list[Msg]:
    """Ten seconds of odometry at 10 Hz around a corner, and a word a second."""
    messages: list[Msg] = []
    for n in range(100):
        at = start + n * NS_PER_S // 10
        x, y = (n / 20, 0.1) if n < 50 else (2.5, 0.1 + (n - 50) / 20)
        messages.append(odom(at, x + number / 7, y))
        if n % 10 == 0:
            messages.append(text(at, f"word {number} {n} ü"))
    return messages


@pytest.fixture
def bag_dir(tmp_path: Path, using: Using) -> Path:
    """Two recordings, the second on another day (UTC)."""
    folder = tmp_path / "bags"
    for number, start in enumerate((T0, T0 + 86_400 * NS_PER_S)):
        write_mcap(folder / f"rec_{number}" / f"rec_{number}_0.mcap", driven(start, number))
    using(folder, "replay")
    return folder


def read(path: Path) -> list[Row]:
    """Topic, log time and payload of all messages of a file, by plain rosbags."""
    with Reader(path) as reader:
        return [(connection.topic, at, bytes(raw)) for connection, at, raw in reader.messages()]


def exported(bag_dir: Path, out: Path, *words: str) -> Path:
    """The file that an export of the whole folder makes."""
    asked = f"export --mcap {out} --bag-dir {bag_dir} deployment=replay".split()
    assert cli.main([*asked, *words]) == 0
    return out


def profile_of(path: Path) -> str:
    with path.open("rb") as stream:
        profile: str = make_reader(stream).get_header().profile
    return profile


def things(writer: McapFile) -> None:
    schema = writer.register_schema("Thing", "jsonschema", b'{"type": "object"}')
    channel = writer.register_channel("/thing", "json", schema)
    writer.add_message(channel, T0, b'{"x": 1}', T0)


def test_where_nothing_is_recorded_latched_messages_of_before_are_no_export(
    bag_dir: Path, tmp_path: Path, exits: Program
) -> None:
    mount = tf_of(T0, "base_link", "laser", (0.1, 0.0, 0.0), topic="/tf_static")
    write_mcap(bag_dir / "rec_0" / "rec_0_0.mcap", [mount, *driven(T0 + 3, 0)])
    out = tmp_path / "out.mcap"
    asked = f"export --start {T0 / NS_PER_S + 5000} --end {T0 / NS_PER_S + 6000} --mcap {out}"
    assert "no message is in the window" in exits(2, asked).err
    assert not out.exists()


def test_of_a_time_that_a_file_has_twice_each_command_says_that_both_are_mixed(
    tmp_path: Path, exits: Program
) -> None:
    """As of a simulation that was reset while its clock gave the log times."""
    poses = along_x(T0, 60, mps=0.5)
    write_mcap(tmp_path / "bags" / "run" / "run_0.mcap", [*poses, *poses[:40]])
    bags = tmp_path / "bags"
    for command in (
        f"export --mcap {tmp_path}/copy.mcap {bags}",
        f"cat /odom {bags} --tail 1",
        f"plot path {bags} --out {tmp_path}/x.svg",
    ):
        said = exits(0, command)
        note = (
            "twice, as the clock was set back meanwhile: both are here, mixed in the order of time"
        )
        assert note in said.out + said.err, command


def test_the_profile_is_that_of_ros_2_where_the_first_message_is_cdr(tmp_path: Path) -> None:
    folder = tmp_path / "bags"
    raw_mcap(folder / "json_0.mcap", things)
    write_mcap(folder / "rec_0.mcap", driven(T0 + 1, 0))
    assert profile_of(exported(folder, tmp_path / "all.mcap")) == ""
    ours = exported(folder, tmp_path / "ours.mcap", "--topic", "/odom")
    assert profile_of(ours) == "ros2"
    assert len(read(ours)) == 100


def test_a_topic_that_was_never_recorded_is_noted(
    bag_dir: Path, exits: Program, tmp_path: Path
) -> None:
    write_mcap(bag_dir / "rec_0.mcap", driven(T0 + 1, 0))
    topics = "--topic /odom --topic /odmo"
    noted = exits(0, f"export --mcap {tmp_path}/out.mcap {topics} {bag_dir}").err
    assert "no recorded topic matches /odmo" in noted


def require_the_same(folder: Path, out: Path) -> None:
    """Exports a folder; `mcap`, and where it can `rosbags`, count the same in the file."""
    reader = Rosbag2Reader()
    expected: Counter[str] = Counter()
    readable_by_rosbags = True
    for bag in memory_of(folder, storage="rosbag2").index.refresh().bags:
        expected.update({each.topic: each.count for each in bag.summary.topics})
        for channel in reader.channels(bag.path):
            of_ros2 = channel.schema.encoding in {"", "ros2msg", "ros2idl"}
            readable_by_rosbags &= channel.encoding == "cdr" and of_ros2
    settings = "deployment=replay storage=rosbag2"
    code = cli.main(f"export --mcap {out} --bag-dir {folder} {settings}".split())
    if not expected:
        assert code != 0
        assert not out.exists()
        return
    with out.open("rb") as stream:
        plain = make_reader(stream)
        summary = plain.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == expected.total()
        assert Counter(channel.topic for _, channel, _ in plain.iter_messages()) == expected
    if readable_by_rosbags:
        assert Counter(topic for topic, _, _ in read(out)) == expected


@needs_real
@pytest.mark.parametrize("name", sorted(path.name for path in REAL.glob("*/")))
def test_other_programs_open_what_comes_of_public_robots_bags(tmp_path: Path, name: str) -> None:
    files = [each for each in sorted((REAL / name).iterdir()) if Rosbag2Reader().reads(each)]
    for number, file in enumerate(files):
        # Each by itself: in two recordings a message that is the same counts once.
        folder = tmp_path / str(number)
        folder.mkdir()
        left(Path(shutil.copyfile(file, folder / file.name)))
        out = tmp_path / f"{number}.mcap"
        require_the_same(folder, out)


@needs_recorded
@pytest.mark.parametrize("name", ["session_mcap", "session_sqlite3", "session_zstd_file"])
def test_other_programs_open_what_comes_of_a_recorded_session(tmp_path: Path, name: str) -> None:
    require_the_same(RECORDED / name, tmp_path / "out.mcap")


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_definitions_that_the_bag_lacks_are_written(tmp_path: Path, kind: str) -> None:
    messages = [odom(T0, 1.5, 0.0), text(T0, "x"), Msg("/bell", EMPTY, T0, b"\0\1\0\0\0")]
    file = tmp_path / "bags" / "rec" / f"rec_0.{kind}"
    if kind == "db3":
        write_db3(file, messages, definitions=False)
    else:
        write_mcap(file, messages, McapLayout(definitions=False))
    out = exported(tmp_path / "bags", tmp_path / "out.mcap")
    with AnyReader([out]) as reader:
        values = {
            connection.topic: reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
        }
    assert values.keys() == {"/odom", "/chatter", "/bell"}
    assert "x=1.5," in repr(values["/odom"])


def test_an_interrupted_export_leaves_nothing(bag_dir: Path, tmp_path: Path) -> None:
    def interrupted() -> Iterator[StoredMessage]:
        view = View(memory_of(bag_dir), Call())
        yield from view.stream.messages(["/odom"], TimeWindow.everything())
        raise KeyboardInterrupt

    folder = tmp_path / "out"
    folder.mkdir()
    with pytest.raises(KeyboardInterrupt):
        export_mcap(folder / "out.mcap", interrupted())
    assert [*folder.iterdir()] == []


def test_a_dataset_has_robots_or_has_none(bag_dir: Path, tmp_path: Path, exits: Program) -> None:
    for first, then in (("--robot r1", ""), ("", "--robot r1")):
        rows = tmp_path / f"rows{first}"
        words = ["--parquet", str(rows)]
        exits(0, f"export {first}", *words)
        files = {*rows.rglob("*")}
        assert "--robot" in exits(2, f"export {then}", *words).err
        assert {*rows.rglob("*")} == files


def test_recordings_of_one_name_in_two_folders_stay_apart(tmp_path: Path, exits: Program) -> None:
    for number, mission in enumerate(("a", "b", "moments/20261120T043000Z-x/b")):
        write_mcap(tmp_path / "bags" / mission / "bag" / "bag_0.mcap", driven(T0 + number, number))
    exits(0, f"export --parquet {tmp_path}/rows {tmp_path}/bags")
    found = queried(tmp_path / "rows", "SELECT DISTINCT recording FROM memory ORDER BY recording")
    assert found == [("a/bag",), ("b/bag",)]


def test_what_cannot_be_decoded_has_a_row_that_says_why(tmp_path: Path, exits: Program) -> None:
    odd = Msg("/odd", "nobody_msgs/msg/Knows", T0, b"\x00\x01\x00\x00\x00")
    layout = McapLayout(definitions=False)
    write_mcap(tmp_path / "bags" / "rec" / "rec_0.mcap", [odd], layout)
    err = exits(1, f"export --parquet {tmp_path}/rows {tmp_path}/bags").err
    assert "nobody_msgs/msg/Knows cannot be decoded: their rows have no value" in err
    ((reason, value),) = queried(tmp_path / "rows", "SELECT undecodable, value FROM memory")
    assert reason
    assert value is None


def queried(folder: Path, query: str) -> list[tuple[object, ...]]:
    """What DuckDB gives for a query over `memory`, the dataset of a folder."""
    dataset = f"read_parquet('{folder}/**/*.parquet', hive_partitioning = true)"
    rows: list[tuple[object, ...]] = duckdb.execute(query.replace("memory", dataset)).fetchall()
    return rows


def test_times_are_read_as_people_write_them_and_what_is_none_is_refused() -> None:
    for written, expected in (
        ("1700000000.5", 1_700_000_000.5),
        ("2023-11-14T22:13:20+00:00", 1_700_000_000),
        ("90s", NOW - 90),
        ("10m ago", NOW - 600),
        ("1.5 h", NOW - 5400),
        ("2d", NOW - 172_800),
        ("14:05", "2023-11-14T14:05:00"),
        ("today 14:05:30", "2023-11-14T14:05:30"),
        ("Yesterday 14:05", "2023-11-13T14:05:00"),
        ("yesterday", "2023-11-13T00:00:00"),
        ("24:00", "2023-11-15T00:00:00"),
        ("yesterday 24:00:00", "2023-11-14T00:00:00"),
        ("2023-11-14 14:05", "2023-11-14T14:05:00"),
    ):
        local = datetime.fromisoformat(expected) if isinstance(expected, str) else None
        assert parse_time(written, NOW) == (local.timestamp() if local else expected)
    for wrong in ("noon", "", "25:00", "10 weeks", "yesterday noon", "-5m"):
        with pytest.raises(InvalidArgumentsError, match="yesterday 14:05"):
            parse_time(wrong, NOW)
