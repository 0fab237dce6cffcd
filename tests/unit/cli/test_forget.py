"""`ros2-memory forget`: deletes what lies in a window, and nothing else."""

import errno
import io
import json
import os
import shutil
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from ros2_memory import cli
from ros2_memory.bag_dir.handover_file import Counting, Handover, Overlap, write_handover
from ros2_memory.bag_dir.layout import OWN_FOLDER
from ros2_memory.cli.output import format_size
from ros2_memory.columns.store import FILE
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, along_x, odom, text, tf, transform, write_mcap
from tests.support.housekeepers import described, embedding, made_moment, own_all
from tests.support.program import Program
from tests.unit.cli.conftest import Forget, Using, columns_in, left, locked

T0 = 1_700_000_000 * NS_PER_S


@pytest.fixture
def bag_dir(tmp_path: Path, using: Using) -> Path:
    """Four bags of ten seconds, ten seconds apart, in two recordings; /tf_static in the first."""
    for number in range(4):
        start = T0 + number * 20 * NS_PER_S
        messages = along_x(start, 10, mps=0.1)
        messages.append(text(start + NS_PER_S, f"secret{number}"))
        if number == 0:
            mount = transform(start, "base_link", "laser", (0.1, 0.0, 0.2))
            messages.insert(0, tf(start, mount, topic="/tf_static"))
        left(write_mcap(tmp_path / f"rec_{number // 2}" / f"rec_{number}.mcap", messages))
    own_all(tmp_path)
    using(tmp_path, "robot")
    return tmp_path


def bags(bag_dir: Path) -> list[str]:
    return sorted(path.name for path in bag_dir.glob("rec_*/*.mcap"))


def test_it_asks_before_bags_that_lie_wholly_inside_go_and_a_dry_run_only_reports(
    bag_dir: Path, monkeypatch: pytest.MonkeyPatch, forget: Forget
) -> None:
    output = forget(0, 20, 35, "--dry-run").out
    assert "would be deleted: 1 bag" in output
    assert "rec_0/rec_1.mcap" in output
    for answer in ("", "n\n"):
        monkeypatch.setattr("sys.stdin", io.StringIO(answer))
        forget(1, 20, 55, "")
        assert len(bags(bag_dir)) == 4
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    assert "deleted: 2 bags" in forget(0, 20, 55, "").out
    assert bags(bag_dir) == ["rec_0.mcap", "rec_3.mcap"]


def test_latched_messages_that_later_answers_need_are_carried_on(
    bag_dir: Path, forget: Forget, exits: Program
) -> None:
    assert "1 latched message is carried on" in forget(0, 0, 15).out
    (record,) = McapReader().records(
        bag_dir / "latched" / "carried.mcap", ["/tf_static"], TimeWindow.everything()
    )
    assert record.log_time == T0
    asked = json.dumps({"parent": "base_link", "child": "laser", "timestamp": T0 / NS_PER_S + 25})
    exits(0, "ask get_transform_at", asked, "--json")


def test_beside_a_recorder_bags_with_latched_messages_are_kept(
    bag_dir: Path, forget: Forget
) -> None:
    with locked(bag_dir):
        shown = forget(1, 0, 35).out
    assert bags(bag_dir) == ["rec_0.mcap", "rec_2.mcap", "rec_3.mcap"]
    assert "stop the recorder, and forget again" in shown


def test_a_bag_with_another_name_is_reported(bag_dir: Path, forget: Forget) -> None:
    kept = made_moment(bag_dir / "moments" / "20231114T221320Z-x") / "rec_0" / "rec_1.mcap"
    kept.parent.mkdir()
    kept.hardlink_to(bag_dir / "rec_0" / "rec_1.mcap")
    own_all(bag_dir)
    for _ in range(2):
        assert "delete the moment's folder" in forget(1, 20, 35).out
        assert kept.is_file()


def test_of_whole_bags_no_byte_is_left_nor_of_those_that_retention_deleted(
    bag_dir: Path, forget: Forget, exits: Program
) -> None:
    assert cli.main(["index"]) == 0
    store = bag_dir / OWN_FOLDER / FILE
    assert all(f"secret{n}".encode() in unpacked(store) for n in range(4))
    forget(0, 20, 35)
    assert b"secret1" not in unpacked(store) + all_bytes(bag_dir)
    (bag_dir / "rec_1" / "rec_2.mcap").unlink()
    assert "nothing to delete" in forget(0, 40, 55).out
    assert b"secret2" not in unpacked(store) + all_bytes(bag_dir / OWN_FOLDER)
    exits(0, "index")
    assert b"secret3" in unpacked(store)


def unpacked(store: Path) -> bytes:
    return b"".join(columns_in(store))


def all_bytes(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in folder.rglob("*") if path.is_file())


def test_a_folder_that_is_no_option_bags_that_others_record_and_no_window_are_refused(
    bag_dir: Path, forget: Forget, exits: Program
) -> None:
    refused = forget(2, 0, 100, f"{bag_dir} --yes").err
    assert f"'{bag_dir}' is not a setting" in refused
    assert f"a folder of bags is given as recording.bag_dir={bag_dir}" in refused
    for deployment in ("query_only", "replay"):
        assert "recorder=none" in forget(2, 0, 100, f"--yes deployment={deployment}").err
    exits(2, "forget --yes")
    assert "--last" in exits(2, "forget --yes --start 0").err
    assert len(bags(bag_dir)) == 4


def test_foreign_bags_are_kept_and_named_with_what_to_do_and_with_delete_they_go_too(
    bag_dir: Path, forget: Forget
) -> None:
    (bag_dir / "rec_1").rename(bag_dir / "session")
    (bag_dir / "rec_0" / "rec_1.mcap").rename(bag_dir / "loose.mcap")
    shown = forget(1, 0, 100).out
    names = {path.name for path in bag_dir.rglob("*.mcap")}
    assert names == {"carried.mcap", "loose.mcap", "rec_2.mcap", "rec_3.mcap"}
    assert "stays: session/rec_2.mcap: this recorder did not make it; to forget it, " in shown
    assert "`ros2-memory adopt session` first" in shown
    assert "stays: loose.mcap: this recorder did not make it; to forget it, move it" in shown
    forget(0, 40, 100, "--yes retention.foreign=delete")
    assert not (bag_dir / "session").exists()


@pytest.mark.parametrize("more", ["", "--topic /odom"])
def test_a_copy_beside_a_bag_is_named_or_goes_too(bag_dir: Path, forget: Forget, more: str) -> None:
    path = bag_dir / "rec_1" / "rec_3.mcap"
    copy = path.with_name("rec_3 (copy).mcap")
    shutil.copy2(path, copy)
    assert "stays: rec_1/rec_3 (copy).mcap" in forget(1, 55, 100, f"--yes {more}").out
    forget(0, 55, 100, f"--yes retention.foreign=delete {more}")
    assert not copy.exists() or not [*McapReader().summarize(copy).of("/odom")]


@pytest.mark.parametrize("folder", ["latched", "moments/x", "moments/x/rec_1"])
def test_foreign_bags_in_folders_of_the_recorder_go_once_they_are_adopted(
    bag_dir: Path, folder: str, forget: Forget, exits: Program
) -> None:
    made_moment(bag_dir / "moments" / "x")
    name = f"{folder}/y_0.mcap"
    path = left(write_mcap(bag_dir / name, [odom(T0 + 65 * NS_PER_S, 1.0, 0.0)]))
    before = path.read_bytes()
    shown = forget(1, 64, 66, "--yes --topic /odom").out
    assert f"stays: {name}: this recorder did not make it; `ros2-memory adopt`" in shown
    assert f"`ros2-memory adopt {folder}` first" in forget(1, 65, 65).out
    assert path.read_bytes() == before
    exits(0, f"adopt {folder}")
    forget(0, 64, 66, "--yes --topic /odom")
    assert McapReader().summarize(path).count == 0


def test_a_bag_that_took_the_place_of_another_while_it_was_asked_is_kept(
    bag_dir: Path, monkeypatch: pytest.MonkeyPatch, forget: Forget
) -> None:
    def meanwhile(*_: object, **__: object) -> None:
        shutil.copytree(bag_dir / "rec_1", bag_dir / "copy")
        (bag_dir / "rec_1").rename(bag_dir.parent / "away")
        (bag_dir / "copy").rename(bag_dir / "rec_1")

    monkeypatch.setattr("typer.confirm", meanwhile)
    assert "stays: rec_1/rec_2.mcap: it has changed meanwhile" in forget(1, 40, 100, "").out
    assert len([*(bag_dir / "rec_1").glob("*.mcap")]) == 2


def test_a_file_that_cannot_be_read_is_named_wherever_its_mtime_allows_messages(
    bag_dir: Path, forget: Forget
) -> None:
    path = write_mcap(bag_dir / "session" / "session_0.mcap", [odom(T0, 1.0, 0.0)])
    own_all(bag_dir)
    data = bytearray(path.read_bytes())
    data[0] ^= 1
    path.write_bytes(data)
    os.utime(path, (T0 / NS_PER_S + 2 * 86400,) * 2)
    assert "stays: session/session_0.mcap: " in forget(1, -5, 0.5).out


def test_a_form_that_cannot_be_deleted_stays_alone(
    bag_dir: Path, monkeypatch: pytest.MonkeyPatch, forget: Forget
) -> None:
    bag, other = bag_dir / "rec_1" / "rec_2.mcap", bag_dir / "rec_1" / "rec_2.mcap.zstd"
    other.write_bytes(b"compressed")
    left(other)
    size, unlink = bag.stat().st_size, os.unlink

    def refused(path: str, *, dir_fd: int | None = None) -> None:
        if path == other.name:
            raise PermissionError(errno.EPERM, "Operation not permitted", path)
        unlink(path, dir_fd=dir_fd)

    monkeypatch.setattr(os, "unlink", refused)
    printed = forget(1, 39, 55, "--yes storage=mcap").out
    assert f"deleted: 1 bag, {format_size(size)}" in printed
    assert "stays: rec_1/rec_2.mcap.zstd: Operation not permitted" in printed
    assert (bag.exists(), other.exists()) == (False, True)


def test_a_bag_that_a_crash_left_open_is_closed_by_recover_also_where_none_counts(
    bag_dir: Path, forget: Forget, exits: Program
) -> None:
    name = "rec_20231114T221330Z"
    messages = [odom(T0 + 200 * NS_PER_S + n, 1.0, 0.0) for n in range(30)]
    layout = McapLayout(finish=False, chunk_size=400)
    path = left(write_mcap(bag_dir / name / f"{name}_0.mcap", messages, layout))
    write_handover(bag_dir / name, Handover(state=Counting.VOID, previous="rec_1"))
    own_all(bag_dir)
    shown = forget(1, 199, 10**5).out
    assert f"stays: {name}/{path.name}: a crash left it open" in shown
    assert "ros2-memory recover closes it" in shown
    exits(0, f"recover {path}")
    left(path)
    forget(0, 199, 10**5)
    assert not path.exists()


def test_a_bag_with_copies_outside_the_window_stays_and_is_named(
    tmp_path: Path, using: Using, forget: Forget
) -> None:
    """Two recordings overlap; the second one's first split has copies alone, from 8 s to 9 s."""
    using(tmp_path, "robot")
    for name, edges in {"rec_a": (0, 5, 10), "rec_b": (8, 9, 15)}.items():
        for number, (first, last) in enumerate(pairwise(edges)):
            times = range(T0 + first * NS_PER_S, T0 + last * NS_PER_S, NS_PER_S // 10)
            messages = [odom(at, 1.0, 0.0) for at in times]
            left(write_mcap(tmp_path / name / f"{name}_{number}.mcap", messages))
    cut, window = T0 + 9 * NS_PER_S, (T0 + 7 * NS_PER_S, T0 + 10 * NS_PER_S)
    end, begin = Overlap(*window, ("rec_a_1.mcap",)), Overlap(*window, ("rec_b_0.mcap",))
    write_handover(tmp_path / "rec_a", Handover(next="rec_b", counts_until=cut, end=end))
    write_handover(tmp_path / "rec_b", Handover(previous="rec_a", counts_from=cut, begin=begin))
    own_all(tmp_path)
    # What counts of rec_a_1 ends at 9 s; its copies at 10 s.
    shown = forget(1, -1, 9.05).out
    assert bags(tmp_path) == ["rec_a_1.mcap", "rec_b_1.mcap"]
    assert "stays: rec_a/rec_a_1.mcap: it reaches beyond the window" in shown


def test_metadata_lists_what_is_left_or_it_says_why_not_and_what_to_do(
    bag_dir: Path, forget: Forget
) -> None:
    metadata = described(bag_dir / "rec_0")
    shown = forget(0, 0, 15).out
    info = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]
    assert (info["relative_file_paths"], info["message_count"]) == (["rec_1.mcap"], 11)
    assert "rec_0/metadata.yaml describes what is left" in shown
    metadata = described(bag_dir / "rec_1")
    metadata.write_text(metadata.read_text().replace("version: ", "version: -"))
    before = metadata.read_text()
    output = forget(0, 40, 55).out
    assert "rec_1/metadata.yaml still describes what was deleted (it is of version" in output
    assert f"ros2 bag reindex {metadata.parent}" in output
    assert metadata.read_text() == before


def test_without_a_list_nothing_goes_before_it_is_adopted(
    bag_dir: Path, exits: Program, forget: Forget
) -> None:
    # What a recorder embeds, a copy without its list embeds as well.
    shutil.rmtree(bag_dir / ".episodic")
    name = "rec_20231114T221320Z"
    path = embedding(bag_dir / name / f"{name}_0.mcap", start=T0 + 200 * NS_PER_S)
    left(path)
    shown = forget(1, 190, 300).out
    assert path.exists()
    assert f"`ros2-memory adopt {name}` first" in shown
    exits(0, f"adopt {name}")
    forget(0, 190, 300)
    assert not path.exists()
