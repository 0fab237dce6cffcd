"""`ros2-memory watch`: what is not as usual is seen, on a terminal and in a log."""

import os
import re
import shutil
import time
from pathlib import Path

import pytest

from ros2_memory.bag_dir.state_files import Loss, append_losses
from ros2_memory.cli import watch
from ros2_memory.cli.watch import AS_USUAL, assessment
from ros2_memory.columns.units import GoneError
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.scan import count_messages
from tests.support.bags import boolean, log_entry, odom, text, write_mcap, write_splits
from tests.support.heartbeats import beat
from tests.support.program import Program
from tests.unit.cli.conftest import Using


@pytest.fixture(autouse=True)
def bag_dir(tmp_path: Path, using: Using) -> Path:
    """A minute at 10 Hz, in which one topic falls silent and another becomes slow."""
    now, messages = time.time_ns(), []
    for n in range(600):
        at = now - (600 - n) * NS_PER_S // 10
        messages.append(odom(at, 0.0, 0.0))
        messages += [text(at, "x")] * (n < 300 and n % 10 == 0)
        messages += [boolean(at, data=True)] * (n % (10 if n < 500 else 50) == 0)
    write_splits(tmp_path, messages)
    using(tmp_path, "query_only")
    return tmp_path


def test_a_rate_is_assessed_by_what_is_usual() -> None:
    for rate, usual, age_s, expected in (
        (20.0, 20.0, 0.0, AS_USUAL),
        (9.9, 20.0, 0.0, "slow"),
        (41.0, 20.0, 0.0, "fast"),
        (0.0, 20.0, 11.0, "silent"),
        (0.0, 0.1, 60.0, AS_USUAL),
        (0.0, 0.1, 101.0, "silent"),
        (0.1, 0.4, 5.0, AS_USUAL),
        (0.0, None, 1000.0, AS_USUAL),
    ):
        assert assessment(rate, usual, age_s, 10.0) == expected


def rows_of(output: str) -> dict[str, str]:
    """The row of each topic in a table, and how its rate is."""
    lines = map(str.strip, output.splitlines())
    return {line.split()[0]: line for line in lines if line.startswith("/")}


def test_each_look_says_of_every_topic_whether_its_rate_is_as_usual(exits: Program) -> None:
    output = exits(0, "watch --count 2 --every 0.01").out
    assert re.findall(r"recorder +(\S+)", output) == ["-"] * 2
    rows = rows_of(output)
    assert rows["/odom"].endswith(AS_USUAL)
    assert rows["/chatter"].endswith("silent")
    assert rows["/bumper"].endswith("slow")


def test_it_goes_on_where_stored_columns_are_deleted_meanwhile(
    exits: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = iter([GoneError()])

    def count(*given: object) -> object:
        for error in lost:
            raise error
        return count_messages(*given)  # type: ignore[arg-type]  # as they were given

    monkeypatch.setattr(watch, "count_messages", count)
    assert "/odom" in rows_of(exits(0, "watch --count 1").out)


@pytest.mark.parametrize("has_earlier", [False, True])
def test_a_recording_that_has_just_begun_has_its_usual_rates(
    tmp_path: Path, exits: Program, has_earlier: bool
) -> None:
    now, folder = time.time_ns(), tmp_path / "new"
    spans = {"a": (-300, -200), "b": (-4, 0)} if has_earlier else {"b": (-4, 0)}
    for name, (start, stop) in spans.items():
        times = range(now + start * NS_PER_S, now + stop * NS_PER_S + 1, NS_PER_S // 10)
        write_mcap(folder / name / f"{name}_0.mcap", [odom(at, 0.0, 0.0) for at in times])
    [row] = exits(0, f"watch --count 1 --json --bag-dir {folder}").json["topics"]
    assert (row["rate_hz"], row["assessment"]) == (10, AS_USUAL)


def test_a_log_and_a_topic_that_was_forgotten_are_not_called_silent(
    bag_dir: Path, exits: Program
) -> None:
    begin = time.time_ns() - 70 * NS_PER_S
    lines = [log_entry(begin + n * NS_PER_S, 20, "nav", "hello") for n in range(30)]
    write_mcap(bag_dir / "log" / "log_0.mcap", lines)
    append_losses(bag_dir, [Loss("/chatter", begin, begin + 65 * NS_PER_S, 30, "forgotten")])
    output = exits(0, "watch --count 1").out
    assert "silent" not in output
    assert rows_of(output)["/bumper"].endswith("slow")


def test_a_topic_that_was_taken_from_the_list_is_not_called_silent(
    bag_dir: Path, exits: Program
) -> None:
    beat(bag_dir, time.time_ns(), listed=("/odom", "/bumper"), recordings=("rec",))
    output = exits(0, "watch --count 1").out
    assert rows_of(output)["/chatter"].endswith("not recorded")
    assert rows_of(output)["/bumper"].endswith("slow")


def test_messages_that_two_recordings_have_count_once(bag_dir: Path, exits: Program) -> None:
    shutil.copytree(bag_dir / "rec", bag_dir / "twin")
    rows = exits(0, "watch --count 1 --json").json["topics"]
    rates = {row["topic"]: (row["rate_hz"], row["usual_hz"]) for row in rows}
    assert rates["/odom"] == pytest.approx((10, 10), rel=0.05)


def test_an_empty_memory_can_be_watched(tmp_path: Path, exits: Program) -> None:
    (tmp_path / "none").mkdir()
    shown = exits(0, f"watch --count 1 --bag-dir {tmp_path}/none").out
    assert re.search(r"^latest +-$", shown, re.MULTILINE)


def test_old_data_is_not_judged_by_what_is_usual(tmp_path: Path, exits: Program) -> None:
    messages = [odom((1_700_000_000 * 10 + n) * NS_PER_S // 10, 0.0, 0.0) for n in range(100)]
    bag = write_mcap(tmp_path / "old" / "rec" / "rec_0.mcap", messages)
    os.utime(bag, (1_700_000_010,) * 2)
    output = exits(0, f"watch --count 1 --bag-dir {tmp_path}/old").out
    assert "as usual" not in output
    assert re.search(r"is_live +false", output)
