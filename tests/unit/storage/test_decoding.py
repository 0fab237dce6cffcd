import pytest

from ros2_memory.core.errors import UndecodableError
from ros2_memory.storage.base import Channel, Record, Schema
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import Msg, definition, odom, text


def record_of(message: Msg, schema: Schema | None = None) -> Record:
    given = schema or Schema(message.type, "ros2msg", definition(message.type).encode())
    return Record(Channel(message.topic, "cdr", given), 1, 1, message.payload)


def test_big_endian_messages_are_read() -> None:
    payload = b"\x00\x00\x00\x00" + b"\x00\x00\x00\x03hi\x00"
    record = record_of(text(1, "x"))._replace(payload=payload)
    assert getattr(McapReader().decode(record), "data", "") == "hi"


def test_every_cut_of_a_payload_is_undecodable_and_nothing_else() -> None:
    whole = record_of(odom(1, 2.0, 3.0))
    decoding = McapReader()
    for size in range(len(whole.payload)):
        with pytest.raises(UndecodableError):
            decoding.decode(whole._replace(payload=whole.payload[:size]))
    assert decoding.decode(whole)


def test_a_message_of_a_type_whose_definition_is_empty_names_what_to_set() -> None:
    record = record_of(text(1, "a text"), Schema("a_msgs/msg/Lost", "ros2msg", b""))
    decoding = McapReader()
    with pytest.raises(UndecodableError, match=r"reader\.custom_msg_paths"):
        decoding.decode(record)
    nothing = record._replace(payload=b"\x00\x01\x00\x00\x00")
    assert decoding.decode(nothing) is not None
