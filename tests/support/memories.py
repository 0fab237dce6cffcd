"""A whole memory over a folder of bags, as the composition root would build it."""

import asyncio
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from ros2_memory.bag_dir.layout import OWN_FOLDER
from ros2_memory.bootstrap import build_dispatcher, build_memory
from ros2_memory.columns.fill import Batch, Filling, StoreLimits
from ros2_memory.columns.scanner import Scanner
from ros2_memory.columns.store import FILE, ColumnStore
from ros2_memory.columns.writing import Level
from ros2_memory.config import Settings, load_settings
from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.timebase import NS_PER_S, Clock
from ros2_memory.extract import SchemaExtractor
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.index.scan import BAG_DIR_SETTING
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.serving.backfill import make_fragments
from ros2_memory.storage.base import BagReader
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from ros2_memory.tools.build import build_tools
from ros2_memory.tools.replies import Replies, Reply
from tests.support.bags import Msg, write_mcap, write_splits
from tests.support.clocks import SettableClock

LAST_WRITTEN = 1_800_000_000 * NS_PER_S
"""Tests date no bag later, unless that is what they test."""
ROOT = Path(__file__).resolve().parents[2]


@cache
def shipped_schemas() -> dict[str, dict[str, str]]:
    text = (ROOT / "config" / "message_schemas.yaml").read_text()
    schemas: dict[str, dict[str, str]] = yaml.safe_load(text)["schemas"]
    return schemas


@cache
def shipped_extractor(max_array_length: int = 50) -> SchemaExtractor:
    return SchemaExtractor(shipped_schemas(), max_array_length)


def extractor() -> SchemaExtractor:
    return shipped_extractor()


def memory_of(
    bag_dir: Path,
    *,
    storage: str = "mcap",
    clock: Clock | None = None,
    reader: BagReader | None = None,
    limits: QuerySettings | None = None,
    include_active: bool = False,
    setting: str = BAG_DIR_SETTING,
    recalls: bool = False,
) -> Memory:
    """The memory over `bag_dir`, which `setting` names, rescanned at every question.

    Unless a clock is given it is later by an hour, and than all that tests write: what is
    unfinished was left so by a crash, and nothing is dated in the future. One that `recalls` has
    stored the columns of its closed bags.
    """
    if reader is None:
        reader = McapReader() if storage == "mcap" else Rosbag2Reader()
    timed = clock or SettableClock(max(time.time_ns(), LAST_WRITTEN) + 3600 * NS_PER_S)
    index = IndexManager(
        bag_dir,
        reader,
        timed,
        refresh_s=0.0,
        split_duration_s=10.0,
        include_active=include_active,
        setting=setting,
    )
    settings = limits or QuerySettings()
    columns = Scanner(None, bag_dir)
    memory = Memory(index, reader, extractor(), timed, settings, scanner=columns)
    return with_store(memory, bag_dir) if recalls else memory


def remembered(
    bag_dir: Path, messages: Iterable[Msg], split_s: float = math.inf, **how: Any
) -> Memory:
    """The memory over a recording of these messages, in splits of so long; see `memory_of`."""
    if split_s < math.inf:
        write_splits(bag_dir, messages, split_s)
    else:
        write_mcap(bag_dir / "rec" / "rec_0.mcap", messages)
    return memory_of(bag_dir, **how)


each_way = pytest.mark.parametrize("recalls", [False, True], ids=["plain", "catalogue"])
"""Asked of the bags alone, and of columns that are stored."""
Remember = Callable[..., Memory]
"""Makes the memory of `tmp_path`, to which it first writes messages as a bag; see `memory_of`."""


def with_store(memory: Memory, bag_dir: Path, *, part: float = 1.0, share: float = 1.0) -> Memory:
    """The memory with a store of columns of the first `part` of the closed bags.

    With a `share` of 0 it has none of the columns that may be left out.
    """
    store = ColumnStore([bag_dir / OWN_FOLDER / FILE], memory.reader.definition)
    scanner = Scanner(store, bag_dir)
    later = SettableClock(memory.clock.now())
    limits = StoreLimits(max_share=share, least_bytes_per_s=200 if share else 0)
    filling = Filling(scanner, memory.reader, bag_dir, later, limits)
    timeline = memory.index.snapshot().timeline
    waiting = filling.waiting(timeline)[::-1]
    # The newest first, as the server does: numbers of bags are in no order of time.
    stop = round(part * len(waiting))
    left_out = waiting[stop:]
    for bag in waiting[:stop][::-1]:
        filling.fill(Batch([bag], Level.BAG), timeline)
    for batch in filling.batches(timeline):
        if not {*batch.bags} & {*left_out}:
            filling.fill(batch, timeline)
    make_fragments(replace(memory, scanner=scanner), filling.whole_since())
    filling.thin()
    return replace(memory, scanner=scanner)


def asked(memory: Memory, name: str, **given: object) -> Any:
    """The JSON of the reply, be it an error."""
    return json.loads(replied(memory, name, given).text)


def noted(reply: Any, words: str) -> list[str]:
    """The notes of a reply that have some words."""
    return [note for note in reply.get("notes", ()) if words in note]


def clause(topic: str, condition_type: str, value: object, **more: Any) -> dict[str, Any]:
    """The arguments that state a condition, with others beside them."""
    return {"topic": topic, "condition_type": condition_type, "value": value, **more}


def assert_same_counts(reply: Any, expected: Any, *, of_means: float = 1e-3) -> None:
    """Both replies are the same; means and scores are, to what columns round numbers to."""
    assert reply == _rounded(expected, of_means)


def _rounded(reply: Any, of_means: float) -> Any:
    """What is equal to a reply with such means and scores."""
    if isinstance(reply, list):
        return [_rounded(each, of_means) for each in reply]
    if not isinstance(reply, dict):
        return reply
    found = {key: _rounded(each, of_means) for key, each in reply.items()}
    if isinstance(reply.get("score"), float):
        found["score"] = pytest.approx(reply["score"], abs=2e-4)
    for nth, name in enumerate(reply.get("columns", ())):
        if name.endswith(".mean"):
            # The first column of a row is its name, which the row of all has not.
            for row, at in (*((row, nth) for row in found["rows"]), (found["all"], nth - 1)):
                row[at] = pytest.approx(row[at], abs=of_means)
    return found


def replied(
    memory: Memory,
    name: str,
    given: Mapping[str, object],
    *,
    max_chars: int = 24_000,
) -> Reply:
    """The reply itself."""
    [tool] = [each for each in build_tools(memory.limits) if each.name == name]
    replies, call = Replies(memory.index.bag_dir, max_chars), Call()
    try:
        answer = tool.question(given)(memory, call)
    except EpisodicError as error:
        return replies.error(error)
    return replies.answer(answer, from_active=call.used_active)


@cache
def shipped_settings(bag_dir: Path) -> Settings:
    """Of a server over these bags; composing them takes longer than most replies do."""
    words = [f"recording.bag_dir='{bag_dir}'", "data.now=latest", "store.enabled=false"]
    return load_settings(words, env={})


def reply_over(bag_dir: Path, tool: str, **arguments: Any) -> Any:
    """What a server over the shipped configuration replies."""
    settings = shipped_settings(bag_dir)
    dispatcher = build_dispatcher(settings, build_memory(settings))
    return json.loads(asyncio.run(dispatcher.answer(tool, arguments)).text)
