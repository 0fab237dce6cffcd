"""One history has one answer: however it is cut into bags, and whatever of it is stored, and when.

Questions go through the tools, and their JSON is compared: of memories whose store was filled in
some order, while bags came late, changed and went; of the same bags without a store; of the same
recordings as one bag each; and with what reading all messages with `mcap` and rosbags finds."""

import math
import os
import random
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any, Final, NamedTuple
from unittest.mock import patch

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from ros2_memory.columns import decode, writing
from ros2_memory.columns.fill import StoreLimits
from ros2_memory.columns.scanner import Scanner
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.history import reverse_search
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.history.view import View
from ros2_memory.index import timeline
from ros2_memory.serving.backfill import make_fragments
from ros2_memory.storage.mcap import bulk
from tests.support.bags import (
    McapLayout,
    Msg,
    battery,
    boolean,
    detections,
    diagnostics,
    goals,
    log_entry,
    odom,
    text,
    tf_of,
    typestore,
    write_mcap,
)
from tests.support.column_worlds import World, check_all, check_rows
from tests.support.examples import LONG
from tests.support.memories import asked, assert_same_counts, memory_of
from tests.support.random_histories import LATCHED, MS, WORDS, S, shifted, write_history
from tests.support.tables import table

T0: Final = 1_700_006_330 * S
"""70 s later ten minutes are over; in most time zones an hour, and in UTC a day."""
_UNSET: Final = 5 * S
"""What a clock says that was never set."""
Question = tuple[str, dict[str, Any]]
Ask = Callable[..., Any]
Spans = list[tuple[int, int]]
Splits = dict[str, list[Msg]]
"""Messages by the path of their bag; of whole recordings by their names."""


def when(kind: str, value: object, **more: object) -> dict[str, Any]:
    return {"condition_type": kind, "value": value, **more}


CONDITIONS: Final = {
    "/odom": [
        when("above", 0.3, field="position.x"),
        when("below", -50, field="position.x"),
        when("near_position", {"x": 0.5, "y": 0}),
    ],
    "/chatter": [when("contains", "STRASSE"), when("contains", "never")],
    "/vision/a": [
        when("contains", "cup"),
        when("equals", "scissors", field="detections.label"),
        when("above", 0.4, field="detections.score"),
    ],
    "/vision/*": [when("contains", "person", min_score=0.5)],
    "/bumper": [when("equals", True), when("equals", "false")],
    "/battery_state": [when("below", 0.5, field="percentage"), when("equals", 0.9)],
    "/dock": [when("contains", "undocked")],
    "/status": [when("equals", 0.5, field="battery"), when("contains", "cup")],
    "/mixed": [when("contains", "cup")],
    "/*": [when("contains", "person")],
}
FIELDS: Final = {
    "/odom": ["position.x", "orientation.yaw_deg"],
    "/battery_state": ["percentage"],
    "/vision/a": ["detections.score"],
}


def questions(
    draw: Random, topics: Sequence[str], moments: Sequence[int], most: int
) -> list[Question]:
    """Some questions to each tool that scans columns, at times when something happened."""
    found: list[Question] = [(name, {}) for name in ("list_recorded_topics", "memory_status")]
    for topic, conditions in CONDITIONS.items():
        if topic in topics or "*" in topic:
            for condition in conditions:
                found += _matches(draw, {"topic": topic, **condition}, moments)
    for topic in topics:
        window = {"topic": topic, **_window(draw, moments)}
        if topic in FIELDS:
            window["fields"] = FIELDS[topic]
        found.append(("get_topic_in_range", {**window, "max_samples": 7}))
        found.append(("get_topic_in_range", {**window, "by": draw.choice(["hour", "day"])}))
        at = {"timestamp": (draw.choice(moments) + draw.choice([0, S // 3])) / S}
        found.append(("get_topic_at_time", {"topic": topic, "tolerance_s": 2.0, **at}))
    found += [*_about_the_robot(draw, moments)]
    some = found if LONG else draw.sample(found, min(most, len(found)))
    return [("data_time_range", {}), *some]


def _matches(draw: Random, condition: dict[str, Any], moments: Sequence[int]) -> Iterator[Question]:
    """The last match, a value at that time, and all: by the clock, in a place, or at some times."""
    before = draw.choice([{}, {"before": draw.choice(moments) / S}])
    yield "find_last_match", condition | before
    renamed = {("condition_topic" if key == "topic" else key): condition[key] for key in condition}
    yield "get_value_when", {**renamed, "value_topic": draw.choice(["/odom", "/dock"])}
    still = {"topic": "/bumper", **when("equals", False)}
    yield (
        "find_matches",
        {
            **condition,
            **draw.choice([{}, _window(draw, moments)]),
            **draw.choice([{"by": "hour"}, {"by": "day"}, {"limit": 2}, {"oldest_first": True}]),
            **draw.choice([{}, {"where": {"x": 0.2, "y": 0, "radius_m": 0.5}}, {"while": still}]),
        },
    )


def _about_the_robot(draw: Random, moments: Sequence[int]) -> Iterator[Question]:
    """Where it was, how it got there, what it saw, and what happened."""
    at = {"timestamp": draw.choice(moments) / S}
    yield "get_position_at", at
    yield "get_velocity_at", at
    for pair in (("base_link", "cam"), ("odom", "laser"), ("odom", "base_link")):
        yield "get_transform_at", {**dict(zip(("parent", "child"), pair, strict=True)), **at}
    yield "list_frames", {}
    place = {"x": round(draw.gauss(0, 1), 2), "y": 0, "radius_m": draw.choice([0.3, 1.0])}
    for more in ({}, _window(draw, moments)):
        yield "visits", {"where": place, **more}
        yield "visits", {**place, "by": draw.choice(["hour", "day"]), **more}
        yield "find_things", {**draw.choice([{}, {"label": "cup"}, {"where": place}]), **more}
    yield "trajectory_summary", _window(draw, moments)
    yield "trajectory_summary", {**_window(draw, moments), "by": draw.choice(["hour", "day"])}
    yield "recap", _window(draw, moments)
    then = _window(draw, moments)
    earlier = {"with_start": then["start"], "with_end": then["end"]}
    yield "compare", {**_window(draw, moments), **earlier}


def _window(draw: Random, moments: Sequence[int]) -> dict[str, Any]:
    start, end = sorted(draw.sample(moments, 2))
    start = draw.choice([start, start, min(moments) - 600 * S])
    return {"start": start / S, "end": draw.choice([end, end, max(moments) + 60 * S]) / S}


def check_stored(world: World, asking: Sequence[Question]) -> list[Any]:
    """Checks that replies are the same with the store and without one; returns them."""
    plain, replies = world.unstored().memory, []
    for name, given_ in asking:
        replies.append(asked(world.memory, name, **given_))
        expected = asked(plain, name, **given_)
        assert_same_counts(replies[-1], expected, of_means=0.02)
    return replies


class Plain(NamedTuple):
    """A message as plain reading finds it."""

    at: int
    body: Any


def read(bag_dir: Path) -> dict[str, list[Plain]]:
    """All messages of each topic by log time: a message of two recordings once, when it came first.

    One topic publishes no two messages at the same time here.
    """
    first: dict[tuple[str, int, bytes, str], int] = {}
    for path in bag_dir.rglob("*.mcap"):
        with path.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                assert schema is not None
                key = (channel.topic, message.publish_time, message.data, schema.name)
                first[key] = min(message.log_time, first.get(key, message.log_time))
    found = defaultdict(list)
    for (topic, _, data, kind), at in first.items():
        found[topic].append(Plain(at, typestore().deserialize_cdr(data, kind)))
    return {topic: sorted(rows, key=lambda row: row.at) for topic, rows in found.items()}


def near(at: float) -> Any:
    """A time as replies show it."""
    return pytest.approx(at / S, rel=0.0, abs=2e-6)


def yaw_deg(body: Any) -> float:
    turn = body.pose.pose.orientation
    return math.degrees(2 * math.atan2(turn.z, turn.w))


NUMBERS: Final[Mapping[tuple[str, str], Callable[[Any], float]]] = {
    ("/odom", "position.x"): lambda body: body.pose.pose.position.x,
    ("/odom", "orientation.yaw_deg"): yaw_deg,
    ("/battery_state", "percentage"): lambda body: body.percentage,
}
SPAN: Final = {"start": T0 / S, "end": T0 / S + 900}
"""All but what a clock dated that was not set."""


def bin_of(at: int, by: str) -> str:
    when_ = datetime.fromtimestamp(at // S).astimezone()
    return when_.date().isoformat() if by == "day" else f"{when_.hour:02d}:00"


def check_numbers(ask: Ask, dated: Mapping[str, list[Plain]]) -> None:
    """Of numbers by the clock: counts, ends, means, and extremes with when each was first."""
    for (topic, field), number in NUMBERS.items():
        for by in ("hour", "day"):
            bins = table(ask("get_topic_in_range", topic=topic, fields=[field], by=by, **SPAN))
            del bins["all"]
            parts = defaultdict(list)
            for row in dated[topic]:
                parts[bin_of(row.at, by)].append(row)
            assert {name for name, row in bins.items() if row["count"]} == parts.keys()
            for name, rows in parts.items():
                shown = bins[name]
                ends = shown["first_unix"], shown["last_unix"]
                assert (shown["count"], *ends) == (len(rows), near(rows[0].at), near(rows[-1].at))
                known = [(number(row.body), row.at) for row in rows]
                known = [(each, at) for each, at in known if not math.isnan(each)]
                for key, best in (("min", min), ("max", max)):
                    value = best((each for each, _ in known), default=None)
                    at = next((near(at) for each, at in known if each == value), None)
                    assert shown[f"{field}.{key}"] == pytest.approx(value, abs=2e-6)
                    assert shown[f"{field}.{key}_at_unix"] == at
                for key, end in (("first", 0), ("last", -1)):
                    value = known[end][0] if known else None
                    assert shown[f"{field}.{key}"] == pytest.approx(value, abs=2e-6)
                mean = math.fsum(each for each, _ in known) / len(known) if known else None
                assert shown[f"{field}.mean"] == pytest.approx(mean, abs=0.02)


def runs(rows: Sequence[Plain], holds: Callable[[Any], bool], missed: int) -> list[list[int]]:
    """The matches of each sighting: within 10 s of each other, or of less with others between."""
    found: list[list[int]] = []
    before = False
    for row in rows:
        met = holds(row.body)
        if met and found and row.at - found[-1][-1] <= (10 * S if before else missed):
            found[-1].append(row.at)
        elif met:
            found.append([row.at])
        before = met
    return found


def check_matches(ask: Ask, dated: Mapping[str, list[Plain]], gaps: Spans) -> None:
    """Sightings of a number, and by the clock how often it, a label and a boolean began to hold."""
    above = {"topic": "/odom", **CONDITIONS["/odom"][0], **SPAN}
    found = runs(dated["/odom"], lambda body: body.pose.pose.position.x > 0.3, missed=-1)
    sightings = ask("find_matches", **above, limit=100, oldest_first=True)["sightings"]
    assert [[s["first_seen"], s["last_seen"], s["count"]] for s in sightings] == [
        [near(run[0]), near(run[-1]), len(run)] for run in found
    ]
    check_begins(ask, above, [run[0] for run in found])
    label = {"topic": "/vision/a", **CONDITIONS["/vision/a"][0], **SPAN}
    if rows := dated.get("/vision/a"):
        seen = runs(rows, lambda body: "cup" in [d.label for d in body.detections], missed=3 * S)
        check_begins(ask, label, [run[0] for run in seen])
    toggles = [
        after.at
        for before, after in pairwise(dated["/bumper"])
        if after.body.data > before.body.data
        and not any(before.at <= start and end <= after.at for start, end in gaps)
    ]
    check_begins(ask, {"topic": "/bumper", **CONDITIONS["/bumper"][0], **SPAN}, toggles)


def check_begins(ask: Ask, condition: Mapping[str, Any], begins: Sequence[int]) -> None:
    for by in ("hour", "day"):
        bins = table(ask("find_matches", **condition, by=by))
        del bins["all"]
        counts = {name: row["count"] for name, row in bins.items() if row["count"]}
        assert counts == Counter(bin_of(at, by) for at in begins)


def gaps_of(splits: Splits) -> Spans:
    """When nothing was recorded for ten seconds, but for bags that a clock dated not set."""
    spans = sorted(span for found in splits.values() if (span := span_of(found))[0] >= T0)
    gaps, end = [], spans[0][1]
    for start, stop in spans:
        if start - end > 10 * S:
            gaps.append((end, start))
        end = max(end, stop)
    return gaps


UNLIKE: Final = {"bags", "budget", "clock_faults", "silences", "silent_s", "doubts"}
"""How many bags, their bytes, and which no clock dated. Silences lie between bags."""


def alike(reply: Any) -> Any:
    """What must be the same of a reply however a history is cut."""
    if reply is None:  # never, without a note
        reply = {"timestamp": None, "value": None}
    if not isinstance(reply, dict):
        return reply
    kept = {key: value for key, value in reply.items() if key not in UNLIKE}
    kept["notes"] = [
        note
        for note in reply.get("notes", ())
        # These name bags or silences, or are of a minute ago, before the last bags came.
        if "dated by a wrong clock" not in note
        and not note.startswith(("silent while", "robots are mixed", "left out, because"))
    ]
    if "events" in reply:
        counts = kept["counts"] = {**reply["counts"]}
        is_all = sum(counts.values()) == len(reply["events"])
        events = [event for event in reply["events"] if "was silent" not in event["text"]]
        kept["events"] = events if is_all else None  # silences left others out
        counts.pop("silences", None)
    if "topic_s" in reply.get("columns", ()):  # how long there were bags with the topic
        at = reply["columns"].index("topic_s")
        for row in (kept["columns"], *kept["rows"]):
            del row[at]
        del kept["all"][at - 1]
    return kept


def arrive(bag_dir: Path, splits: Splits, draw: Random) -> World:
    """Bags are stored while others come late, grow, or go; in the end these splits are there."""
    fates = {name: draw.choice(["there", "there", "late", "grows"]) for name in splits}
    write(bag_dir, {name: splits[name] for name, fate in fates.items() if fate == "there"})
    halves = {name: messages[: len(messages) // 2 + 1] for name, messages in splits.items()}
    write(bag_dir, {name: halves[name] for name, fate in fates.items() if fate == "grows"}, 1)
    fates["copy/copy_0.mcap"], halves["copy/copy_0.mcap"] = "goes", halves["a/a_0.mcap"]
    write(bag_dir, {"copy/copy_0.mcap": halves["a/a_0.mcap"]})
    world = World.of(bag_dir)
    for name in draw.sample([*fates], len(fates)):
        if fates[name] == "there":
            continue
        fill_some(world, draw)
        if draw.random() < 0.3:
            moments = [T0, *(message.log_time for message in halves[name])]
            check_stored(world, questions(draw, world.topics(), moments, most=2))
        if fates[name] == "goes":
            (bag_dir / name).unlink()
        else:
            write(bag_dir, {name: splits[name]})
        date_folders(bag_dir, draw)
    fill_some(world, draw)
    return world


@settings(max_examples=24 if LONG else 1)
@given(seed=st.integers(0, 2**32), cuts=st.lists(st.floats(0, 1), max_size=4))
@example(6671, [0.9375, 0.5, 0.03125, 0.25])  # A sighting goes on in another recording.
def test_one_history_has_one_answer_wherever_it_is_cut(seed: int, cuts: list[float]) -> None:
    draw = random.Random(seed)
    recordings = draw_recordings(draw)
    splits = cut(recordings, cuts)
    moments = [message.log_time for messages in splits.values() for message in messages]
    with tempfile.TemporaryDirectory() as folder:
        whole, bag_dir = Path(folder, "whole"), Path(folder, "bags")
        write(whole, cut(recordings, []))
        uncut, world = memory_of(whole), arrive(bag_dir, splits, draw)
        check_all(world)
        asking = questions(draw, world.topics(), moments, most=10)
        asking.append(("recap", _window(draw, moments)))
        for (name, given_), reply in zip(asking, check_stored(world, asking), strict=True):
            expected = alike(asked(uncut, name, **given_))
            assert_same_counts(alike(reply), expected, of_means=0.02)
        ask = partial(asked, world.memory)
        plain, gaps, memory = read(whole), gaps_of(splits), ask("data_time_range")
        dated = {topic: [row for row in rows if row.at >= T0] for topic, rows in plain.items()}
        times = [at for at in moments if at >= T0]
        assert (memory["earliest"], memory["latest"]) == (near(min(times)), near(max(times)))
        assert [(gap["start"], gap["end"]) for gap in memory["gaps"]] == [
            (near(start), near(end)) for start, end in gaps
        ]
        check_numbers(ask, dated)
        check_matches(ask, dated, gaps)


@patch.object(Scanner, "damaged_parts", lambda *_: [])  # Who fills knows of damage earlier.
@patch.object(reverse_search, "MOST_UNSURE", 1)
@settings(max_examples=60 if LONG else 1)
@given(seed=st.integers(0, 2**32))
@example(17293)  # A topic of two types, in recordings side by side.
@example(177)  # A chunk that is damaged.
def test_what_is_stored_of_an_odd_history_while_it_changes_changes_no_answer(seed: int) -> None:
    draw, how = random.Random(seed), random.Random(-seed)
    limits = QuerySettings(tf_clock=how.choice(["auto", "stamp"]))

    def world_of(bag_dir: Path, kept: StoreLimits | None = None) -> World:
        world = World.of(bag_dir, limits=kept)
        return replace(world, memory=replace(world.memory, limits=limits))

    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as limit:
        # What many or large bags are met with.
        limit.setattr(timeline, "SEGMENT_BAGS", how.choice([1, 2, timeline.SEGMENT_BAGS]))
        limit.setattr(decode, "_HELD_BYTES", how.choice([1, 300, 2000, decode._HELD_BYTES]))
        limit.setattr(decode, "GROUP_BYTES", how.choice([1, 1000, decode.GROUP_BYTES]))
        limit.setattr(bulk, "BATCH_BYTES", how.choice([500, 1 << 20]))
        limit.setattr(writing, "_MOST_ROWS", how.choice([3, writing._MOST_ROWS]))
        bag_dir, aside = Path(folder, "bags"), Path(folder, "aside")
        bag_dir.mkdir()
        moments = write_history(bag_dir, draw, how.choice([MS, MS, 5 * S])).moments
        put_aside(bag_dir, aside, draw)
        world = world_of(bag_dir)
        check_all(world.unstored())
        for _ in range(draw.randint(1, 5)):
            fill_some(world, draw)
            check_all(world)
            check_stored(world, questions(draw, world.topics(), moments, most=4))
            change_something(bag_dir, aside, draw)
        world.fill()
        check_all(world)
        again = world_of(bag_dir)
        check_all(again)
        check_stored(again, questions(draw, again.topics(), moments, most=8))
        for topic in again.topics():
            begin = draw.choice([*moments, MIN_NS])
            window = TimeWindow(begin, max(begin, draw.choice(moments)) + draw.randrange(40 * S))
            check_rows(again, topic, window, newest_first=draw.random() < 0.5)
            for memory in (again.memory, again.unstored().memory):
                first = View(memory, Call()).stream.first([topic], window, newest_first=True)
                assert View(memory, Call()).stream.newest(topic, window) == first
        without_columns = world_of(bag_dir, StoreLimits(max_share=0.0, least_bytes_per_s=0))
        without_columns.fill()
        check_stored(without_columns, questions(draw, again.topics(), moments, most=12))


def draw_recordings(draw: Random) -> Splits:
    """One recording takes over from another, and begins with what is latched; a third is later.

    Its clock may not have been set; that of the others may be set ahead. Messages are nearly in the
    order of their log times. One topic publishes no two messages at the same time.
    """
    seconds = draw.randint(60, 150)
    begin = draw.randrange(30, seconds)
    quiet = range(draw.randrange(begin), draw.randrange(begin, seconds))
    whole = _published(draw, T0, seconds, quiet)
    if draw.random() < 0.1:
        set_at = T0 + draw.randrange(10, 50) * S
        whole = [shifted(message, 2500 * MS * (message.published >= set_at)) for message in whole]
    over = T0 + begin * S
    one = [message for message in whole if message.log_time < over + draw.randint(0, 9) * S]
    known = [message for message in one if message.topic in LATCHED and message.log_time < over]
    other = [
        *(replace(message, log_time=over) for message in known),
        *(shifted(m, draw.randrange(10_000, 900_000)) for m in whole if m.log_time >= over),
    ]
    recordings = {"a": one, "b": other}
    third = draw.choice([None, T0 + (seconds + 90) * S, _UNSET])
    if third is not None:
        recordings["c"] = _published(draw, third, draw.randint(3, 40), range(0))
    return {
        name: sorted(found, key=lambda each: each.log_time + draw.choice([0, 0, draw.randrange(S)]))
        for name, found in recordings.items()
    }


def _published(draw: Random, start: int, seconds: int, quiet: range) -> list[Msg]:
    """Odometry each second, all else less often and some of it late; a detector that is quiet."""
    found, x, docked = [], 0.0, False
    for n in range(seconds):
        at = start + n * S
        x += draw.choice([0.0, draw.gauss(0, 0.4)])
        found.append(odom(at, x, draw.gauss(0, 1e-5), draw.uniform(-3, 3)))
        some = []
        if n % 2:
            some.append(text(at, draw.choice(WORDS), "/chatter"))
        if n % 2 and n not in quiet:
            labels = draw.sample(WORDS, draw.randint(0, 2))
            some.append(detections(at, labels, topic="/vision/a", score=n % 10 / 10))
        if n % 3 == 0:
            docked ^= draw.random() < 0.2
            some.append(boolean(at, docked))
        if n % 4 == 0:
            some.append(battery(at, draw.choice([math.nan, 0.9, draw.random(), 0.04])))
        if n % 40 == 1:
            some.append(text(at, draw.choice(["docked", "undocked"]), "/dock"))
        if n % 5 == 0:
            told = random.Random(at)
            said = told.choice(["no way", f"late by {n} s"])
            some.append(log_entry(at, told.choice([20, 40]), "nav", said))
            some.append(diagnostics(at, motors=(told.randrange(3), "hot"), camera=(n % 2, "")))
            some.append(goals(at, {n // 20: told.choice([2, 2, 4, 6])}))
        if n == 1:
            some.append(tf_of(at, "base_link", "cam", (x, 0, 0), topic="/tf_static"))
        for message in some:
            late = draw.choice([MS, MS, draw.randrange(4000) * MS]) + n
            found.append(replace(message, log_time=at + late, publish_time=at))
    return found


def cut(recordings: Splits, cuts: Sequence[float]) -> Splits:
    """Returns the messages of each split by its path: recordings are cut at these parts of them.

    Not where the clock was set ahead: that would be a gap.
    """
    splits = {}
    for name, found in recordings.items():
        inside = {int(part * len(found)) for part in cuts} - {0, len(found)}
        inside = {n for n in inside if found[n].log_time - found[n - 1].log_time <= 2 * S}
        for number, (begin, end) in enumerate(pairwise([0, *sorted(inside), len(found)])):
            splits[f"{name}/{name}_{number}.mcap"] = found[begin:end]
    return splits


def span_of(messages: Sequence[Msg]) -> tuple[int, int]:
    times = [message.log_time for message in messages]
    return min(times), max(times)


def write(bag_dir: Path, splits: Mapping[str, list[Msg]], version: int = 0) -> None:
    for name, messages in splits.items():
        layout = McapLayout(chunk_size=4000, latched=LATCHED)
        os.utime(write_mcap(bag_dir / name, messages, layout), ns=(T0, T0 + version))


def fill_some(world: World, draw: Random) -> None:
    """Stores some of what waits in any order, and makes parts at any time."""
    timeline = world.memory.index.snapshot().timeline
    waiting = world.filling.waiting(timeline)
    draw.shuffle(waiting)
    for bag in waiting[: draw.randint(0, len(waiting))]:
        world.fill_alone([bag])
        if draw.random() < 0.3:
            for batch in world.filling.batches(timeline):
                if not {*batch.bags} & {*waiting} or draw.random() < 0.1:
                    world.filling.fill(batch, timeline)
            make_fragments(world.memory, world.filling.whole_since())
            if draw.random() < 0.5:
                world.filling.thin()
    if draw.random() < 0.3:
        world.prune()


def put_aside(bag_dir: Path, aside: Path, draw: Random) -> None:
    """Some bags are late."""
    for path in sorted(bag_dir.glob("rec_*/*.mcap")):
        if draw.random() < 0.3:
            (aside / path.parent.name).mkdir(parents=True, exist_ok=True)
            path.rename(aside / path.parent.name / path.name)


def change_something(bag_dir: Path, aside: Path, draw: Random) -> None:
    """A bag comes late, changes, is renamed, or goes."""
    bags = sorted(bag_dir.glob("rec_*/*.mcap"))
    late = sorted(aside.glob("*/*.mcap"))
    kind = draw.choice(["late", "late", "changed", "renamed", "deleted", "touched"])
    if kind == "late" and late:
        path = draw.choice(late)
        (bag_dir / path.parent.name).mkdir(exist_ok=True)
        path.rename(bag_dir / path.parent.name / path.name)
    elif kind == "changed" and bags:
        path = draw.choice(bags)
        start = draw.choice([1_700_000_000 * S, 3 * S])
        write_mcap(path, [odom(start + n * S, n / 7, 0.5) for n in range(draw.randint(1, 9))])
        os.utime(path, ns=(T0, T0 + draw.randrange(S)))
    elif kind == "renamed" and bags:
        path = draw.choice(bags)
        path.rename(path.with_name(f"{path.stem}9.mcap"))
    elif kind == "deleted" and bags:
        draw.choice(bags).unlink()
    elif kind == "touched" and bags:
        os.utime(draw.choice(bags), ns=(T0, T0 + draw.randrange(S)))
    date_folders(bag_dir, draw)


def date_folders(bag_dir: Path, draw: Random) -> None:
    """Two changes within one tick of the clock would look like one."""
    for folder in [bag_dir, *bag_dir.iterdir()]:
        os.utime(folder, ns=(T0, folder.stat().st_mtime_ns - draw.randrange(1, 9) * S))
