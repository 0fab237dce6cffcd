"""The benchmark: its bags are what it says, and its sides answer the same. No time is judged."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING

import pytest
from benchmarks import one_robot, ours, report
from benchmarks.__main__ import main, measured
from benchmarks.bags import MESSAGES_OF_A_SPLIT, ODOM, TOPICS, made
from benchmarks.copies import copied
from benchmarks.payloads import NEVER_SEEN, typestore
from benchmarks.questions import QUESTIONS, Case, Target
from benchmarks.timing import FLOOR, OURS, PLAIN, DisagreementError, Timed, agreed, timed
from benchmarks.week import WEEK_QUESTIONS, Week
from rosbags.rosbag2 import Reader

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from benchmarks.bags import History
    from benchmarks.timing import Ask


@pytest.fixture(autouse=True)
def no_collecting(monkeypatch: pytest.MonkeyPatch) -> None:
    """For exact times the garbage of all tests would be collected before each side."""
    monkeypatch.setattr("benchmarks.timing.gc.collect", lambda: 0)


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> History:
    return made(tmp_path_factory.mktemp("benchmark"), 2)


def test_plain_rosbags_reads_the_stated_number_of_messages_from_every_split(
    history: History,
) -> None:
    for split in history.splits():
        with Reader(split.path) as reader:
            found = Counter(connection.topic for connection, _, _ in reader.messages())
        assert found == {topic.name: topic.messages for topic in TOPICS}
    assert MESSAGES_OF_A_SPLIT == 1261


def test_plain_rosbags_opens_the_recording_as_a_whole(history: History) -> None:
    folder = next(history.splits()).path.parent
    with Reader(folder) as reader:
        assert sum(1 for _ in reader.messages()) == 2 * MESSAGES_OF_A_SPLIT


def test_every_message_decodes_and_lies_inside_its_split(history: History) -> None:
    for split in history.splits():
        with Reader(split.path) as reader:
            for connection, moment, raw in reader.messages():
                decoded = typestore().deserialize_cdr(raw, connection.msgtype)
                assert split.start <= moment < split.start + 10_000_000_000
                assert NEVER_SEEN not in repr(decoded)


def test_bags_that_lie_there_are_taken_as_they_are(history: History) -> None:
    before = [split.path.stat().st_ino for split in history.splits()]
    again = made(history.folder.parent, 2)
    assert [split.path.stat().st_ino for split in again.splits()] == before


def test_an_unfinished_folder_is_made_anew(tmp_path: Path) -> None:
    (tmp_path / "bags_1" / "rec_0000").mkdir(parents=True)
    (tmp_path / "bags_1" / "rec_0000" / "half.mcap").touch()
    (split,) = made(tmp_path, 1).splits()
    assert [path.name for path in sorted(split.path.parent.iterdir())] == [
        "handover.json",
        "metadata.yaml",
        split.path.name,
    ]


def test_a_history_without_bags_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="1 or more"):
        made(tmp_path, 0)


@pytest.mark.parametrize("slug", QUESTIONS)
def test_all_sides_agree_on_the_answer(history: History, slug: str) -> None:
    case = Case(history, ours.settings_for(history.folder))
    (row,) = measured({slug: QUESTIONS[slug]}, case, runs=1)
    assert row.slug == slug
    assert all(count for _, count in row.asks)


def test_the_sides_that_are_compared_do_answer(history: History) -> None:
    case = Case(history, ours.settings_for(history.folder))
    answers = {
        slug: {
            name: [ask() for ask in side()] for name, side in QUESTIONS[slug](case).sides.items()
        }
        for slug in ("index", "point-cold", "samples", "trajectory", "never-seen")
    }
    assert dict(answers["index"][OURS][0])[ODOM.name] == 2 * ODOM.messages  # type: ignore[call-overload]
    assert len(answers["point-cold"][FLOOR]) == 2
    assert len(answers["samples"][PLAIN][0]) == 100  # type: ignore[arg-type]
    # 14 s at the mean speed of 0.5 m/s, slower and faster within every 20 s.
    assert 3.0 < answers["trajectory"][OURS][0] < 11.0  # type: ignore[operator]
    assert answers["never-seen"] == {OURS: [None], PLAIN: [None]}


def test_sides_that_answer_differently_are_not_compared() -> None:
    with pytest.raises(DisagreementError, match="plain answers"):
        agreed({OURS: Timed([1.0], [(1, 2.0)]), PLAIN: Timed([1.0], [(1, 2.1)])})


def test_a_reply_that_was_rounded_agrees() -> None:
    agreed({OURS: Timed([1.0], [(1, 2.0001)]), PLAIN: Timed([1.0], [(1, 2.00005)])})


def test_every_side_goes_first_in_turn_and_slow_ones_are_asked_once() -> None:
    order: list[str] = []

    def side(name: str) -> Sequence[Ask]:
        return [lambda: order.append(name)]

    sides = {"a": lambda: side("a"), "b": lambda: side("b")}
    assert [len(each.seconds) for each in timed(sides, 3).values()] == [3, 3]
    assert order == ["a", "b", "b", "a", "a", "b"]
    assert [len(each.seconds) for each in timed(sides, 3, at_most_s=0.0).values()] == [1, 1]


def test_the_report_says_what_was_reached_and_on_how_many_bags(tmp_path: Path) -> None:
    row = report.Row("x", "words", 0.001, 0.5, 0.0001, 400.0, 20.0, None, 360, (("ours", 5),))
    assert (row.faster, row.reached) == (500.0, True)
    table = report.as_table([row], [report.Figure("m", "memory", 250.0, "MB", 200.0)])
    assert "360 bags, scaled up" in table
    assert "400 ok" in table
    assert "200 MB MISSED" in table
    assert report.Row("y", "words", 0.001, 0.5, None, 501.0).reached is False


def test_the_command_prints_a_table_and_writes_json(
    tmp_path: Path, history: History, capsys: pytest.CaptureFixture[str]
) -> None:
    told = tmp_path / "figures.json"
    options = ["--bags", "2", "--dir", str(history.folder.parent), "--json", str(told)]
    assert main([*options, "--runs", "1", "--only", "point-cached"]) == 0
    assert "| point query, asked before" in capsys.readouterr().out
    found = json.loads(told.read_text(encoding="utf-8"))
    assert found["questions"][0]["plain_aim"] == Target(plain=300).plain


def test_a_week_is_made_of_one_hour_and_its_catalogue_knows_every_bag(history: History) -> None:
    copies = copied(history, 3)
    week = Week(copies, ours.settings_for(copies.folder))
    snapshot = week.memory.index.snapshot()
    assert len(snapshot.bags) == copies.bags == 6
    assert snapshot.latest is not None
    assert snapshot.earliest is not None
    assert snapshot.latest - snapshot.earliest > 5 * 10_000_000_000
    # The newest hour is what its bags say; an older one is what the catalogue was told.
    newest, oldest = snapshot.bags[-1], snapshot.bags[1]
    assert newest.summary == week.memory.reader.summarize(newest.path)
    assert oldest.end == newest.end - 2 * 2 * 10_000_000_000


@pytest.mark.parametrize("slug", WEEK_QUESTIONS)
def test_both_sides_agree_on_what_a_week_never_held(history: History, slug: str) -> None:
    copies = copied(history, 3)
    week = Week(copies, ours.settings_for(copies.folder))
    (row,) = measured({slug: WEEK_QUESTIONS[slug]}, week, runs=1)
    assert row.ours_s > 0


def test_the_substring_search_goes_through_what_the_digests_hold(history: History) -> None:
    copies = copied(history, 3)
    week = Week(copies, ours.settings_for(copies.folder))
    label = next(word for word in week.text.split() if word.isalpha())
    assert week.text.count(f"{label}\n") >= 3
    assert NEVER_SEEN not in week.text


def test_what_one_robots_user_asks_is_answered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--bags", "1", "--topics", "10", "--only", "level", "--dir", str(tmp_path)]
    assert one_robot.main(asked) == 0
    rows = [row for row in capsys.readouterr().out.splitlines() if row.startswith("| log")]
    assert ["error" in row for row in rows] == [False]
