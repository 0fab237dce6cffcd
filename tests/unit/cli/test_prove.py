"""`ros2-memory prove`: a file with what an answer rests on, which alone gives that answer."""

import json
import shlex
from pathlib import Path
from unittest.mock import patch

import pytest
from mcap.reader import make_reader

from tests.support.bags import McapLayout, Msg, along_x, detected, odom, text, write_mcap
from tests.support.moving_map import BEGIN, S, write_moving_map
from tests.support.program import Program

DAY_S = 86_400
ABOVE = {"topic": "/odom", "condition_type": "above", "value": 0.1, "field": "position.x"}


@pytest.fixture
def bags(tmp_path: Path) -> Path:
    """A robot with a map, for two minutes in splits of 10 s."""
    write_moving_map(tmp_path / "bags", 3)
    return tmp_path / "bags"


@pytest.fixture
def two_days(tmp_path: Path) -> Path:
    """Ten seconds a day on two days, each a recording."""
    for day in range(2):
        start = BEGIN + day * DAY_S * S
        poses = along_x(start, 10, mps=0.5, hz=10)
        words = [text(start + nth * S, f"word {nth}") for nth in range(10)]
        write_mcap(tmp_path / "days" / f"rec_{day}" / f"rec_{day}_0.mcap", [*poses, *words])
    return tmp_path / "days"


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as file:
        return [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in make_reader(file).iter_messages()
        ]


@pytest.mark.parametrize(
    "question",
    [
        f"find_last_match {json.dumps(ABOVE)}",
        'visits where={"x": 4.0, "y": 0.0, "radius_m": 1.0}',
        "get_topic_in_range topic=/nothing start=1784000000 end=1784000010",
    ],
)
def test_the_file_alone_gives_the_answer(
    bags: Path, tmp_path: Path, exits: Program, question: str
) -> None:
    proof = tmp_path / "proof.mcap"
    proved = exits(0, "prove", question, "-o", proof, bags)
    assert f"{len(messages(proof))} messages in {proof}" in proved.out
    said, _, command = proved.err.splitlines()[-1].partition(": ros2-memory ask ")
    assert said == "the same answer"
    *words, last = shlex.split(command)
    assert (" ".join(words), last) == (question, str(proof))
    code = 1 if "/nothing" in question else 0
    asked = exits(code, "ask", *words, bags, "--json", "data.now=latest").json
    assert exits(code, "ask", *words, proof, "--json").json == asked


def test_types_without_a_definition_are_named_and_exit_1_where_the_answer_rests_on_them(
    tmp_path: Path, exits: Program
) -> None:
    odd = [Msg("/odd", "nobody_msgs/msg/Knows", BEGIN, b"\0\1\0\0\0"), text(BEGIN, "x")]
    write_mcap(tmp_path / "bags" / "rec_0.mcap", odd, McapLayout(definitions=False))
    for code, topic in ((0, "/chatter"), (1, "/odd")):
        question = f"get_topic_seconds_ago topic={topic} seconds_ago=0"
        proof = tmp_path / f"proof_{code}.mcap"
        err = exits(code, "prove", question, "-o", proof, tmp_path / "bags").err
        assert "the same answer" in err
        assert "nobody_msgs/msg/Knows has no definition" in err


def test_what_lay_between_recordings_needs_a_folder(
    two_days: Path, tmp_path: Path, exits: Program
) -> None:
    span = f"start={BEGIN // S} end={BEGIN // S + DAY_S + 60}"
    question, proof = f"trajectory_summary by=day {span}", tmp_path / "proof.mcap"
    differs = exits(1, "prove", question, "-o", proof, two_days)
    assert f"over {proof} the answer differs in rows, all" in differs.err
    assert f"-o {tmp_path / 'proof'} keeps recordings apart" in differs.err
    folder = tmp_path / "proof"
    proved = exits(0, "prove", question, "-o", folder, two_days, "--json").json
    same = {"same": True, "differing": []}
    assert proved == {"path": str(folder), "messages": 202, **same}
    assert [each.name for each in sorted(folder.iterdir())] == ["rec_0", "rec_1"]


@patch("ros2_memory.things.known.READING_S", 0.0)
def test_a_proof_has_all_that_an_answer_rests_on_however_long_reading_takes(
    tmp_path: Path, exits: Program
) -> None:
    """A server without stored columns would answer from the newest day alone, with a note."""
    for day in range(4):
        start = BEGIN + day * DAY_S * S
        seen = [detected(start + nth * S, [("cup", 0.9, (1.0, 0.0, 0.5))]) for nth in range(20)]
        poses = along_x(start, 20, hz=5)
        write_mcap(tmp_path / "bags" / f"rec_{day}" / f"rec_{day}_0.mcap", [*seen, *poses])
    proof = tmp_path / "proof"
    proved = exits(0, "prove", "find_things label=cup", "-o", proof, tmp_path / "bags")
    assert "the same answer" in proved.err
    files = sorted(proof.rglob("*.mcap"))
    assert len(files) == 4
    for file in files:
        assert sum(topic != "/odom" for topic, _, _ in messages(file)) == 20


@pytest.mark.parametrize(
    "question",
    [
        f"get_position_at timestamp={BEGIN // S - DAY_S + 50}",
        "find_last_match topic=/mode condition_type=contains value=idle",
        "list_recorded_topics",
    ],
)
def test_a_folder_has_what_stays_of_deleted_bags_under_its_names(
    two_days: Path, tmp_path: Path, exits: Program, question: str
) -> None:
    path = [odom(BEGIN + (2 * nth - DAY_S) * S, nth / 5, 0.0) for nth in range(100)]
    write_mcap(two_days / "memory" / "20260713.thinned.mcap", path)
    latched = McapLayout(latched=frozenset({"/mode"}))
    carried = [text(BEGIN - 20 * DAY_S * S, "idle", "/mode")]
    write_mcap(two_days / "latched" / "carried.mcap", carried, latched)
    proof = tmp_path / "proof"
    assert "the same answer" in exits(0, "prove", question, "-o", proof, two_days).err


def test_of_nothing_there_is_no_proof(tmp_path: Path, exits: Program) -> None:
    (tmp_path / "bags").mkdir()
    refused = exits(2, f"prove 'visits x=1 y=1' -o {tmp_path}/proof {tmp_path}/bags")
    assert "contains no bag with messages" in refused.err


@pytest.mark.parametrize(
    ("question", "name", "said"),
    [
        ("find_thing", "p.mcap", 'unknown tool "find_thing"; do you mean find_things'),
        ("remember_moment label=x", "p.mcap", "remember_moment is not offered here"),
        ("recap foo=1", "p.mcap", 'unknown argument "foo"'),
        ("visits 5", "p.mcap", "is not an argument"),
        ("visits", "none/p.mcap", "must be new, in a folder that is there"),
        ("visits", "bags", "must be new, in a folder that is there"),
    ],
)
def test_what_cannot_be_proved_is_refused(
    bags: Path, tmp_path: Path, exits: Program, question: str, name: str, said: str
) -> None:
    refused = exits(2, "prove", question, "-o", tmp_path / name, bags)
    assert said in refused.err
    assert [*tmp_path.iterdir()] == [bags]
