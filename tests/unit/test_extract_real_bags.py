"""Every message of public robots' bags, decoded with plain rosbags and mcap."""

from __future__ import annotations

import json
import sqlite3
from functools import cache
from typing import TYPE_CHECKING

import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ros2_memory.messages.conversions import names_of
from tests.support.memories import shipped_extractor, shipped_schemas
from tests.support.shared_bags import REAL, needs_real

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rosbags.typesys.store import Typestore

EXTRACTOR = shipped_extractor()
MAX_REPLY_CHARS = 24_000
SETS = {
    "rosbags_rs_94types_mcap": 188,
    "rosbags_rs_94types_db3": 188,
    "cougars_auv_mcap": 2671,
    "rerun_sensors_mcap": 194,
}


def store_of(name: str, text: str) -> Typestore:
    if not text:
        return get_typestore(Stores.ROS2_JAZZY)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, name))
    return store


@cache
def messages(folder: Path) -> list[tuple[str, str, object]]:
    """Topic, type and message of everything in a folder's bags."""
    stores: dict[tuple[str, str], Typestore] = {}
    found: list[tuple[str, str, object]] = []
    for topic, name, text, payload in (*mcap_rows(folder), *sqlite_rows(folder)):
        if (name, text) not in stores:
            stores[name, text] = store_of(name, text)
        found.append((topic, name, stores[name, text].deserialize_cdr(payload, name)))
    return found


def mcap_rows(folder: Path) -> Iterator[tuple[str, str, str, bytes]]:
    for path in sorted(folder.glob("*.mcap")):
        with path.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                assert schema is not None
                yield channel.topic, schema.name, schema.data.decode(), message.data


def sqlite_rows(folder: Path) -> Iterator[tuple[str, str, str, bytes]]:
    for path in sorted(folder.glob("*.db3")):
        base = sqlite3.connect(f"file:{path}?immutable=1", uri=True)
        yield from base.execute(
            "SELECT t.name, t.type, d.encoded_message_definition, m.data FROM messages m "
            "JOIN topics t ON t.id = m.topic_id "
            "JOIN message_definitions d ON d.topic_type = t.type ORDER BY m.timestamp"
        )
        base.close()


@needs_real
@pytest.mark.parametrize("name", SETS)
def test_every_message_is_shown_as_strict_json_that_fits_a_reply(name: str) -> None:
    shown = 0
    for _, type_name, message in messages(REAL / name):
        value = EXTRACTOR.shown(message, type_name).value
        text = json.dumps(value, allow_nan=False)
        assert len(text) < MAX_REPLY_CHARS
        assert "__msgtype__" not in text
        assert isinstance(EXTRACTOR.exact(message, type_name), dict)
        EXTRACTOR.transforms(message, 0, static=False)
        shown += 1
    assert shown == SETS[name]


@needs_real
def test_each_field_of_each_type_can_be_asked_for_alone() -> None:
    for _, type_name, message in messages(REAL / "rosbags_rs_94types_mcap"):
        for path in (*names_of(message), *shipped_schemas().get(type_name, ())):
            value = EXTRACTOR.shown(message, type_name, [path]).value
            assert isinstance(value, dict)
            assert list(value) == [path]
