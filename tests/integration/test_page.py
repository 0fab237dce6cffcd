"""The page at `/` in real Chromium, over a history that holds what a hostile sender would send."""

import math
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import pytest

from ros2_memory.core.timebase import NS_PER_S
from tests.integration.browser import ENTER, RIGHT, TAB, Browser, needs_chromium
from tests.support.bags import boolean, detections, odom, text, write_mcap
from tests.support.documented_history import heartbeat
from tests.support.processes import until
from tests.support.robot_run import T0, T0_S
from tests.support.served import Served, serving
from tests.unit.test_positions import fix

pytestmark = needs_chromium

GOOD = "kJ7-x._~+/0123456789=="
ATTACK = '<img src=x onerror="window.ran=1"><script>window.ran=1</script>'
REVERSED = "/gnp\u202e.rorre"
READY = """
  const shown = document.getElementById('summary').getAttribute('aria-busy') === 'false';
  return shown && !document.getElementById('memory').hidden;
"""
LOOKED = "return document.getElementById('summary').getAttribute('aria-busy') === 'false'"
REQUESTS = """
  return performance.getEntriesByType('resource').map((each) => new URL(each.name).pathname);
"""
POSED = "return map.moment !== null"
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
def served(scratch: Path) -> Iterator[Served]:
    write_history(scratch / "bags")
    with serving(scratch / "bags", scratch / "log", "storage=mcap") as server:
        yield server


@pytest.fixture
def page(chromium: Browser, served: Served) -> Iterator[Browser]:
    """The page with everything shown; what it complains of fails the test."""
    chromium.looks(width=1200, height=900)
    # Of a page before, whose server may have ended.
    chromium.open("about:blank")
    chromium.complaints()
    show(chromium, served)
    yield chromium
    assert chromium.complaints() == []


def show(browser: Browser, served: Served, address: str = "") -> None:
    """Opens the page anew, also where only the part behind # differs.

    What takes long comes after the first look, and is waited for.
    """
    browser.open("about:blank")
    browser.open(served.url(f"/{address}"))
    browser.awaits(READY)
    browser.awaits(
        "const { view } = state;"
        "return !view || view.range.earliest === null || view.filling || view.isWhole;"
    )


@contextmanager
def replaying(browser: Browser, bag_dir: Path, address: str = "") -> Iterator[Served]:
    """A server of bags that nobody records, and its page; what that complains of fails."""
    given = ("storage=mcap", "recorder=none", "data.now=latest")
    browser.looks(width=1200, height=900)
    browser.open("about:blank")
    browser.complaints()  # of a page whose server ended
    with serving(bag_dir, bag_dir.with_suffix(".log"), *given) as server:
        show(browser, server, address)
        yield server
        # Before the server ends, which what the page still asks for would complain of.
        assert browser.complaints() == []


def rest(page: Browser) -> None:
    """The page looks for nothing new from here on, so that what a test sets stays."""
    page.run(
        "asking.abort(); asking = new AbortController(); isLooking = true;"
        "for (const each of running.values()) each.abort();"
    )


def test_a_first_look_is_four_requests_and_shows_the_memory_at_a_glance(page: Browser) -> None:
    requests = page.run(REQUESTS)
    assert requests[:3] == ["/page/page.css", "/page/page.js", "/page/span"]
    # Besides the page itself; lists, the path in detail, and what is new are asked for later.
    later = {"/page/topics", "/page/labels", "/page/path"}
    assert set(requests[3:]) <= {"/page/span"} | later
    assert page.run("return state.view.range.gaps.length") == 1
    state, events = page.text("#state"), page.text("#events")
    assert all(each in state for each in ("damaged_0.mcap", "Recorder\nno heartbeat yet", "GB"))
    label = page.run("return document.getElementById('map').getAttribute('aria-label')")
    assert all(each in label for each in ("30.0 m driven in odom", "2 stops"))
    # Nothing green stands above something red.
    assert state.startswith("! Damaged bags")
    assert page.run("return document.querySelectorAll('#state .good').length") == 0
    # Nobody knows how it came over the gap.
    assert page.run("return [...map.path.starts].length") == 2
    assert "stood at x 15.00, y 0.00" in events
    assert "Robot\nx\u00a030.00, y\u00a00.00\u00a0m" in page.text("#moment")
    assert painted(page, "#map") > 1000
    assert painted(page, "#timeline") > 1000


def test_pointing_at_a_time_or_at_the_path_puts_the_robot_there_and_lists_what_it_saw(
    page: Browser,
) -> None:
    page.point("#map", *page.run("return [map.px(7), map.py(0)]"))
    page.awaits(POSED)
    assert abs(page.run("return map.moment.x") - 7.0) < 0.7
    at_s = T0_S + 10
    page.point("#timeline", *page.run("return [line.x(arguments[0]), 60]", at_s))
    page.awaits("return Math.abs(map.moment.x - 10) < 0.5")
    awaits_text(page, "#moment", "It saw")
    assert "cup" in page.text("#moment")
    assert page.text("#moment-title") == "At this time"
    page.point("#timeline", 1, 1)


def test_what_is_no_time_is_ignored_in_the_address_and_in_a_form(
    page: Browser, served: Served
) -> None:
    show(page, served, "#at=1e300&last=600")
    assert page.run("return [state.t, state.last]") == [None, 600]
    assert page.run("return document.getElementById('trouble').hidden")
    choose(page, "get_position_at")
    page.run("document.getElementById('field-timestamp').focus()")
    page.run("document.activeElement.value = ''")
    page.keys("1784000000000000000")  # nanoseconds
    assert "1784000000000000000" in page.run("return document.activeElement.value")


def test_a_time_that_was_chosen_stays_and_is_in_the_address(page: Browser, served: Served) -> None:
    page.press("#timeline", *page.run("return [line.x(arguments[0]), 60]", T0_S + 5))
    page.awaits("return location.hash.includes('at=')")
    address = page.run("return location.hash")
    awaits_text(page, "#moment", "It saw")
    show(page, served, address)
    page.awaits(POSED)
    assert abs(page.run("return map.moment.x") - 5.0) < 0.5
    page.run("document.getElementById('back').click()")
    assert page.text("#moment-title") == "When recording ended"
    assert "at=" not in page.run("return location.hash")


def test_the_timeline_is_dragged_and_zoomed_and_the_address_has_the_span(page: Browser) -> None:
    before = page.run("return state.span")
    page.press("#time-in")
    page.awaits("return state.last === null")
    page.awaits(LOOKED)
    zoomed = page.run("return state.span")
    length = before["end"] - before["start"]
    assert abs((zoomed["end"] - zoomed["start"]) - length / 2) < 0.1
    page.drag("#timeline", (300, 60), (400, 60))
    page.awaits("return state.span.start < arguments[0]", zoomed["start"] - 1)
    page.awaits("return state.view.start < arguments[0]", zoomed["start"] - 1)
    dragged = page.run("return state.span")
    assert abs((dragged["end"] - dragged["start"]) - length / 2) < 0.1
    assert f"from={dragged['start']:.3f}" in page.run("return location.hash")
    page.run("document.getElementById('timeline').focus()")
    page.keys("-")
    page.awaits("return state.span.end - state.span.start > arguments[0]", length * 0.7)
    select(page, "length", "3600")
    page.awaits("return location.hash.startsWith('#last=')")
    page.awaits(LOOKED)


def test_the_wheel_moves_the_timeline_also_with_shift_by_which_a_drag_selects(
    page: Browser,
) -> None:
    begun = page.run(
        "const { span: { start }, canvas } = line, { left, top } = canvas.getBoundingClientRect();"
        "canvas.dispatchEvent(new WheelEvent('wheel', { clientX: left + 300, clientY: top + 60,"
        " deltaX: 40, shiftKey: true })); return start"
    )
    assert page.run("return [line.stretch, line.span.start > arguments[0]]", begun) == [None, True]


def test_a_stretch_and_a_thing_show_what_was_seen(page: Browser) -> None:
    page.run("chooseStretch(state.view.events.find((each) => each.kind === 'stop'))")
    awaits_text(page, "#moment", "Stood")
    assert "cup" in page.text("#moment")
    assert page.text("#moment-title").startswith("stood at x 15.00")
    page.run(
        "[...document.querySelectorAll('#moment button')]"
        ".find((each) => each.textContent === 'cup').click()"
    )
    awaits_text(page, "#moment", "sighting")
    assert page.text("#moment-title") == "cup"
    assert page.run("return document.querySelectorAll('#moment li').length") >= 1


def test_it_is_used_with_the_keyboard_alone_and_the_skip_link_leaves_the_span(
    page: Browser,
) -> None:
    before = page.run("return location.hash")
    page.keys(TAB)
    assert page.run("return document.activeElement.className") == "skip"
    page.keys(ENTER)
    assert page.run(FOCUSED) == "timeline"
    assert page.run("return location.hash") == before
    assert page.run("return getComputedStyle(document.activeElement).outlineStyle") == "solid"
    page.keys(RIGHT)
    page.awaits("return state.t !== null")
    value = page.run(
        "const slider = document.activeElement;"
        "return [slider.getAttribute('role'), slider.getAttribute('aria-valuetext'),"
        " clock(state.t)]"
    )
    assert value[0] == "slider"
    assert value[1] == value[2]
    page.awaits("return document.getElementById('moment').getAttribute('aria-busy') === 'false'")


def test_a_number_is_plotted_below_the_timeline(page: Browser, served: Served) -> None:
    field = "linear_velocity.x"
    number = f"[aria-label='Plot /odom {field}']"
    page.awaits("return document.querySelector(arguments[0]) !== null", number)
    assert "1,200 messages" in page.text("#topics")
    assert page.run("return [...document.querySelectorAll('.spoke')].every((each) => each.width)")
    page.press(number, 3, 3)
    page.awaits("return document.querySelector('.uplot canvas') !== null")
    assert f"/odom:{field}: from 0 to 1" in page.run(
        "return document.querySelector('.plot').getAttribute('aria-label')"
    )
    show(page, served, page.run("return location.hash"))
    page.awaits("return document.querySelector('.uplot canvas') !== null")


def test_each_label_has_a_row_of_the_timeline_and_its_sightings_are_listed(page: Browser) -> None:
    """The detections of this history have no place, and are seen in both bags all the time."""
    page.awaits("return state.view.seen !== null")
    rows = page.run(
        "return line.lanes.filter((each) => each.label !== undefined)"
        ".map((each) => [each.label, each.bars.length])"
    )
    assert sorted(rows) == sorted([[ATTACK, 2], ["cup", 2]])
    assert page.text("#events").count("cup in view") == 2
    page.press("#timeline", 20, page.run("return line.lanes[2].top + 5"))
    awaits_text(page, "#moment", "sighting")
    assert page.text("#moment-title") == page.run("return plain(line.lanes[2].label)")


def test_what_there_is_more_of_than_is_shown_has_its_number_and_is_shown_on_demand(
    page: Browser,
) -> None:
    page.awaits("return state.view.seen !== null")
    rest(page)
    assert " of " not in page.text("#map-key")
    page.run(
        "state.view.counts.stops = 9; showKey();"
        "state.view.counts.sightings = 900; state.view.events = state.view.events"
        ".filter((each) => each.kind !== 'thing'); state.view.things = [];"
        "state.view.seen.labels[0].sightings = 899;"
        "showEvents(at('events'), state.view, chooseStretch, chooseLabel);"
        "showThings(at('things'), state.view, chooseThing);"
    )
    assert "stops, 2 of 9" in page.text("#map-key")
    assert "899 sightings" in page.text("#events")
    assert "What was seen has no place" in page.text("#things")
    # Of labels those that were seen longest have rows.
    page.run(
        "const { start } = state.span; const labels = Array.from({ length: 14 }, (_, n) =>"
        " ({ label: `thing ${n}`, bars: [[start, start + 1]] }));"
        "state.view.seen = { labels, until: Infinity }; line.show(state.view, state.span);"
    )
    count = "return line.lanes.filter((each) => each.label !== undefined).length"
    high = page.run("return document.getElementById('timeline').clientHeight")
    assert page.run(count) == 10
    assert page.text("#all-labels") == "All 14 labels"
    page.press("#all-labels")
    assert page.run(count) == 14
    assert page.run("return document.getElementById('timeline').clientHeight") > high
    page.press("#all-labels")
    assert page.run(count) == 10


def test_where_no_pose_topic_is_clear_it_is_chosen_and_the_address_keeps_it(
    chromium: Browser, scratch: Path
) -> None:
    """Two topics of poses and a satellite receiver: nothing is drawn until one was chosen."""
    messages = []
    for n in range(100):
        at = T0 + n * NS_PER_S // 10
        messages.append(odom(at, n / 10, 0.0, topic="/wheels"))
        messages.append(odom(at, 0.0, n / 5, topic="/lidar"))
        messages.append(fix(at, n * 1e-6, 0.0))
    write_mcap(scratch / "unclear" / "rec" / "rec_0.mcap", messages)
    with replaying(chromium, scratch / "unclear") as server:
        chromium.awaits("return !document.getElementById('poses-part').hidden")
        assert "Choose it above" in chromium.text("#map-key")
        offered = "return [...document.getElementById('poses').options].map((each) => each.text)"
        assert chromium.run(offered) == ["choose a topic", "/lidar", "/wheels", "/fix (GPS)"]
        for topic, end in (("/wheels", (9.9, 0)), ("/lidar", (0, 19.8)), ("/fix", (0, 11.01))):
            select(chromium, "poses", topic)
            chromium.awaits("return state.view.poses === arguments[0] && state.view.isWhole", topic)
            x, y = chromium.run("return [map.path.x.at(-1), map.path.y.at(-1)]")
            assert (x, y) == pytest.approx(end, abs=0.02)
        assert "east and north of 48.123457, 11.765432" in chromium.text("#map-key")
        show(chromium, server, chromium.run("return location.hash"))
        chromium.awaits("return document.getElementById('poses').value === '/fix'")
        chromium.awaits("return Boolean(state.view.path) && state.view.isWhole")
        assert chromium.run("return state.view.path.y.at(-1)") == pytest.approx(11.01, abs=0.02)


RECKONED: dict[str, tuple[str, object]] = {
    "what the server had no time for is kept, and asked for again": (
        """
        const { view } = state, late = { ...view, since: view.start + 1 };
        delete late.events; delete late.path; const next = continued(view, late);
        const caught = continued(next, { ...view, since: view.start + 1 });
        return [next.events.length === view.events.length && view.events.length > 0,
        next.path.t.length === view.path.t.length, Math.abs(next.owed - view.start - 1) < 1e-3,
        view.owed, caught.owed]
        """,
        [True, True, True, None, None],
    ),
    "a look without things leaves those shown, and is not the last": (
        """
        const before = { ...state.view, things: [{ label: 'cup' }] }, late = { ...before };
        delete late.things; delete late.path; const next = whole(late, before);
        return [next.things.length, next.path.t.length === before.path.t.length, next.isWhole,
        whole(late, null).things.length, whole(before).isWhole];
        """,
        [1, True, False, 0, True],
    ),
    "a gap is as long as it was where the span begins in it": (
        """
        const gap = { kind: 'gap', t: 100, end: 160, text: 'nothing was recorded' };
        uncut(gap, { gaps: [[1, 5], [40, 160.004]] }); return [gap.t, gap.end]
        """,
        [40, 160.004],
    ),
    "notes have times and lengths as the page has them": (
        """
        const [from, to] = [1784000424.95, 1784087059.8];
        const said = 'nothing was recorded from 1784000424.950000 to 1784087059.800000 (86635 s)';
        return inWords(said) === `nothing was recorded from ${clock(from)} to ${clock(to)} (24.1 h)`
        """,
        True,
    ),
    "one recording is not counted as all": (
        """
        const row = (name, holds) => ({ name, holds });
        const range = { earliest: 0, latest: 1000, bags: 3, gaps: [[100, 900]] };
        const rows = [row('red', 2), row('red/a'), row('red/b'), row('blue')];
        return ['', 'red', 'blue'].map((recording) =>
        recordedOf({ range, recordings: rows, recordings_total: 4, recording }))
        """,
        [
            "3 min in 3 recordings over 17 min",
            "3 min in 2 recordings over 17 min",
            "17 min in 3 bags",
        ],
    ),
    "a clock that was set often takes one row": (
        """
        const steps = [1, 2, 3, 4].map((t) => ({ kind: 'clock step', t, text: `by ${t} s` }));
        return [...bundled([...steps, { kind: 'gap', t: 0, end: 1, text: 'a gap' }], () => {})]
        .map((each) => each.querySelectorAll('li').length || each.textContent.slice(0, 5))
        """,
        [4, "a gap"],
    ),
    "what is amiss is told, and what is sound is not": (
        """
        const { status, range } = state.view;
        const none = { ...range, damaged: [], incomplete: [], unread: [], clock_faults: [] };
        const fine = { ...status, doubts: SOUND, fell_silent: [], rules: [], never_heard: [],
        missing: [] };
        return [troublesOf(fine, none), troublesOf({ ...fine, never_heard: ['/scan'] }, none),
        troublesOf(fine, range)].map((each) => each.length > 0)
        """,
        [False, True, True],
    ),
    "an open page forgets the exact path and the numbers from before its span": (
        """
        const line = (...t) => ({ t, x: t, y: t, until: t.at(-1) });
        const path = continuedBy({ ...line(1, 2, 3, 4), begins: [0, 2] },
        { ...line(3, 4, 5, 6), begins: [0, 3] }, 2);
        const bins = (...t) => ({ t, low: t, mean: t, high: t });
        return [path.x, path.begins, path.until,
        joined(bins(1, 2, 3), { ...bins(3, 4), from: 3 }, 2).mean]
        """,
        [[2, 3, 4, 5, 6], [1, 4], 6, [2, 3, 4]],
    ),
    "identifiers of 64 bits keep their digits in questions and replies": (
        """
        const id = '9223372036854775811';
        return [exactly(`{"id":${id},"x":1.5}`), given({ type: ['string', 'number'] }, id)]
        .map((each) => JSON.stringify(each))
        """,
        ['{"id":9223372036854775811,"x":1.5}', "9223372036854775811"],
    ),
    "where no server answers it says so": (
        """
        const before = fetch; fetch = () => Promise.reject(new TypeError('Failed to fetch'));
        return asked('/page/span', {}).catch((error) => error.message)
        .finally(() => { fetch = before; })
        """,
        "The server does not answer.",
    ),
    "what is unfolded stays so as new data comes, and nothing else is": (
        """
        const host = el('div');
        const shown = (...numbers) => refill(host, ...numbers.map((each) =>
        el('details', {}, el('summary', {}, `${each} more`))));
        shown(3, 9); host.lastChild.open = true; shown(4, 10, 2);
        return [...host.children].map((each) => each.open)
        """,
        [False, True, False],
    ),
    "sizes": (
        "return [0.000064, 0.002, 0.53, 12.345].map(size)",
        ["64 kB", "2 MB", "530 MB", "12.3 GB"],
    ),
}
"""What functions of the page make of something, and what that is to be."""


def test_what_the_page_reckons_itself(page: Browser) -> None:
    found = {
        name: page.run(f"return (() => {{{script}}})()") for name, (script, _) in RECKONED.items()
    }
    assert found == {name: right for name, (_, right) in RECKONED.items()}


TICKS = """
  const texts = [], [start, end] = arguments;
  const pen = new Proxy({}, { set: () => true,
    get: (_, name) => name === 'fillText' ? (text) => texts.push(text) : () => {} });
  const drawn = { span: { start, end }, wide: 1000, x: () => 500 };
  Timeline.prototype.drawTicks.call(drawn, pen, 100, 200);
  return texts.slice(0, -2);  // below them are the dates of the ends
"""


def test_days_of_the_timeline_begin_at_midnight_also_after_clocks_were_set(
    chromium: Browser, served: Served
) -> None:
    """In Berlin, on 2026-10-25 at 3:00, clocks are set back to 2:00."""
    day_s, midnight_s = 86_400, 1_792_533_600  # 2026-10-21
    chromium.timezone("Europe/Berlin")
    try:
        show(chromium, served)
        ticks = chromium.run(TICKS, midnight_s - 1, midnight_s + 7 * day_s)
        hours = chromium.run(TICKS, midnight_s + 4 * day_s - 1, midnight_s + 5 * day_s)
    finally:
        chromium.timezone("")
    assert [re.sub(r"\D", "", tick) for tick in ticks] == [str(day) for day in range(21, 28)]
    assert hours[1:] == [f"{hour:02}:00" for hour in range(3, 24, 3)]


def test_no_name_on_the_map_covers_another_or_a_thing(page: Browser) -> None:
    """Two things far from all others have their names; of twelve in one place some have none."""
    drawn = page.run(
        "const drawn = []; const { fillText } = CanvasRenderingContext2D.prototype;"
        "const { x, y } = map.centre;"
        "const thing = (label, dx, dy) => ({ label, x: x + dx, y: y + dy });"
        "map.things = [thing('west', -8, 1), thing('east', 8, 1),"
        " ...Array.from({ length: 12 }, (_, n) => thing(`crowded ${n}`, n / 50, 1))];"
        "map.view = { ...map.view, places: [{ name: 'room', corners: ["
        "[x - 9, y - 3], [x + 9, y - 3], [x + 9, y + 3], [x - 9, y + 3]] }] };"
        "CanvasRenderingContext2D.prototype.fillText = function (text, left, base) {"
        " drawn.push([text, left, base - 11, this.measureText(text).width]); };"
        "map.drawn(); CanvasRenderingContext2D.prototype.fillText = fillText;"
        "const boxes = drawn.filter(([text]) => /[a-z]{2}/.test(text));"
        "const things = map.things.map((each) => [map.px(each.x) - 4, map.py(each.y) - 4, 8, 8]);"
        "map.show(state.view); return [boxes, things];"
    )
    names = {text for text, *_ in drawn[0]}
    assert {"west", "east", "room"} <= names
    assert 0 < len(names) - 3 < 12
    boxes = [(x, y, w, 14) for _, x, y, w in drawn[0]]
    for n, (x, y, w, h) in enumerate(boxes):
        for left, top, wide, high in [*boxes[:n], *drawn[1]]:
            assert x >= left + wide or left >= x + w or y >= top + high or top >= y + h


def test_where_no_pose_is_recorded_the_reason_stands_in_place_of_a_map(page: Browser) -> None:
    """No empty grid, and nothing is claimed of what was in view where nothing sees."""
    rest(page)
    page.run(
        "state.view = { ...state.view, path: null, robot: null, places: [], things: [], events: [],"
        " throughout: [], counts: {}, no_path: 'poses are on /pose: set data.pose_topic=/pose' };"
        "state.placing = { places_robot: [] }; map.show(state.view); showKey(); showLatest();"
    )
    assert page.text("#map-key") == "No path: poses are on /pose: set data.pose_topic=/pose."
    assert page.run("return document.getElementById('map').checkVisibility()") is False
    assert page.text("#moment") == "Where the robot is, is not known."


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


def test_of_bags_that_nobody_records_it_says_so_and_long_lists_and_names_have_room(
    chromium: Browser, scratch: Path
) -> None:
    write_odd_history(scratch / "odd")
    with replaying(chromium, scratch / "odd") as served:
        chromium.looks(width=360, height=740)
        show(chromium, served)
        state, summary = chromium.text("#state"), chromium.text("#summary")
        newest = chromium.run("return dated(state.view.range.latest)")
        for said in (
            "Recorder\nnone in this deployment",
            "Size\n",
            "! 30 damaged bag files\n",  # they are listed below: no tool is needed
            "not in the answers (30)",
            f"counts from the newest recorded moment, {newest}",
        ):
            assert said in state
        assert "Budget" not in state
        assert "Growth" not in state
        # The header counts from no other moment.
        assert f"recorded until {newest} \u00b7 " in summary
        assert "ago" not in summary
        assert chromium.run("return document.getElementById('live').hidden")
        assert chromium.run("return state.view.range.gaps.length") == 22
        shut = "return [...document.querySelectorAll('#state details')].map((e) => e.open)"
        assert {*chromium.run(shut)} == {False}
        # Whatever fonts there are: no text is narrower than a few words, and nothing is cut.
        for family in ("", "* { font-family: monospace !important; font-size: 20px !important; }"):
            narrow = chromium.run(
                "const sheet = new CSSStyleSheet(); sheet.replaceSync(arguments[0]);"
                "document.adoptedStyleSheets = [sheet];"
                "return [...document.querySelectorAll('li > *, dd')].filter((each) =>"
                " each.clientWidth > 0 && each.clientWidth < 60).map((each) => each.textContent)",
                family,
            )
            assert narrow == []
            assert chromium.run("return document.documentElement.scrollWidth") <= 360


def test_it_shows_what_the_recorder_says_of_itself(chromium: Browser, scratch: Path) -> None:
    bag_dir = scratch / "robot"
    write_mcap(bag_dir / "rec" / "rec_0.mcap", [odom(T0, 0.0, 0.0)])
    missing = tuple(f"/gone_{n:02}" for n in range(25))
    # One that comes each hour is live for as long as the test may take.
    said = {"interval_s": 3600.0, "restarts": 2, "silent": ("/scan",), "missing": missing}
    heartbeat(bag_dir, time.time_ns(), **said)
    with serving(bag_dir, scratch / "log_robot", "storage=mcap") as server:
        chromium.open(server.url("/"))
        chromium.awaits(LOOKED)
        state = chromium.text("#state")
    assert "recording, 2 restarts" in state
    assert "Never heard: /scan" in state
    assert "Offered by nobody: /gone_00, /gone_01" in state
    assert "and 15 more" in state


def test_without_a_bag_directory_it_says_so(chromium: Browser, scratch: Path) -> None:
    given = ("storage=mcap", "recorder=none")
    with serving(scratch / "nowhere", scratch / "log_nowhere", *given) as server:
        chromium.open(server.url("/"))
        chromium.awaits(LOOKED)
        assert "does not exist" in chromium.text("#state")
        assert "nothing is recorded" in chromium.text("#summary")
        assert chromium.run("return document.getElementById('memory').hidden")
        # The folder and the next step.
        assert chromium.text("#name") == "nowhere"
        assert f"{scratch / 'nowhere'}." in chromium.text("#empty")
        assert "ros2-memory serve FOLDER" in chromium.text("#empty")
        # It looks again by itself.
        drive(scratch / "nowhere", "one", time.time_ns() - 60 * NS_PER_S, 20)
        chromium.awaits("return !document.getElementById('memory').hidden")
        assert chromium.run("return document.getElementById('empty').hidden")


def test_of_recordings_of_several_years_the_header_has_their_length_and_times_have_the_year(
    chromium: Browser, scratch: Path
) -> None:
    for n, name in enumerate(("one", "two", "three")):
        drive(scratch / "years", name, T0 - n * 400 * 86_400 * NS_PER_S, 20)
    with replaying(chromium, scratch / "years", "#last=all"):
        assert chromium.text("#name") == "years"
        assert "60 s in 3 recordings over 2.2 years" in chromium.text("#summary")
        assert "60 s in 3 recordings over 2.2 years" in chromium.text("#state")
        years = chromium.run("return [state.span.start, state.span.end].map(yearOf)")
        assert all(f", {year}, " in chromium.text("#span-text") for year in years)
        times = chromium.run(
            "return [...document.querySelectorAll('#events li > span:last-child')]"
            ".map((each) => each.textContent)"
        )
        assert times
        assert all(re.search(r", 20\d\d, ", each) for each in times)


def test_ago_counts_from_one_moment_in_header_and_footer(page: Browser) -> None:
    rest(page)
    shown = page.run(
        "const { range, status } = state.view; range.now = range.latest + 42;"
        "state.view.status = { ...status, now: range.latest + 1, recorder_alive: true };"
        "const silent = agoOf(range.latest, range.latest + 1); document.body.append(silent);"
        "showSummary(); silent.remove();"
        "return [silent.textContent, dated(range.now)];"
    )
    assert "newest data 42 s ago" in page.text("#summary")
    assert shown[0] == "42 s ago"
    assert shown[1] in page.text("#since")


def test_what_was_recorded_is_shown_as_text_and_never_runs(page: Browser) -> None:
    page.run("pointed(state.view.range.latest, true)")
    awaits_text(page, "#moment", "It saw")
    assert ATTACK in page.text("#moment")
    assert "\u202e" not in page.run("return document.body.textContent")
    assert "/gnp\\u202e.rorre" in page.text("#events")
    ask(page, "get_topic_seconds_ago", topic=f"/{ATTACK}", seconds_ago="1")
    assert "window.ran=1" in page.text("#told")
    assert page.run("return window.ran === undefined")
    assert page.run("return document.querySelectorAll('img, main script').length") == 0
    # Should it become markup after all, that is refused.
    assert page.run(
        "try { document.getElementById('told').innerHTML = arguments[0]; return false; }"
        "catch (error) { return error instanceof TypeError && window.ran === undefined; }",
        ATTACK,
    )
    page.complaints()


def test_a_tool_is_asked_with_the_keyboard_alone(page: Browser) -> None:
    page.run("document.querySelector('#ask-part summary').focus()")
    page.keys(ENTER)
    page.awaits("return document.getElementById('tool').options.length > 0")
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
    # One without an answer shows why.
    ask(page, "get_position_at", timestamp=str(T0_S - 1000))
    assert page.text("#outcome").startswith("no answer")
    assert '"error": "no_data"' in page.text("#told")


def test_every_tool_that_reads_has_a_form_with_labels(page: Browser) -> None:
    choose(page, "recap")
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
    # The contrast ratio of WCAG 2.1 of each text, and how bright the ground is.
    least, ground = page.run(
        "const shown = (name, at) => getComputedStyle(at)[name].match(/\\d+/g).map(Number);"
        "const luminance = (colour) => [0.2126, 0.7152, 0.0722].reduce((sum, share, n) => {"
        " const part = colour[n] / 255;"
        " return sum + share * (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4);"
        "}, 0);"
        "const card = shown('backgroundColor', document.querySelector('section'));"
        "const texts = 'section p, section li, section dt, section dd, section h2';"
        "const ratios = [...document.querySelectorAll(texts)]"
        ".filter((each) => each.clientWidth > 0).map((each) => {"
        " const pair = [luminance(shown('color', each)) + 0.05, luminance(card) + 0.05];"
        " return Math.max(...pair) / Math.min(...pair); });"
        "return [Math.min(...ratios), luminance(card)];"
    )
    assert least >= 4.5
    assert (ground < 0.5) == dark
    assert page.screenshot().startswith(b"\x89PNG")


def test_with_a_token_it_shows_nothing_until_the_token_was_typed(
    chromium: Browser, served: Served, scratch: Path
) -> None:
    chromium.looks(width=1200, height=900)
    given = ("storage=mcap", "data.now=wall", "server.tools=spec", "server.keep_questions=5")
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
        assert "counts from the time of this look" in chromium.text("#state")
        assert GOOD not in chromium.run("return location.href + document.body.innerHTML")
        # Only the tools of the specification are offered, and the page has all the same.
        chromium.run("pointed(state.view.range.latest - 5, true)")
        awaits_text(chromium, "#moment", "It saw")
        ask(chromium, "get_position_at", timestamp=str(T0_S + 5))
        asked = {"name": "get_velocity_at", "arguments": {"timestamp": T0_S + 5}}
        httpx2.post(
            closed.url("/mcp"),
            headers={"authorization": f"Bearer {GOOD}", "accept": "application/json"},
            json={"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": asked},
        )
        chromium.awaits("return document.querySelectorAll('#questions pre').length > 0")
        assert "get_velocity_at" in chromium.text("#questions")
        assert "get_position_at" not in chromium.text("#questions")
        chromium.open(closed.url("/"))
        chromium.awaits(READY)
        chromium.run("sessionStorage.clear()")
    chromium.complaints()


def test_new_data_is_shown_by_the_next_poll_without_a_reload(
    chromium: Browser, scratch: Path
) -> None:
    """It polls every 2 s, and the first look that begins once the server knows has all that is new.

    So new data appears within 3 s of being answerable, however busy the machine of the test is.
    """
    bag_dir = scratch / "live"
    begin = time.time_ns() - 60 * NS_PER_S
    drive(bag_dir, "one", begin, 20)
    chromium.looks(width=1200, height=900)
    with serving(bag_dir, scratch / "log_live", "storage=mcap", "recorder=none") as server:
        show(chromium, server)
        chromium.awaits("return state.view.filling === null && state.view.isWhole")
        assert chromium.run("return state.view.robot.x") == 20
        assert chromium.text("#moment-title") == "Now"
        assert "newest data" in chromium.text("#moment-time")
        assert chromium.run("return !document.getElementById('live').hidden")
        assert chromium.run("return POLL_MS") <= 2000
        # Every look, and how far what was shown after it reaches; a reload would lose it.
        chromium.run(
            "window.looks = []; const before = look;"
            "look = async (...given) => { const mine = {}; looks.push(mine);"
            " await before(...given); mine.latest = state.view.range.latest; }"
        )
        drive(bag_dir, "two", begin + 20 * NS_PER_S, 10, x=20.0)
        span = server.url("/page/span?last=60&status=0&things=0")
        newest = until(lambda: _newest(span, begin / NS_PER_S + 25))
        begun = chromium.run("return looks.length")
        chromium.awaits("return looks.length > arguments[0] && looks[arguments[0]].latest", begun)
        assert chromium.run("return looks[arguments[0]]", begun) == {"latest": newest}
        assert chromium.run("return state.view.robot.x") == 30
        path = chromium.run("return state.view.path")
        assert path["t"] == sorted(path["t"])
        assert path["x"][0] == 0
        assert path["x"][-1] == 30
        assert path["begins"] == [0]
        # The path through every pose goes on, too, without a gap.
        chromium.awaits("return (map.exactly() || { x: [0] }).x.at(-1) === 30")
        assert chromium.run("return map.exactly().begins") == [0]
        # Totals follow, as often as a hundredth of the time allows.
        label = "return document.getElementById('map').getAttribute('aria-label')"
        chromium.awaits(f"{label}.includes('30.0 m driven')")


def _newest(address: str, after_s: float) -> float | None:
    """The newest time that the server answers, once it is later than another."""
    newest = float(httpx2.get(address).json()["latest"])
    return newest if newest > after_s else None


def test_of_several_recordings_one_is_looked_at_alone(chromium: Browser, scratch: Path) -> None:
    """Two robots in one folder are warned of; the address keeps which is looked at."""
    bag_dir = scratch / "two_robots"
    drive(bag_dir, "robin", T0, 20)
    drive(bag_dir, "wren", T0 + 5 * NS_PER_S, 20, x=100.0)
    with replaying(chromium, bag_dir) as server:
        assert "Robots are mixed: robin, wren overlap" in chromium.text("#mixed")
        assert "The map joins their paths" in chromium.text("#mixed")
        offered = chromium.run("return [...document.getElementById('recording').options]")
        assert len(offered) == 3
        select(chromium, "recording", "wren")
        chromium.awaits("return state.view.recording === 'wren'")
        assert "recording=wren" in chromium.run("return location.hash")
        chromium.awaits("return state.view.isWhole")
        assert chromium.run("return Math.min(...state.view.path.x)") == 100
        assert chromium.run("return document.getElementById('mixed').hidden")
        assert "this recording alone" in chromium.text("#summary")
        assert chromium.text("#name") == "wren"
        chromium.run("pointed(arguments[0], true)", T0_S + 2)
        awaits_text(chromium, "#moment", "It saw")
        # What is asked about a moment is asked of this recording, which had not begun.
        assert "x\u00a02.00" not in chromium.text("#moment")
        show(chromium, server, "#last=all&recording=robin")
        assert chromium.run("return Math.max(...state.view.path.x)") == 20
        choose(chromium, "data_time_range")
        chromium.press("#send")
        chromium.awaits(ANSWERED)
        assert "recording robin alone" in chromium.text("#ask-part")
        assert '"bags": 1' in chromium.text("#told")
        chromium.open("about:blank")
        chromium.open(server.url("/#recording=robim"))
        chromium.awaits("return !document.getElementById('trouble').hidden")
        assert "similar: robin" in chromium.text("#trouble")
        # The way back is offered.
        select(chromium, "recording", "")
        chromium.awaits(READY)
        assert chromium.run("return Math.max(...state.view.path.x)") == 120


OFF_PATH = """
  const [poses] = arguments;
  const shape = map.exactly();
  const inside = poses.map(([x, y]) => [map.px(x), map.py(y)]).filter(([x, y]) =>
    x > 0 && y > 0 && x < map.canvas.clientWidth && y < map.canvas.clientHeight);
  const away = ([x, y]) => Math.min(...shape.t.slice(1).map((_, n) => {
    if (shape.starts.has(n + 1)) return Infinity;
    const [ax, ay] = [map.px(shape.x[n]), map.py(shape.y[n])];
    const [dx, dy] = [map.px(shape.x[n + 1]) - ax, map.py(shape.y[n + 1]) - ay];
    const share = clamp(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1), 0, 1);
    return Math.hypot(ax + dx * share - x, ay + dy * share - y);
  }));
  map.place(arguments[1]);
  const arrow = [map.px(map.moment.x), map.py(map.moment.y)];
  return [inside.length, Math.max(...inside.map(away)), away(arrow)];
"""


def test_at_every_zoom_the_path_and_the_arrow_on_it_are_as_driven_and_headings_of_a_compass(
    chromium: Browser, scratch: Path
) -> None:
    """Circles of 1 m; the first look has a track, of which a pose may be 5 cm off."""
    angles = [n * 0.02 for n in range(1200)]
    poses = [(math.sin(each), 1 - math.cos(each)) for each in angles]
    messages = [
        odom(T0 + n * NS_PER_S // 20, x, y, yaw=angles[n]) for n, (x, y) in enumerate(poses)
    ]
    write_mcap(scratch / "circles" / "rec" / "rec_0.mcap", messages)
    with replaying(chromium, scratch / "circles"):
        assert "Heading\n-66\u00b0" in chromium.text("#moment")  # 23.98 rad, 4 turns less
        for factor in (1, 6, 6, 3):
            chromium.run("map.zoom(arguments[0], map.px(1), map.py(1))", factor)
            chromium.run("map.pan(map.canvas.clientWidth / 2 - map.px(1), 0)")
            chromium.awaits("return map.exactly() !== null")
            at_s = T0_S + math.pi / 2 / 0.4 + 0.02  # it passes x 1, y 1
            inside, off_px, arrow_px = chromium.run(OFF_PATH, poses, at_s)
            assert inside >= 5
            assert off_px <= 2
            assert arrow_px <= 2


def drive(bag_dir: Path, name: str, begin: int, seconds: int, x: float = 0.0) -> None:
    """A bag of a robot that drives 1 m/s, in place at once as a closed one."""
    at_s = [n / 10 for n in range(seconds * 10 + 1)]
    messages = [odom(begin + int(s * NS_PER_S), x + s, 0.0, vx=1.0) for s in at_s]
    write_mcap(bag_dir / name / f"{name}_0.mcap", messages)


def awaits_text(page: Browser, selector: str, text: str) -> None:
    page.awaits(
        "return document.querySelector(arguments[0]).textContent.includes(arguments[1])",
        selector,
        text,
    )


def select(page: Browser, of: str, value: str) -> None:
    page.run(
        "const chosen = document.getElementById(arguments[0]); chosen.value = arguments[1];"
        "chosen.dispatchEvent(new Event('change'));",
        of,
        value,
    )


def painted(page: Browser, canvas: str) -> int:
    """How many pixels of a canvas are not empty."""
    return int(
        page.run(
            "const canvas = document.querySelector(arguments[0]);"
            "const { data } = canvas.getContext('2d')"
            ".getImageData(0, 0, canvas.width, canvas.height);"
            "return data.filter((each, n) => n % 4 === 3 && each > 0).length;",
            canvas,
        )
    )


def choose(page: Browser, tool: str) -> None:
    page.run("document.getElementById('ask-part').open = true")
    page.awaits("return document.getElementById('tool').options.length > 0")
    select(page, "tool", tool)


def ask(page: Browser, tool: str, **given: str) -> None:
    choose(page, tool)
    for name, value in given.items():
        page.run(
            "document.getElementById(arguments[0]).value = arguments[1]", f"field-{name}", value
        )
    page.run("document.getElementById('send').click()")
    page.awaits(ANSWERED)
