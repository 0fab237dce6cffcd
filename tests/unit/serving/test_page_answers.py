import json
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import httpx2
import numpy as np
import pytest
from starlette.applications import Starlette
from starlette.datastructures import QueryParams
from structlog.testing import capture_logs

from ros2_memory.analysis import topic_events
from ros2_memory.columns.fill import Progress
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.reply import JsonObject
from ros2_memory.core.telemetry import Answered
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Call, Memory
from ros2_memory.serving.dispatch import Dispatcher, QuestionLog
from ros2_memory.serving.mcp_server import _describe_progress
from ros2_memory.serving.page import drawn_path, span
from ros2_memory.serving.page.drawn_path import Box, path_in_box
from ros2_memory.serving.page.recordings import Recordings
from ros2_memory.serving.page.routes import (
    moment_reply,
    page_routes,
    requested_box,
    requested_window,
    span_request,
)
from ros2_memory.serving.page.span import span_shown
from ros2_memory.serving.page.topics import labels_shown, topics_shown
from ros2_memory.tools.build import build_tools
from ros2_memory.tools.replies import Replies
from ros2_memory.tools.reply_size import to_json_text
from tests.support.bags import (
    along_x,
    boolean,
    detections,
    in_order,
    odom,
    text,
    write_mcap,
    write_splits,
)
from tests.support.housekeepers import made_moment
from tests.support.memories import memory_of, remembered, with_store
from tests.unit.analysis.motion.posed import off_line
from tests.unit.test_positions import fix

S = NS_PER_S
BEGIN = 1_784_000_000 * S
BEGIN_S = 1_784_000_000
NOTHING: Any = None
moment_of = partial(moment_reply, memory=NOTHING, call=NOTHING)


@pytest.fixture(scope="module")
def bag_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three bags of 20 s: it drives 1 m/s for 10 s, stands for 10 s, and sees a cup then.

    Between the second and the third nothing is recorded for 100 s.
    """
    folder = tmp_path_factory.mktemp("page")
    for number, begins in enumerate((0, 20, 140)):
        messages = []
        for n in range(200):
            at_s = n / 10
            moves = min(at_s, 10.0)
            x, at = number * 10 + moves, BEGIN + begins * S + n * S // 10
            messages.append(odom(at, x, 0.0, vx=1.0 if at_s < 10 else 0.0))
            if at_s >= 10 and n % 5 == 0:
                messages.append(detections(at, ["cup"]))
        write_mcap(folder / f"rec_{number}" / f"rec_{number}_0.mcap", messages)
    return folder


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """However busy the machine is, no part is left out for later."""
    for part in ("span", "drawn_path", "topics"):
        monkeypatch.setattr(f"ros2_memory.serving.page.{part}._QUICK_S", 60.0)


@pytest.fixture(scope="module", params=["plain", "store"])
def memory(bag_dir: Path, request: pytest.FixtureRequest) -> Memory:
    found = memory_of(bag_dir)
    return with_store(found, bag_dir) if request.param == "store" else found


def received(reply: JsonObject) -> Any:
    """What the page receives, as JSON makes it."""
    return json.loads(to_json_text(reply))


def shown(memory: Memory, query: str = "", **more: Any) -> Any:
    return received(span_shown(memory, Call(), span_request(QueryParams(query)), **more))


def test_a_first_look_has_all_that_the_page_draws(memory: Memory) -> None:
    found = shown(memory, "last=1000")
    assert found["range"]["gaps"] == [[BEGIN_S + 39.9, BEGIN_S + 140]]
    assert found["path"]["frame"] == "odom"
    after_gap = [at >= BEGIN_S + 140 for at in found["path"]["t"]].index(True)
    assert found["path"]["begins"] == [0, after_gap]
    assert found["path"]["whole"]
    assert found["robot"]["x"] == 30.0
    stops = [each for each in found["events"] if each["kind"] == "stop"]
    assert [(each["x"], each["y"]) for each in stops] == [(10.0, 0.0), (20.0, 0.0), (30.0, 0.0)]
    things = [each for each in found["events"] if each["kind"] == "thing"]
    assert {(each["text"], each["label"]) for each in things} == {("cup in view", "cup")}
    assert found["distance_m"] == 30.0
    assert found["filling"] is None
    assert "questions" not in found


def test_a_later_look_has_what_is_new_and_totals_of_the_whole_span(memory: Memory) -> None:
    """A page that stays open would else show the length of path of its first look for ever."""
    whole = shown(memory, "last=1000")
    since = BEGIN_S + 20  # where the bag begins that is in question
    look = f"last=1000&since={since + 5}&status=0"
    with_things = shown(memory, look)
    assert with_things["events_since"] == with_things["start"] < with_things["since"] == since
    for key in ("distance_m", "counts", "max_speed", "stood_s", "events"):
        assert with_things[key] == whole[key]
    assert with_things["whole_ms"] >= 0
    more = shown(memory, f"{look}&things=0&version={whole['version']}x")
    assert not {"things", "status", "range", "whole_ms"} & set(more)
    assert more["latest"] == whole["range"]["latest"]
    assert more["since"] == more["events_since"] == since
    assert more["path"]["continues"]
    assert more["path"]["t"] == [since, *(each for each in whole["path"]["t"] if each > since)]
    version = shown(memory)["version"]
    assert set(shown(memory, f"version={version}")) == {"version", "unchanged", "now"}


def test_where_a_part_takes_too_long_the_others_are_shown(
    memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(*_: object, **__: object) -> None:
        raise QueryTimeoutError("it takes too long")

    monkeypatch.setattr(span, "recap", slow)
    found = shown(memory, "last=1000", progress=lambda: Progress(closed=3, stored=1, waiting=2))
    assert found["filling"] == {"closed": 3, "percent": 33}
    assert "events" not in found
    assert "the events are not known yet: it takes too long" in found["notes"]
    assert found["path"]["x"][-1] == 30.0


@pytest.mark.parametrize(
    ("progress", "percent"),
    [(Progress(closed=0, waiting=1), 0), (Progress(closed=100, stored=0, waiting=50), 0)],
)
def test_a_bag_that_is_not_closed_makes_no_share_of_stored_bags_wrong(
    memory: Memory, progress: Progress, percent: int
) -> None:
    """It waits to be stored, too: the share was -100 %, and 50 where none was stored."""
    found = shown(memory, "last=1000", progress=lambda: progress)
    assert found["filling"] == {"closed": progress.closed, "percent": percent}
    assert _describe_progress(progress) == f"{percent} % of the bags stored"


def test_bounds_of_rounded_numbers_enclose_their_mean(tmp_path: Path) -> None:
    draw = Random(7)
    positions = [draw.uniform(-9, 9) for _ in range(60)]
    poses = [odom(BEGIN + n * S, x, 0.0) for n, x in enumerate(positions)]
    plain = remembered(tmp_path, poses, split_s=10)
    for asked_of in (plain, with_store(plain, tmp_path)):
        signal = "/odom:pose.pose.position.x"
        [found] = shown(asked_of, f"last=1000&signal={signal}")["signals"]
        bounds = zip(found["low"], found["mean"], found["high"], strict=True)
        assert all(low <= mean <= high for low, mean, high in bounds)
        assert found["mean"] == pytest.approx(positions, abs=1e-4)


def test_a_plot_has_the_same_points_however_bags_are_cut_and_with_stored_columns(
    tmp_path: Path,
) -> None:
    """Of poses at 1 Hz, and at 20 Hz in each third bin of 3 s."""
    times = [BEGIN + n * S // 20 for n in range(20 * 90) if n % 20 == 0 or n // 60 % 3 == 2]
    found = []
    for size in (7, 1000):
        folder = tmp_path / str(size)
        write_splits(folder, [odom(at, 0.0, 0.0) for at in times], size)
        plain = memory_of(folder)
        for asked_of in (plain, with_store(plain, folder)):
            query = f"start={BEGIN_S}&end={BEGIN_S + 1200}&signal=/odom:pose.pose.position.x"
            [signal] = shown(asked_of, query)["signals"]
            found.append(signal["t"])
    assert found == [found[0]] * 4
    assert len(found[0]) == pytest.approx(30, abs=1)


@pytest.mark.parametrize("signal", ["/odom:no.such.field", "/nowhere:x"])
def test_what_is_wrong_with_a_signal_is_said_and_costs_no_other(
    memory: Memory, signal: str
) -> None:
    found = shown(memory, f"last=1000&signal={signal}&signal=/odom:pose.pose.position.x")
    wrong, right = found["signals"]
    assert wrong["error"]
    assert max(right["high"]) == pytest.approx(30.0)


@pytest.mark.parametrize(
    ("read", "query", "why"),
    [
        (span_request, "start=a&end=2", "start must be a number of seconds"),
        (span_request, "last=nan", "last must be a number of seconds"),
        (span_request, "signal=odom", "/topic:field"),
        (span_request, "&".join(f"signal=/t:{n}" for n in range(9)), "at most 4"),
        (requested_window, "start=1", "give start"),
        (requested_window, "start=2&end=1", "give start"),
        (requested_box, "x0=0&y0=0&x1=1&y1=1", "give x0"),
        (requested_box, "x0=0&y0=0&x1=1&y1=1&pixel=-1", "give x0"),
        (moment_of, "label=cup", "give t, or start and end"),
        (moment_of, "start=1e10&end=2e10", "start must be a number of seconds"),
        (moment_of, f"t=1&label={'x' * 201}", "longer than"),
    ],
)
def test_what_cannot_be_asked_is_refused_with_the_reason(read: Any, query: str, why: str) -> None:
    with pytest.raises(InvalidArgumentsError, match=why):
        read(QueryParams(query))


@patch.object(span, "MOST_POINTS", 10)
def test_a_path_of_many_corners_is_drawn_by_a_bounded_number_of_points(tmp_path: Path) -> None:
    zigzag = [odom(BEGIN + n * S, n / 10, n % 2) for n in range(60)]
    path = shown(remembered(tmp_path, zigzag))["path"]
    assert len(path["t"]) == 10
    assert (path["x"][0], path["x"][-1]) == (0.0, 5.9)


def test_the_latest_questions_are_kept_newest_first_and_bounded() -> None:
    log, now_s = QuestionLog(3), time.time()
    for number in range(5):
        tool = f"tool_{number}"
        log.add(tool, {"n": number}, Answered(tool, "ok", 0.25, 2, "id"), "x" * 10_000)
    kept = log.newest(2)
    assert [each["tool"] for each in kept] == ["tool_4", "tool_3"]
    assert kept[0]["asked"] == pytest.approx(now_s - 0.25, abs=5)
    assert kept[0]["arguments"] == '{"n": 4}'
    assert len(str(kept[0]["answer"])) <= 2_000
    assert log.count == 5


@pytest.mark.parametrize("name", ["rec_9", "rec", "", ".", "../page0", "rec_1/..", "rec_1/x"])
def test_a_recording_of_another_name_is_refused(memory: Memory, name: str) -> None:
    memory.index.snapshot()
    refused = pytest.raises(InvalidArgumentsError, match="no recording is named")
    with capture_logs() as logged, refused:
        Recordings(memory).alone(name)
    assert logged == []


def test_a_folder_of_several_recordings_is_listed_too(tmp_path: Path) -> None:
    for n, name in enumerate(("robin/a", "robin/b", "wren/c", "moments/x/d", "moments/y/e")):
        write_mcap(tmp_path / name / "0.mcap", [odom(BEGIN + n * S, 0.0, 0.0)])
    memory = memory_of(tmp_path)
    recordings = Recordings(memory)
    rows = recordings.shown(memory, Call())["recordings"]
    assert isinstance(rows, list)
    names = [row["name"] for row in rows if isinstance(row, dict)]
    assert names == ["moments/y/e", "moments/x/d", "wren/c", "robin", "robin/b", "robin/a"]
    assert rows[3] == {"name": "robin", "start": BEGIN_S, "end": BEGIN_S + 1, "holds": 2}
    assert len(recordings.alone("robin").index.snapshot().bags) == 2


def test_of_one_recording_only_its_own_moments_are_shown(tmp_path: Path) -> None:
    for n, name in enumerate(("robin", "wren")):
        write_mcap(tmp_path / name / f"{name}_0.mcap", [odom(BEGIN + n * 60 * S, 0.0, 0.0)])
        (made_moment(tmp_path / "moments" / name, f"of {name}") / name).mkdir()
    memory = memory_of(tmp_path)

    def labels(memory: Memory) -> set[str]:
        return {each["label"] for each in shown(memory)["moments"]}

    assert labels(memory) == {"of robin", "of wren"}
    assert labels(Recordings(memory).alone("wren")) == {"of wren"}


async def test_a_tool_of_one_recording_answers_from_it_alone_and_one_that_writes_is_refused(
    memory: Memory,
) -> None:
    tools = build_tools(memory.limits, writing=True)
    replies = Replies(memory.index.bag_dir, 9_000)
    dispatcher = Dispatcher(memory, tools, replies, call_timeout_s=5)
    app = Starlette(routes=page_routes(dispatcher))
    transport = httpx2.ASGITransport(app=app)
    async with httpx2.AsyncClient(transport=transport, base_url="http://x") as client:

        async def asked(tool: str, arguments: str) -> httpx2.Response:
            given = {"recording": "rec_1", "tool": tool, "arguments": arguments}
            return await client.get("/page/moment", params=given)

        assert (await asked("data_time_range", "{}")).json()["bags"] == 1
        refused = (await asked("remember_moment", '{"label": "x"}')).json()
        assert "remember_moment writes" in refused["detail"]
        for arguments in ("[]", "{", "[" * 100):
            refused = (await asked("data_time_range", arguments)).json()
            assert refused["error"] == "invalid_arguments"


def topics(memory: Memory, query: str) -> Any:
    return received(topics_shown(memory, Call(), requested_window(QueryParams(query))))


def test_topics_have_their_rate_when_they_spoke_and_their_numbers(memory: Memory) -> None:
    """Recorded are 0 to 40 s and 140 to 160 s; the robot sees a cup in each bag's second half."""
    found = topics(memory, f"start={BEGIN_S}&end={BEGIN_S + 60}")
    rows = {row["topic"]: row for row in found["topics"]}
    assert found["topics_total"] == len(rows) == 2
    odometry, seen = (rows[topic] for topic in sorted(rows))
    assert (odometry["count"], odometry["rate_hz"]) == (600, 10.0)
    assert sum(odometry["spoke"]) == 400
    assert set(odometry["spoke"][:40]) <= {9, 10, 11}
    assert set(odometry["spoke"][41:]) == {0}
    assert set(seen["spoke"][:10]) == {0} != set(seen["spoke"][10:20])
    assert {"position.x", "orientation.yaw_deg", "linear_velocity.x"} <= set(odometry["numbers"])
    assert found["places_robot"] == [{"topic": "/odom", "kind": "poses"}]


@pytest.mark.parametrize(("split_s", "most_times"), [(10, 20_000), (600, 20_000), (600, 0)])
def test_every_message_is_counted_when_it_was_also_where_bags_have_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, split_s: int, most_times: int
) -> None:
    """Ten minutes at 10 Hz, of which the middle 100 s are looked at."""
    monkeypatch.setattr("ros2_memory.serving.page.topics._MOST_TIMES", most_times)
    memory = remembered(tmp_path, along_x(BEGIN, 600, hz=10), split_s)
    [row] = topics(memory, f"start={BEGIN_S + 250}&end={BEGIN_S + 350}")["topics"]
    assert sum(row["spoke"]) == pytest.approx(1000, abs=1)
    assert set(row["spoke"]) <= {16, 17}
    [silent] = topics(memory, f"start={BEGIN_S + 0.91}&end={BEGIN_S + 0.99}")["topics"]
    assert silent["spoke"] == [0] * 60 or not most_times


def test_each_message_counts_once_where_the_type_of_a_topic_changed(tmp_path: Path) -> None:
    said = [boolean(BEGIN + n * S, True, "/x") for n in range(10)]
    said += [text(BEGIN + n * S + S // 2, "on", "/x") for n in range(5)]
    memory = remembered(tmp_path, in_order(said))
    for around_s in (5, 1800):
        query = f"start={BEGIN_S - around_s}&end={BEGIN_S + 10 + around_s}"
        [row] = topics(memory, query)["topics"]
        assert sum(row["spoke"]) == 15


@patch("ros2_memory.serving.page.topics._QUICK_S", 0.0)
def test_topics_are_listed_also_where_there_is_no_time_to_read_them(tmp_path: Path) -> None:
    [row] = topics(
        remembered(tmp_path, [boolean(BEGIN + n * S, True) for n in range(600)], split_s=600),
        f"start={BEGIN_S}&end={BEGIN_S + 60}",
    )["topics"]
    assert (row["numbers"], set(row["spoke"])) == ([], {1})


def test_a_receiver_that_is_chosen_gives_a_map_in_metres_from_its_first_fix(tmp_path: Path) -> None:
    """Whatever time is looked at, the origin is the same."""
    messages = [fix(BEGIN + n * S, n * 1e-5, n * 1e-5) for n in range(20)]
    plain = remembered(tmp_path, messages, split_s=10)
    memory = replace(plain, limits=replace(plain.limits, pose_topic="/fix"))
    whole = shown(memory, "last=1000")
    assert whole["path"]["frame"] == "east and north of 48.123457, 11.765432"
    assert (whole["path"]["x"][0], whole["path"]["y"][0]) == (0.0, 0.0)
    assert whole["path"]["x"][-1] == pytest.approx(14.14, abs=0.02)
    assert whole["path"]["y"][-1] == pytest.approx(21.13, abs=0.02)
    assert whole["robot"]["y"] == pytest.approx(21.13, abs=0.02)
    late = shown(memory, f"start={BEGIN_S + 10}&end={BEGIN_S + 12}")
    assert late["path"]["y"][0] == pytest.approx(11.12, abs=0.02)
    assert whole["places"] == []
    assert topics(plain, f"start={BEGIN_S}&end={BEGIN_S + 20}")["places_robot"] == [
        {"topic": "/fix", "kind": "fixes"}
    ]


def test_a_receiver_that_began_without_satellites_has_a_path(tmp_path: Path) -> None:
    inside = [fix(BEGIN + n * S // 10, 0.0, 0.0, -1) for n in range(1100)]
    outside = [fix(BEGIN + n * S // 10, n * 1e-6, 0.0) for n in range(1100, 1400)]
    plain = remembered(tmp_path, [*inside, *outside], split_s=10)
    memory = replace(plain, limits=replace(plain.limits, pose_topic="/fix"))
    window = TimeWindow(BEGIN, BEGIN + 140 * S)
    found: Any = path_in_box(memory, Call(), window, Box(-100, -100, 100, 100, 0.5))
    assert (found["t"][0], found["t"][-1]) == (BEGIN_S + 110, BEGIN_S + 139.9)


def test_a_label_has_all_its_sightings_also_one_that_is_seen_throughout(memory: Memory) -> None:
    def labels(start_s: float, end_s: float) -> dict[str, Any]:
        window = TimeWindow.from_unix(BEGIN_S + start_s, BEGIN_S + end_s)
        found = received(labels_shown(memory, Call(), window))
        return {row["label"]: row for row in found["labels"]}

    found = labels(0, 200)
    assert found.keys() == {"cup"}
    assert found["cup"]["sightings"] == 3
    assert found["cup"]["seconds"] == pytest.approx(28.5, abs=0.3)
    bars = [[each - BEGIN_S for each in bar] for bar in found["cup"]["bars"]]
    assert [begin for begin, _ in bars] == pytest.approx([10, 30, 150], abs=0.6)
    # Where it is seen all the time, a recap names it as seen throughout, and counts no sighting.
    assert "sightings" not in shown(memory, f"start={BEGIN_S + 11}&end={BEGIN_S + 19}")["counts"]
    assert labels(11, 19)["cup"]["sightings"] == 1
    assert labels(0, 5) == {}


def moment(memory: Memory, query: str) -> Any:
    return received(moment_reply(QueryParams(query), memory, Call()))


def test_sightings_are_of_the_label_in_its_spellings_and_of_no_longer_word(tmp_path: Path) -> None:
    """A thing has one name for all spellings; `cup` is no part of `cupboard`."""
    seen = ["cup", "cupboard", "Cups", "coffee_mug", "0", "10"]
    messages = [
        detections(BEGIN + n * S, [seen[n // 20]] if n % 20 < 5 else [])
        for n in range(20 * len(seen))
    ]
    memory = remembered(tmp_path, messages)
    for label, begins in (("cup", [40, 0]), ("coffee mug", [60]), ("0", [80])):
        found = moment(memory, f"label={label}&start={BEGIN_S - 1}&end={BEGIN_S + 200}")
        assert [row["first_seen"] - BEGIN_S for row in found["sightings"]] == begins
        assert found["total"] == len(begins)


def test_what_was_seen_has_each_label_once_however_often_another_one_was(tmp_path: Path) -> None:
    """A person is in view for 15 s of each 45 s, 80 times, and for 2 s a cup, once."""
    seen = ["person" if n % 45 < 15 else "" for n in range(80 * 45)]
    seen[40 * 45 + 26 : 40 * 45 + 28] = ["cup", "cup"]
    messages = [detections(BEGIN + n * S, [label] * bool(label)) for n, label in enumerate(seen)]
    found = moment(remembered(tmp_path, messages), f"start={BEGIN_S}&end={BEGIN_S + len(seen)}")
    rows = [(row["label"], row["t"] - BEGIN_S, row["end"] - BEGIN_S) for row in found["seen"]]
    assert rows == [("person", 0, 14), ("cup", 1826, 1827)]


def test_sightings_take_no_place_of_what_happened_in_a_stretch(tmp_path: Path) -> None:
    """A person comes into view 40 times, and a bumper toggles 59 times: both on any day."""
    seen = ["person" if n % 45 < 15 else "" for n in range(40 * 45)]
    messages = [detections(BEGIN + n * S, [label] * bool(label)) for n, label in enumerate(seen)]
    messages += [boolean(BEGIN + n * S, n // 30 % 2 == 1) for n in range(40 * 45)]
    found = moment(remembered(tmp_path, messages), f"start={BEGIN_S}&end={BEGIN_S + len(seen)}")
    assert {row["kind"] for row in found["events"]} == {"flip"}
    assert len(found["events"]) == 59
    assert not [note for note in found["notes"] if "too many" in note]


@patch.object(topic_events, "MAX_INTERVALS", 10)
def test_a_note_says_where_labels_were_in_view_too_often_to_list_each_time(tmp_path: Path) -> None:
    messages = [detections(BEGIN + n * S, ["cup"] * (n % 10 < 2)) for n in range(300)]
    memory = remembered(tmp_path, messages)
    window = TimeWindow(BEGIN, BEGIN + 300 * S)
    found = received(labels_shown(memory, Call(), window))
    assert found["labels"][0]["sightings"] == 10
    [note] = found["notes"]
    assert note.endswith("changes too often to list each change: 20 more")


@patch.object(drawn_path, "MOST_POINTS", 400)
def test_of_a_path_driven_often_each_pixel_is_drawn_and_no_more(tmp_path: Path) -> None:
    angles = np.arange(126 * 8) * 0.05  # eight laps of a circle of 1 m
    poses = np.stack([np.sin(angles), 1 - np.cos(angles)], axis=1)
    messages = [odom(BEGIN + n * S // 20, x, y) for n, (x, y) in enumerate(poses.tolist())]
    memory = remembered(tmp_path, messages, split_s=10)
    window = TimeWindow.from_unix(BEGIN_S, BEGIN_S + 1000)
    found: Any = path_in_box(memory, Call(), window, Box(-2, -2, 2, 3, 0.002))
    assert 100 < len(found["x"]) <= 400
    drawn = np.column_stack([found["x"], found["y"]])
    assert off_line(drawn, poses, found["begins"]).max() <= 0.004
