"""The page at `/` in real Chromium, over a history that holds what a hostile sender would send."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ros2_memory.bag_dir.heartbeat import write_heartbeat
from ros2_memory.core.timebase import NS_PER_S
from tests.integration.test_server_process import serving
from tests.support.bags import boolean, detections, odom, text, write_mcap
from tests.support.browser import ENTER, TAB, Browser, browsing, needs_chromium
from tests.support.documented_history import heartbeat
from tests.support.robot_run import T0, T0_S

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.integration.test_server_process import Served

pytestmark = needs_chromium

GOOD = "kJ7-x._~+/0123456789=="
ATTACK = '<img src=x onerror="window.ran=1"><script>window.ran=1</script>'
REVERSED = "/gnp\u202e.rorre"
READY = """
  const busy = document.getElementById('again').disabled;
  return !busy && document.querySelector('#seen table') !== null;
"""
ANSWERED = "return /^answered|^no answer/.test(document.getElementById('outcome').textContent)"
FOCUSED = "return document.activeElement.id"


def write_history(bag_dir: Path) -> None:
    """Two bags with a gap between them and a damaged one; a robot that drives, stops and sees."""
    for name, begins in (("first", 0), ("second", 90)):
        messages = []
        for n in range(600):
            seconds = begins + n / 20
            at = T0 + int(seconds * NS_PER_S)
            driven = begins / 6 + min(n, 300) / 20
            messages.append(odom(at, driven, 0.0, vx=1.0 if n < 300 else 0.0))
            if n % 20 == 0:
                messages.append(detections(at, ["cup", ATTACK]))
                messages.append(text(at, ATTACK, f"/{ATTACK}"))
                messages.append(boolean(at, data=n > 300, topic=REVERSED))
        write_mcap(bag_dir / name / f"{name}_0.mcap", messages)
    bag = bag_dir / f"{ATTACK.replace('/', '')}" / "damaged_0.mcap"
    bag.parent.mkdir()
    bag.write_bytes(b"this is not a bag" * 100)


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("page")


@pytest.fixture(scope="module")
def served(scratch: Path) -> Iterator[Served]:
    write_history(scratch / "bags")
    with serving(scratch / "bags", scratch / "log", "storage=mcap") as server:
        yield server


@pytest.fixture(scope="module")
def chromium(scratch: Path) -> Iterator[Browser]:
    with browsing(scratch) as browser:
        yield browser


@pytest.fixture
def page(chromium: Browser, served: Served) -> Iterator[Browser]:
    """The page with everything shown; what it complains of fails the test."""
    chromium.looks(width=1200, height=900)
    chromium.complaints()
    chromium.open(served.url("/"))
    chromium.awaits(READY)
    yield chromium
    assert chromium.complaints() == []


def test_it_shows_the_memory_at_a_glance(page: Browser) -> None:
    line = page.text("#line")
    assert "gaps, 1" in line
    assert "damaged_0.mcap" in line
    label = page.run("return document.querySelector('#line svg').getAttribute('aria-label')")
    assert "1 gap (60 s), 1 damaged bag" in label
    assert "/odom" in page.text("#topics")
    assert "nav_msgs/msg/Odometry" in page.text("#topics")
    assert "Recorder\nnot heard of" in page.text("#state")
    assert "GB" in page.text("#state")
    assert "30.0 m in odom" in page.text("#way")
    drawn = page.run("return document.querySelector('#way polyline').getAttribute('points')")
    assert len(drawn.split(" ")) >= 2
    # Nobody knows how it came over the gap.
    assert page.run("return document.querySelectorAll('#way polyline').length") >= 2
    assert page.run("return document.querySelectorAll('#way circle.stop').length") >= 1
    assert "cup" in page.text("#seen")


def write_odd_history(bag_dir: Path) -> None:
    """Short bags with 22 gaps, 60 topics of long names, things of long names, damaged files."""
    long = "/" + "/".join(["the_namespace_of_a_robot"] * 6)
    for n in range(23):
        at = T0 + n * 60 * NS_PER_S
        messages = [odom(at + k * NS_PER_S, float(n), 0.0) for k in range(5)]
        if n == 22:
            messages += [text(at, "", f"{long}/{topic}") for topic in range(60)]
            messages.append(detections(at, ["a thing of a long name " * 5, "w" * 60]))
        write_mcap(bag_dir / f"rec_{n:02}" / f"rec_{n:02}_0.mcap", messages)
    for n in range(30):
        (bag_dir / f"broken_{n:02}.mcap").write_bytes(b"this is not a bag" * 100)


@pytest.fixture(scope="module")
def replayed(scratch: Path) -> Iterator[Served]:
    """A server of bags that nobody records."""
    write_odd_history(scratch / "odd")
    given = ("storage=mcap", "recorder=none", "data.now=latest")
    with serving(scratch / "odd", scratch / "log_odd", *given) as server:
        yield server


@pytest.fixture
def odd(chromium: Browser, replayed: Served) -> Iterator[Browser]:
    chromium.looks(width=360, height=740)
    chromium.complaints()
    chromium.open(replayed.url("/"))
    chromium.awaits(READY)
    yield chromium
    assert chromium.complaints() == []


def test_of_bags_that_nobody_records_it_shows_neither_a_recorder_nor_a_budget(odd: Browser) -> None:
    state = odd.text("#state")
    assert "Recorder\nnone belongs to this memory" in state
    assert "Size\n" in state
    assert "Budget" not in state
    assert "Growth" not in state


def test_it_says_that_ago_counts_from_the_newest_recorded_moment(odd: Browser) -> None:
    newest = odd.run("return clock(range.latest)")
    assert f"Newest data\n{newest}" in odd.text("#state")
    assert f"counts from the newest recorded moment, {newest}" in odd.text("#state")


def test_what_is_left_out_of_a_long_reply_is_counted_and_marked(odd: Browser) -> None:
    line = odd.text("#line")
    assert "gaps, 22" in line
    assert "with 2 more gaps" in line
    assert odd.run("return document.querySelectorAll('#line rect.coarse').length") == 1
    assert "not in the answers (30)" in line
    shut = odd.run(
        "return [...document.querySelectorAll('#line details')].map((each) => each.open)"
    )
    assert shut == [False, False]


def test_long_names_leave_room_for_what_stands_beside_them(odd: Browser) -> None:
    assert odd.run("return document.documentElement.scrollWidth") <= 360
    assert odd.run("return document.querySelectorAll('#topics tbody tr').length") == 62
    narrow = odd.run(
        "return [...document.querySelectorAll('td')].filter((each) => each.clientWidth < 60)"
        ".map((each) => each.textContent)"
    )
    assert narrow == []


def test_it_shows_what_the_recorder_says_of_itself(chromium: Browser, scratch: Path) -> None:
    bag_dir = scratch / "robot"
    write_mcap(bag_dir / "rec" / "rec_0.mcap", [odom(T0, 0.0, 0.0)])
    missing = tuple(f"/gone_{n:02}" for n in range(25))
    # One that comes each hour is live for as long as the test may take.
    beat = replace(heartbeat(time.time_ns()), interval_s=3600.0, restarts=2, silent=("/scan",))
    beat = replace(beat, missing=missing)
    write_heartbeat(bag_dir, beat)
    with serving(bag_dir, scratch / "log_robot", "storage=mcap") as server:
        chromium.open(server.url("/"))
        chromium.awaits("return !document.getElementById('again').disabled")
        state = chromium.text("#state")
    assert "recording, 2 restarts" in state
    assert "Never heard: /scan" in state
    assert "Offered by nobody: /gone_00, /gone_01" in state
    assert "and 15 more" in state


def test_without_a_bag_directory_every_part_says_so(chromium: Browser, scratch: Path) -> None:
    given = ("storage=mcap", "recorder=none")
    with serving(scratch / "nowhere", scratch / "log_nowhere", *given) as server:
        chromium.open(server.url("/"))
        chromium.awaits("return !document.getElementById('again').disabled")
        assert "does not exist" in chromium.text("#state")
        assert "does not exist" in chromium.text("#line")
        assert "does not exist" in chromium.text("#topics")
        for part in ("#way", "#seen"):
            assert chromium.text(part) == "There is no closed bag with a message."


def test_what_was_recorded_is_shown_as_text_and_never_runs(page: Browser) -> None:
    assert f"/{ATTACK}" in page.text("#topics")
    assert ATTACK in page.text("#seen")
    assert "\u202e" not in page.text("#topics")
    assert "/gnp\\u202e.rorre" in page.text("#topics")
    ask(page, "get_topic_seconds_ago", topic=f"/{ATTACK}", seconds_ago="1")
    assert "window.ran=1" in page.text("#told")
    assert page.run("return window.ran === undefined")
    assert page.run("return document.querySelectorAll('img, main script').length") == 0


def test_should_text_become_markup_after_all_it_is_refused(page: Browser) -> None:
    refused = page.run(
        "try { document.getElementById('told').innerHTML = arguments[0]; return false; }"
        "catch (error) { return error instanceof TypeError; }",
        ATTACK,
    )
    assert refused
    assert page.run("return window.ran === undefined")
    page.complaints()


def test_a_tool_is_asked_with_the_keyboard_alone(page: Browser) -> None:
    page.keys(TAB)
    assert page.run("return document.activeElement.className") == "skip"
    page.keys(ENTER)
    page.keys(TAB)
    assert page.run(FOCUSED) == "tool"
    page.keys("get_position_sec")
    assert page.run("return document.getElementById('tool').value") == "get_position_seconds_ago"
    page.keys(TAB)
    assert page.run(FOCUSED) == "field-seconds_ago"
    assert page.run("return getComputedStyle(document.activeElement).outlineStyle") == "solid"
    page.keys(ENTER)
    page.awaits(ANSWERED)
    assert '"seconds_ago": 10' in page.text("#asked")
    assert '"x": 30' in page.text("#told")
    assert page.text("#outcome").startswith("answered")
    assert page.run(FOCUSED) == "send"


def test_a_question_without_an_answer_shows_why(page: Browser) -> None:
    ask(page, "get_position_at", timestamp=str(T0_S - 1000))
    assert page.text("#outcome").startswith("no answer")
    assert '"error": "no_data"' in page.text("#told")


def test_every_tool_that_reads_has_a_form_with_labels(page: Browser) -> None:
    names = page.run(
        "return [...document.getElementById('tool').options].map((each) => each.value)"
    )
    assert {"recap", "find_matches", "get_transform_at", "memory_status"} <= set(names)
    assert "remember_moment" not in names
    for name in names:
        choose(page, name)
        unlabelled = page.run(
            "return [...document.querySelectorAll('#question input, #question select')]"
            ".filter((each) => each.labels.length === 0).map((each) => each.id)"
        )
        assert unlabelled == [], name


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [360, 1200])
def test_it_fits_its_window_and_can_be_read(page: Browser, width: int, dark: bool) -> None:
    page.looks(width=width, height=740, dark=dark)
    assert page.run("return document.documentElement.scrollWidth") <= width
    colours = page.run(
        "const shown = (name, at) => getComputedStyle(at)[name].match(/\\d+/g).map(Number);"
        "const card = shown('backgroundColor', document.querySelector('section'));"
        "return [...document.querySelectorAll('section p, section td, section dt, section th')]"
        ".map((each) => [shown('color', each).slice(0, 3), card.slice(0, 3)])"
    )
    assert min(contrast(*each) for each in colours) >= 4.5
    assert (sum(colours[0][1]) < 200) == dark
    assert page.screenshot().startswith(b"\x89PNG")


def test_with_a_token_it_shows_nothing_until_the_token_was_typed(
    chromium: Browser, served: Served, scratch: Path
) -> None:
    chromium.looks(width=1200, height=900)
    given = ("storage=mcap", "data.now=wall")
    with serving(scratch / "bags", scratch / "log_token", *given, MEMORY_API_TOKEN=GOOD) as closed:
        chromium.open(closed.url("/"))
        chromium.awaits("return !document.getElementById('locked').hidden")
        assert "odom" not in chromium.text("body")
        assert chromium.run(FOCUSED) == "token"
        chromium.keys("a-token-that-is-wrong" + ENTER)
        chromium.awaits("return document.getElementById('locked-why').textContent !== ''")
        assert "not the one of this server" in chromium.text("#locked-why")
        chromium.keys(GOOD + ENTER)
        chromium.awaits(READY)
        assert chromium.run("return document.getElementById('locked').hidden")
        assert "/odom" in chromium.text("#topics")
        assert "counts from the time of this look" in chromium.text("#state")


def choose(page: Browser, tool: str) -> None:
    page.run(
        "const tool = document.getElementById('tool'); tool.value = arguments[0];"
        "tool.dispatchEvent(new Event('change'));",
        tool,
    )


def ask(page: Browser, tool: str, **given: str) -> None:
    choose(page, tool)
    for name, value in given.items():
        page.run(
            "document.getElementById(arguments[0]).value = arguments[1]", f"field-{name}", value
        )
    page.run("document.getElementById('send').click()")
    page.awaits(ANSWERED)


def contrast(one: list[int], other: list[int]) -> float:
    """The contrast ratio of two sRGB colours (WCAG 2.1, definition of contrast ratio)."""
    darker, lighter = sorted((luminance(one), luminance(other)))
    return (lighter + 0.05) / (darker + 0.05)


def luminance(colour: list[int]) -> float:
    """Relative luminance (WCAG 2.1)."""
    parts = [each / 255 for each in colour]
    linear = [
        each / 12.92 if each <= 0.04045 else ((each + 0.055) / 1.055) ** 2.4 for each in parts
    ]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
