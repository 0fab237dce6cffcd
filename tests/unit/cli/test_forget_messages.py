"""`ros2-memory forget --topic`, `--where`: some messages of bags go without a trace, others stay.

What stays is read by plain rosbags, before and after; what goes is looked for in every byte of the
bag directory, in decompressed chunks and in what is stored of them.
"""

import itertools
import json
import os
import shutil
import sqlite3
import subprocess
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from pathlib import Path
from random import Random
from typing import Any

import pytest
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType
from rosbags.rosbag2 import Reader

from ros2_memory.bag_dir.handover_file import Handover, Overlap, message_id, write_handover
from ros2_memory.bag_dir.layout import OWN_FOLDER
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bag_dir.state_files import ERASING, read_losses
from ros2_memory.cli.maintenance import forget as cli_forget
from ros2_memory.columns.store import FILE
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S
from ros2_memory.retention import eraser, repair
from ros2_memory.storage.mcap.writer import McapWriter
from tests.support.bags import (
    McapLayout,
    Msg,
    boolean,
    odom,
    text,
    tf,
    transform,
    write_db3,
    write_mcap,
)
from tests.support.housekeepers import described, made_moment, own_all
from tests.support.mcap_surgery import unpacked
from tests.support.program import Program
from tests.unit.cli.conftest import Forget, Using, columns_in, left, locked

S = NS_PER_S
T0 = 1_700_000_000 * S
SAID = "open-the-bathroom-door"
CAMERA, MIC = "/camera/front", "/mic"
OF_CAMERA = f"--yes --topic {CAMERA}"
Stored = tuple[str, str, int, bytes]


def messages(number: int) -> list[Msg]:
    """Of a split of ten seconds: odometry, a camera and a microphone that say a secret each s."""
    start = T0 + number * 10 * S
    found: list[Msg] = []
    if number == 0:
        mount = transform(start, "base_link", "laser", (0.1, 0.0, 0.2))
        found.append(tf(start, mount, topic="/tf_static"))
    for n in range(10):
        at = start + n * S
        found += [odom(at, number + n / 10, 0.0), boolean(at + 5, n % 2 == 0)]
        found += [text(at + 7, f"{SAID} {number} {n}", CAMERA), text(at + 9, f"hum {n}", MIC)]
    return found


LAYOUTS = {
    "zstd": McapLayout(chunk_size=2048, compression=CompressionType.ZSTD),
    "lz4": McapLayout(chunk_size=2048, compression=CompressionType.LZ4),
    "unchunked": McapLayout(chunk_size=None),
}


def recorded(bag_dir: Path, layout: McapLayout | None = None) -> list[Path]:
    """One recording of three splits, with metadata.yaml."""
    layout = layout or LAYOUTS["zstd"]
    made = [
        write_mcap(bag_dir / "rec_a" / f"rec_a_{n}.mcap", messages(n), layout) for n in range(3)
    ]
    described(bag_dir / "rec_a")
    return [left(each) for each in made]


@pytest.fixture
def bag_dir(tmp_path: Path, using: Using) -> Path:
    bag_dir = tmp_path / "bags"
    using(bag_dir, "robot")
    recorded(bag_dir)
    own_all(bag_dir)
    return bag_dir


def stored(recording: Path) -> list[Stored]:
    """Everything that plain rosbags reads of a recording, as much as metadata.yaml states."""
    with Reader(recording) as reader:
        found = [
            (connection.topic, connection.msgtype, at, bytes(data))
            for connection, at, data in reader.messages()
        ]
        counted = Counter(topic for topic, *_ in found)
        assert all(each.msgcount == counted[each.topic] for each in reader.connections)
        assert reader.message_count == len(found)
    return found


def whole(bag: Path) -> list[tuple[object, ...]]:
    """Everything that plain mcap reads of each message of a file, in file order."""
    with bag.open("rb") as stream:
        return [
            (
                *(schema.name, schema.encoding, schema.data),
                *(channel.topic, channel.message_encoding, sorted(channel.metadata.items())),
                *(message.sequence, message.log_time, message.publish_time, message.data),
            )
            for schema, channel, message in NonSeekingReader(stream).iter_messages(
                log_time_order=False
            )
            if schema is not None
        ]


def traces(root: Path, needle: str) -> list[str]:
    """Where a text is below a directory: in bytes of files, in chunks, in what is packed."""
    found: list[str] = []
    for path in (each for each in root.rglob("*") if each.is_file()):
        is_bag = path.suffix in {".mcap", ".repair"} and path.read_bytes().startswith(b"\x89MCAP")
        parts = unpacked(path) if is_bag else [path.read_bytes()]
        if path.name == FILE:
            parts += columns_in(path)
        if any(needle.encode() in part for part in parts):
            found.append(str(path.relative_to(root)))
    return found


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_is_not_forgotten_stays_to_the_byte(
    bag_dir: Path, forget: Forget, layout: str
) -> None:
    splits = recorded(bag_dir, LAYOUTS[layout])
    before = stored(bag_dir / "rec_a")
    full = [whole(each) for each in splits]
    untouched = splits[2].read_bytes()
    forget(0, 3.5, 15.5, "--yes --topic /camera/*")
    bounds = (T0 + 3.5 * S, T0 + 15.5 * S)
    expected = [e for e in before if e[0] != CAMERA or not bounds[0] <= e[2] <= bounds[1]]
    assert len(before) - len(expected) == 12
    assert stored(bag_dir / "rec_a") == expected
    for split, was in zip(splits, full, strict=True):
        rest = [e for e in was if e[3] != CAMERA or not bounds[0] <= int(str(e[7])) <= bounds[1]]
        assert whole(split) == rest
    assert splits[2].read_bytes() == untouched


def test_nothing_of_it_is_left_anywhere(
    tmp_path: Path, bag_dir: Path, forget: Forget, exits: Program
) -> None:
    exits(0, "index")
    assert f"{OWN_FOLDER}/{FILE}" in " ".join(traces(tmp_path, SAID))
    # A query server has the file open, so that its log lies beside it.
    with closing(sqlite3.connect(bag_dir / OWN_FOLDER / FILE)) as server:
        server.execute("SELECT count(*) FROM bag").fetchone()
        forget(0, 0, 100, OF_CAMERA)
        assert traces(tmp_path, SAID) == []
    exits(0, "index")
    assert traces(tmp_path, SAID) == []
    assert not [*bag_dir.rglob("*.repair"), *bag_dir.rglob("*.tmp")]


def test_nothing_is_left_in_the_stores_of_robots_that_share_the_bags(
    tmp_path: Path, bag_dir: Path, forget: Forget, exits: Program
) -> None:
    robots = f"fleet.robots={{r1: {bag_dir}, r2: {bag_dir}}}"
    exits(0, "index", "deployment=fleet", robots)
    stores = {each for each in traces(tmp_path, SAID) if each.endswith(FILE)}
    assert len(stores) == 2
    forget(0, 0, 100, OF_CAMERA)
    assert traces(tmp_path, SAID) == []


@pytest.mark.parametrize("write", [write_mcap, write_db3])
def test_beside_a_message_that_is_as_large_as_is_allowed(
    bag_dir: Path, forget: Forget, write: Callable[[Path, list[Msg]], Path]
) -> None:
    cloud = text(T0 + S, Random(1).randbytes(33 << 20).hex(), "/cloud")
    suffix = ".mcap" if write is write_mcap else ".db3"
    path = left(write(bag_dir / "big" / f"big_0{suffix}", [cloud, *messages(0)]))
    own_all(bag_dir)
    given = "storage=rosbag2 reader.max_chunk_mb=128"
    assert "forgotten" not in forget(1, 0, 100, f"{OF_CAMERA} storage=rosbag2").out
    forget(0, 0, 100, f"{OF_CAMERA} {given}")
    assert SAID.encode() not in path.read_bytes()


def test_a_moment_that_is_kept_meanwhile_follows(
    tmp_path: Path, bag_dir: Path, forget: Forget, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = bag_dir / "rec_a" / "rec_a_1.mcap"
    link = bag_dir / "moments" / "20260101T000000Z-dance" / "rec_a" / source.name
    cut = McapWriter.cut

    def slow_cut(self: McapWriter, *arguments: Any) -> Counter[str]:
        taken = cut(self, *arguments)
        if not link.exists():
            made_moment(link.parents[1])
            link.parent.mkdir()
            OwnRecordings(bag_dir).add_bags(link.parent, [link.name])
            os.link(source, link)
        return taken

    monkeypatch.setattr(McapWriter, "cut", slow_cut)
    forget(0, 0, 100, OF_CAMERA)
    assert link.samefile(source)
    assert traces(tmp_path, SAID) == []


def test_a_hard_link_elsewhere_is_named_and_holds_nothing_up(
    tmp_path: Path, bag_dir: Path, forget: Forget
) -> None:
    os.link(bag_dir / "rec_a" / "rec_a_1.mcap", tmp_path / "copy.mcap")
    shown = forget(1, 0, 100, OF_CAMERA).out
    assert "rec_a_1.mcap: all of it is still in 1 more hard link of it" in shown
    assert traces(bag_dir, SAID) == []
    # While it is there, no bag is shipped, none leaves a day, and no topic is cut out of one.
    assert ERASING.read(bag_dir) is None


@pytest.mark.parametrize("foreign", ["keep", "delete"])
def test_sidecars_follow(bag_dir: Path, forget: Forget, foreign: str) -> None:
    going, staying = messages(1)[2], messages(1)[0]
    assert going.topic == CAMERA
    ids = {each.topic: [message_id(each.published, each.payload)] for each in (going, staying)}
    sidecar = bag_dir / "rec_a" / "handover.json"
    listed = {"rec_a_1.mcap": ids, "rec_a_2.mcap": {CAMERA: ids[CAMERA]}}
    sidecar.write_text(json.dumps({"format": 1, "state": "counts", "counts_elsewhere": listed}))
    left(sidecar)
    written = sidecar.stat().st_mtime_ns
    forget(0, 9.5, 15, f"{OF_CAMERA} retention.foreign={foreign}")
    told = json.loads(sidecar.read_text())["counts_elsewhere"]
    assert told == {
        "rec_a_1.mcap": {staying.topic: ids[staying.topic]},
        "rec_a_2.mcap": {CAMERA: ids[CAMERA]},
    }
    assert sidecar.stat().st_mtime_ns == written


def test_a_message_that_two_recordings_have_is_counted_once_as_deleted(
    bag_dir: Path, forget: Forget
) -> None:
    cut = T0 + 25 * S
    left(write_mcap(bag_dir / "rec_b" / "rec_b_0.mcap", messages(2)))
    until, begun = (Overlap(None, None, (f"{name}.mcap",)) for name in ("rec_a_2", "rec_b_0"))
    write_handover(bag_dir / "rec_a", Handover(next="rec_b", counts_until=cut, end=until))
    write_handover(bag_dir / "rec_b", Handover(previous="rec_a", counts_from=cut, begin=begun))
    own_all(bag_dir)
    forget(0, 20, 30, OF_CAMERA)
    assert traces(bag_dir, f"{SAID} 2") == []
    assert [loss.lost for loss in read_losses(bag_dir, MIN_NS, MAX_NS)] == [10]


def test_answers_say_that_messages_were_deleted(
    bag_dir: Path, forget: Forget, exits: Program
) -> None:
    forget(0, 2.5, 4.5, OF_CAMERA)
    losses = read_losses(bag_dir, MIN_NS, MAX_NS)
    assert [(each.topic, each.lost, each.by) for each in losses] == [(CAMERA, 2, "forgotten")]
    window = f"start={T0 / S} end={T0 / S + 8}"
    shown = exits(0, f"ask get_topic_in_range topic={CAMERA} {window} --json").out
    assert f"2 messages deleted by request: {CAMERA} (2)" in shown
    then = f"ask get_topic_at_time timestamp={T0 / S + 4} --json topic="
    some = json.loads(exits(1, then + CAMERA).out)
    forget(0, 0, 30, f"--yes --topic {MIC}")
    every = json.loads(exits(1, then + MIC).out)
    assert [some["reason"], every["reason"]] == ["deleted", "deleted"]
    assert "every message of /mic was deleted" in every["detail"]


def test_a_topic_that_was_never_recorded_is_named_before_others_go(
    bag_dir: Path, forget: Forget
) -> None:
    shown = forget(0, 0, 30, f"--dry-run --topic {MIC} --topic '/camra/*'").out
    assert "no recorded topic is named /camra/*\n" in shown
    assert f"{MIC}: 30 messages" in shown
    refused = forget(2, 0, 30, "--yes --topic /a --topic /b").err
    assert "no recorded topic is named /a, /b" in refused


def test_carried_messages_follow_where_their_topic_is_named_unless_a_recorder_has_them(
    bag_dir: Path, forget: Forget
) -> None:
    forget(0, -1, 9.9)
    carried = bag_dir / "latched" / "carried.mcap"
    with locked(bag_dir):
        shown = forget(1, -1, 100, "--yes --topic /tf_static").out
    assert "stays: /tf_static: latched messages, which the recorder" in shown
    assert carried.exists()
    forget(0, -1, 100, "--yes --topic /tf_static")
    assert not carried.exists()
    assert traces(bag_dir, "laser") == []


def test_what_cannot_be_rewritten_stays_as_it_is_and_is_named_with_the_reason(
    bag_dir: Path, forget: Forget
) -> None:
    recording = bag_dir / "rec_a"
    damaged = recording / "rec_a_1.mcap"
    data = bytearray(damaged.read_bytes())
    middle = data.index(b"zstd") + 200
    data[middle : middle + 40] = bytes(40)
    damaged.write_bytes(data)
    left(damaged)
    for number in (3, 4):
        write_mcap(recording / f"rec_a_{number}.mcap", messages(3), McapLayout(finish=False))
    os.truncate(recording / "rec_a_4.mcap", 0)
    for kind in ("MCAP", "db3"):
        (recording / f"rec_a_5.{kind}").write_bytes(b"any")
    told = dict(
        line.removeprefix("stays: rec_a/rec_a_").split(": ", 1)
        for line in forget(1, 0, 100, OF_CAMERA).out.splitlines()
        if line.startswith("stays: ")
    )
    for name, reason in (
        ("1.mcap", ""),
        ("3.mcap", "it is being written"),
        ("4.mcap", "it is being written"),
        ("5.MCAP", "rename it"),
        ("5.db3", "choose storage=rosbag2"),
    ):
        assert reason in told[name]
    assert damaged.read_bytes() == data


def test_what_is_being_written_is_named_wherever_its_times_are(
    bag_dir: Path, forget: Forget
) -> None:
    names = ("rec_20990101T000000Z/rec_20990101T000000Z_0.mcap", "copied/copied_0.db3")
    layout = McapLayout(finish=False, chunk_size=2048)
    write_mcap(bag_dir / names[0], messages(3), layout)
    write_db3(bag_dir / names[1], messages(3))
    own_all(bag_dir)
    for words in (OF_CAMERA, "--yes"):
        shown = forget(1, 30, 40, f"{words} storage=rosbag2").out
        assert all(f"stays: {name}: " in shown for name in names)
        forget(0, 10, 19.9, f"{words} storage=rosbag2")  # it begins later


@pytest.mark.parametrize(
    "statement",
    [
        "",
        "PRAGMA journal_mode = WAL",  # who reads such a file leaves an empty log beside it
        "UPDATE topics SET name = CAST(x'ff' AS TEXT) WHERE name = '/mic'",
    ],
    ids=["plain", "empty log", "name of other bytes"],
)
def test_sqlite_bags_are_written_anew(bag_dir: Path, forget: Forget, statement: str) -> None:
    path = write_db3(bag_dir / "rec_s" / "rec_s_0.db3", messages(0))
    own_all(bag_dir)
    every = "SELECT * FROM messages ORDER BY id"
    with closing(sqlite3.connect(path)) as base:
        base.execute(statement)
        base.execute("INSERT INTO metadata VALUES (1, 9, ?)", ("message_count: 41",))
        base.commit()
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as base:
        before = base.execute(every).fetchall()
    left(path)
    forget(0, 3.5, 100, f"{OF_CAMERA} storage=rosbag2")
    with closing(sqlite3.connect(path)) as base:
        (number,) = base.execute("SELECT id FROM topics WHERE name = ?", (CAMERA,)).fetchone()
        rest = [each for each in before if each[1] != number or each[2] < T0 + 3.5 * S]
        assert base.execute(every).fetchall() == rest
        # It counts messages that are gone; rosbag2 counts those that there are.
        assert not base.execute("SELECT metadata FROM metadata").fetchall()
    assert f"{SAID} 0 4".encode() not in path.read_bytes()
    assert f"{SAID} 0 3".encode() in path.read_bytes()


HOME_BAG = "home/rec_h/rec_h_0.mcap"
ForgetBathroom = Callable[[int, Iterable[Msg]], str]


@pytest.fixture
def forget_bathroom(tmp_path: Path, using: Using, forget: Forget, exits: Program) -> ForgetBathroom:
    """Forgets the time in the bathroom, 3 m to 5 m along X, in a robot's bag of these messages."""

    def run(code: int, body: Iterable[Msg]) -> str:
        left(write_mcap(tmp_path / HOME_BAG, body))
        own_all(tmp_path / "home")
        places = tmp_path / "places.yaml"
        places.write_text("places:\n  bathroom: {frame: odom, x: [3.0, 5.0], y: [-1.0, 1.0]}\n")
        using(tmp_path / "home", "robot")
        exits(0, "index")
        return forget(code, 0, 100, f"--yes --where bathroom data.places_file={places}").out

    return run


def test_the_time_in_a_place_goes_with_a_second_on_either_side(
    tmp_path: Path, forget_bathroom: ForgetBathroom
) -> None:
    """The robot drives at 1 m/s."""
    mount = transform(T0, "base_link", "laser", (0.1, 0.0, 0.2))
    found = [tf(T0, mount, topic="/tf_static")]
    for n in range(100):
        at = T0 + n * S // 10
        found += [odom(at, n / 10, 0.0), text(at + 7, f"{SAID} {n:02}", CAMERA)]
    assert "latched messages stay" in forget_bathroom(0, found)
    times: dict[str, set[int]] = {}
    for each in whole(tmp_path / HOME_BAG):
        times.setdefault(str(each[3]), set()).add((int(str(each[7])) - T0) // 10**8)
    outside = {n for n in range(100) if not 20 <= n <= 60}
    # The track knows to a few centimetres where the robot was, and the robot drives 1 m/s.
    for topic in ("/odom", CAMERA):
        assert times[topic] <= outside | {20, 21, 59, 60}
        assert times[topic] >= outside - {19, 61}
    assert times["/tf_static"] == {0}
    assert traces(tmp_path, f"{SAID} 40") == []
    assert traces(tmp_path, f"{SAID} 70")


def test_of_a_place_what_was_recorded_while_nobody_knew_where_the_robot_was_is_said_to_stay(
    forget_bathroom: ForgetBathroom,
) -> None:
    """The odometry is silent for 40 s, the camera is not."""
    body = [odom(T0 + n * S, n, 0.0) for n in range(60) if not 10 < n < 50]
    body += [text(T0 + n * S + 7, f"{SAID} {n:02}", CAMERA) for n in range(60)]
    unknown = f"from {T0 // S + 10}.000001 to {T0 // S + 50}.000000 (40 s)"
    said = f"what is not known: where the robot was is not known {unknown}"
    assert said in forget_bathroom(1, body)


def test_of_a_place_nothing_stays_because_the_clock_was_set_ahead(
    forget_bathroom: ForgetBathroom,
) -> None:
    """The robot drives on while the clock skips 8 s, of which nothing can have been recorded."""
    body = [odom(T0 + n * S // 10 + 8 * S * (n >= 305), n / 20, 0.0) for n in range(600)]
    body += [text(T0 + n * S + 8 * S * (n > 30) + 7, SAID, CAMERA) for n in range(60)]
    assert "what is not known" not in forget_bathroom(0, body)


def test_whatever_was_done_before_the_power_went_the_next_forget_finishes_it_and_says_so(
    tmp_path: Path,
    bag_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    forget: Forget,
    exits: Program,
) -> None:
    """Between any two steps that change a file."""
    source = bag_dir / "rec_a" / "rec_a_1.mcap"
    link = made_moment(bag_dir / "moments" / "20260101T000000Z-dance") / "rec_a" / source.name
    link.parent.mkdir()
    os.link(source, link)
    exits(0, "index")
    others = [each for each in stored(bag_dir / "rec_a") if each[0] != CAMERA]
    image = tmp_path / "image"
    copy(bag_dir, image)
    finished = False
    for steps in itertools.count():
        copy(image, bag_dir)
        own_all(bag_dir)
        with monkeypatch.context() as patch, suppress(PowerCutError):
            cut_off_after(patch, steps)
            forget(0, 0, 100, OF_CAMERA)
            finished = True
        begun = ERASING.read(bag_dir)
        if not finished and begun is None:
            # Nothing was begun, or everything was done.
            left = traces(bag_dir, SAID)
            assert not left or {*left} >= {*traces(image, SAID)}, steps
        if steps == 1:
            assert "was interrupted" in exits(2, "doctor").out
        shown = forget(0, 500, 501, f"--yes --topic {MIC}").out
        if begun is not None:
            assert "an earlier forget was interrupted" in shown
            assert traces(bag_dir, SAID) == [], steps
            assert stored(bag_dir / "rec_a") == others
            assert ERASING.read(bag_dir) is None
        if finished:
            break
    assert steps > 8


class PowerCutError(BaseException):
    """Ends the program between two steps."""


def copy(folder: Path, to: Path) -> None:
    """Copies recordings and moments, hard links as such, in the place of what is there."""
    shutil.rmtree(to, ignore_errors=True)
    subprocess.run(["cp", "-a", folder, to], check=True)


def cut_off_after(patch: pytest.MonkeyPatch, steps: int) -> None:
    """Lets so many files be replaced, removed or flushed."""
    done = itertools.count()

    def counting(real: Callable[..., object]) -> Callable[..., object]:
        def step(*arguments: object, **named: object) -> object:
            if next(done) >= steps:
                raise PowerCutError
            return real(*arguments, **named)

        return step

    for place, name in (
        (Path, "replace"),
        (os, "link"),
        (repair, "flush"),
        (repair, "correct"),
        (eraser, "append_losses"),
        (ERASING, "remove"),
        (cli_forget, "forget_columns"),
    ):
        patch.setattr(place, name, counting(getattr(place, name)))
