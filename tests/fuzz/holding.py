"""Holds every answer about a mutant to what can be read of it (`oracle`)."""

import hashlib
import json
from collections import Counter
from random import Random
from typing import Any

from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import View
from ros2_memory.serving.mcp_server import EpisodicServer
from tests.fuzz.asking import ask
from tests.fuzz.good import Good
from tests.fuzz.mutant import Mutant
from tests.fuzz.oracle import Readable, readable_db3, readable_mcap
from tests.support.bags import typestore

_PACKED = b"\x28\xb5\x2f\xfd"
_ASKED = 4
_OF_ALL = ("/tf", "/tf_static")
"""Topics of which the good bags hold messages too."""
_SLACK_NS = 2_000
"""Unix seconds as floats, rounded to microseconds, are so far from a log time at most."""
_EXCUSES = (
    "could not be read",
    "could not be decoded",
    "left out",
    "ends early",
    "no possible log time",
)
"""What a note says where messages are known to be missing."""


def truth_of(mutant: Mutant, good: Good) -> list[Readable] | None:
    """What can be read of a mutant that is one file; None where that has no one right answer."""
    if [*mutant.files] != [mutant.bag] or mutant.lay is not None or mutant.trap is not None:
        return None
    data = mutant.files[mutant.bag]
    if mutant.bag.endswith(".zstd"):
        return None
    return readable_mcap(data) if good.is_mcap else readable_db3(data)


async def hold(
    memory: Memory, server: EpisodicServer, bag: BagFile, truth: list[Readable], rng: Random
) -> list[str]:
    """The answers that are not what can be read, each in a sentence."""
    faults = _wrong_summary(bag, truth)
    topics = sorted({each.topic for each in truth})
    for topic in rng.sample(topics, min(_ASKED, len(topics))):
        held = sorted((each for each in truth if each.topic == topic), key=_time)
        faults += _wrong_reading(memory, bag, topic, held, rng)
        if topic not in _OF_ALL:
            faults += await _wrong_point(server, topic, held, rng)
            faults += await _wrong_range(server, topic, held, rng)
    faults += await _wrong_match(server, truth, rng)
    faults += await _wrong_transform(server, truth, rng)
    return faults


def _time(each: Readable) -> int:
    return each.time


def _wrong_summary(bag: BagFile, truth: list[Readable]) -> list[str]:
    if _excused(bag.summary.notes):
        return []
    stated: dict[str, tuple[int, int, int]] = {}
    for topic in {each.topic for each in bag.summary.topics}:
        of = bag.summary.of(topic)
        first, last = min(each.first for each in of), max(each.last for each in of)
        stated[topic] = sum(each.count for each in of), first, last
    true = {}
    for topic in {each.topic for each in truth}:
        times = [each.time for each in truth if each.topic == topic]
        true[topic] = len(times), min(times), max(times)
    return [] if stated == true else [f"oracle: summary {stated}, not {true}"[:600]]


def _digest(payload: bytes) -> bytes:
    return hashlib.blake2b(payload).digest()


def _wrong_reading(
    memory: Memory, bag: BagFile, topic: str, held: list[Readable], rng: Random
) -> list[str]:
    """What a view reads of the bag itself, in windows that begin and end anywhere."""
    faults = []
    for newest_first in (False, True):
        start, stop = sorted(
            rng.choice(held).time + rng.choice((0, 0, 1, -1, 40_000_000)) for _ in range(2)
        )
        view = View(memory, Call())
        records = view.bags.read(bag, [topic], TimeWindow(start, stop), newest_first=newest_first)
        # Of a bomb, payloads would fill the memory that is measured.
        found = [(each.record.log_time, _digest(each.record.payload)) for each in records]
        if _excused(view.notes.sentences()):
            continue
        times = [time for time, _ in found]
        wanted = [each for each in held if start <= each.time < stop]
        plain = not any(each.payload.startswith(_PACKED) for each in wanted)
        same = Counter(found) == Counter((each.time, _digest(each.payload)) for each in wanted)
        if (plain and not same) or times != sorted(map(_time, wanted), reverse=newest_first):
            faults.append(
                f"oracle: {topic} in [{start}, {stop}) newest_first={newest_first}: {len(found)}"
                f" messages, not {len(wanted)}; notes {view.notes.sentences()}"[:600]
            )
    return faults


async def _wrong_point(
    server: EpisodicServer, topic: str, held: list[Readable], rng: Random
) -> list[str]:
    at = rng.choice(held).time + rng.choice((0, 50_000_000))
    answer = await ask(server, "get_topic_at_time", {"topic": topic, "timestamp": at / 1e9})
    if not isinstance(answer, dict) or "timestamp" not in answer or _excused(answer.get("notes")):
        return []
    newest = max(each.time for each in held if each.time <= at)
    if _is(answer["timestamp"], [newest, *_within_slack(held, at)]):
        return []
    return [f"oracle: {topic} at {at}: {str(answer)[:300]}, not {newest}"]


async def _wrong_range(
    server: EpisodicServer, topic: str, held: list[Readable], rng: Random
) -> list[str]:
    start, end = sorted(rng.choice(held).time + 20_000 for _ in range(2))
    answer = await ask(
        server,
        "get_topic_in_range",
        {"topic": topic, "start": start / 1e9, "end": end / 1e9, "max_samples": 200},
    )
    samples = answer.get("samples") if isinstance(answer, dict) else None
    if samples is None or _excused(answer.get("notes")):
        return []
    times = [each.time for each in held]
    if any(start - _SLACK_NS <= at < start + _SLACK_NS for at in times):
        return []
    inside = [at for at in times if start <= at <= end + 1000]
    if all(_is(each["timestamp"], inside) for each in samples):
        return []
    return [f"oracle: {topic} from {start} to {end}: {str(answer)[:300]}"]


async def _wrong_match(server: EpisodicServer, truth: list[Readable], rng: Random) -> list[str]:
    texts: dict[bytes, int] = {}
    for each in truth:
        if each.topic == "/chatter" and each.payload[:4] == b"\0\1\0\0":
            text = each.payload[8:].rstrip(b"\0")
            texts[text] = max(each.time, texts.get(text, 0))
    whole = {
        text: at for text, at in texts.items() if text.isascii() and text.endswith(b" of a way")
    }
    if not whole:
        return []
    text, at = rng.choice(sorted(whole.items()))
    given = {"topic": "/chatter", "condition_type": "contains", "value": text.decode()}
    faults = []
    last = await ask(server, "find_last_match", given)
    if isinstance(last, dict) and not _excused(last.get("notes")) and "error" not in last:
        found = last.get("timestamp")
        if found is None or not _is(found, [at]):
            faults.append(f"oracle: last match of {text!r}: {str(last)[:300]}, not {at}")
    matches = await ask(server, "find_matches", given)
    if isinstance(matches, dict) and not _excused(matches.get("notes")) and "error" not in matches:
        stated = json.dumps(matches)
        if "sightings" in matches and not matches["sightings"]:
            faults.append(f"oracle: no sighting of {text!r}: {stated[:300]}")
    return faults


async def _wrong_transform(server: EpisodicServer, truth: list[Readable], rng: Random) -> list[str]:
    moved: dict[int, set[float]] = {}
    for each in truth:
        if each.topic == "/tf":
            try:
                message: Any = typestore().deserialize_cdr(each.payload, "tf2_msgs/msg/TFMessage")
            except Exception:  # noqa: BLE001 - odd payloads are another question
                return []
            for edge in message.transforms:
                if (edge.header.frame_id, edge.child_frame_id) == ("odom", "base"):
                    stamp = edge.header.stamp.sec * 10**9 + edge.header.stamp.nanosec
                    moved.setdefault(stamp, set()).add(edge.transform.translation.x)
    if not moved:
        return []
    at = rng.choice(sorted(moved))
    given = {"parent": "odom", "child": "base", "timestamp": at / 1e9}
    answer = await ask(server, "get_transform_at", given)
    if not isinstance(answer, dict) or "error" in answer or _excused(answer.get("notes")):
        return []
    x = answer["translation"]["x"]
    if any(abs(x - each) < 1e-3 for each in moved[at]):
        return []
    return [f"oracle: transform at {at}: {str(answer)[:300]}, not {moved[at]}"]


def _within_slack(held: list[Readable], at: int) -> list[int]:
    return [each.time for each in held if at < each.time <= at + _SLACK_NS]


def _is(stated: object, times: list[int]) -> bool:
    """Whether a reply's time is one of these log times."""
    if not isinstance(stated, (int, float)):
        return False
    return any(abs(stated * 1e9 - time) <= _SLACK_NS for time in times)


def _excused(notes: object) -> bool:
    """Whether the reply reports that messages are missing."""
    told = notes if isinstance(notes, (list, tuple)) else ()
    return any(excuse in str(note) for note in told for excuse in _EXCUSES)
