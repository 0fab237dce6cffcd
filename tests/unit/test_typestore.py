import shutil
import struct
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from ros2_memory.core.errors import ConfigError
from ros2_memory.storage.base import Definition
from ros2_memory.typestore import (
    MAX_CACHED_BYTES,
    MAX_MEMBERS,
    MAX_NESTING,
    MAX_STATEMENTS,
    MAX_TEXT_BYTES,
    MessageType,
    Typestores,
)
from tests.support.bags import VISION_DEFINITIONS, detections, typestore

RULE = "=" * 80
CDR = b"\x00\x01\x00\x00"


def decoded(found: MessageType | str, payload: bytes) -> Any:
    assert isinstance(found, MessageType)
    return found.deserialize(payload)


def reason(found: MessageType | str) -> str:
    assert isinstance(found, str)
    assert found
    assert "\n" not in found
    assert len(found) < 400
    return found


def spelled_out(kind: str | Definition) -> object:
    if isinstance(kind, str):
        return kind
    return [(each.name, spelled_out(each.kind), each.length) for each in kind.fields]


def lookup(name: str, definition_text: str, encoding: str = "ros2msg") -> MessageType | str:
    return Typestores().lookup(name, encoding, definition_text.encode())


@pytest.fixture
def vision(tmp_path: Path) -> Path:
    """The folder of the package `ros2_vision_interfaces`."""
    folder = tmp_path / "ros2_vision_interfaces"
    (folder / "msg").mkdir(parents=True)
    for name, message_text in VISION_DEFINITIONS.items():
        (folder / "msg" / f"{name.rsplit('/', 1)[1]}.msg").write_text(message_text)
    return folder


def test_the_definition_inside_the_bag_counts_first(vision: Path) -> None:
    name = "ros2_vision_interfaces/msg/StampedString"
    found = Typestores([vision]).lookup(name, "ros2msg", b"uint8 only\n")
    assert decoded(found, CDR + b"\x07").only == 7


def test_a_folder_counts_before_the_standard_types(tmp_path: Path) -> None:
    folder = tmp_path / "std_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "String.msg").write_text("uint8 length\n")
    found = Typestores([tmp_path]).lookup("std_msgs/msg/String", "", b"")
    assert decoded(found, CDR + b"\x09").length == 9


def test_parts_that_the_bag_does_not_define_come_from_folders_and_standard(vision: Path) -> None:
    message = detections(1, ["cup"])
    root_only = VISION_DEFINITIONS[message.type].encode()
    found = Typestores([vision]).lookup(message.type, "ros2msg", root_only)
    expected = typestore().deserialize_cdr(message.payload, message.type)
    assert repr(decoded(found, message.payload)) == repr(expected)


def test_two_bags_that_define_a_type_differently_are_each_read_with_their_own() -> None:
    stores = Typestores()
    payload = CDR + bytes([1, 2, 0, 0])
    one = stores.lookup("a_msgs/msg/A", "ros2msg", b"uint8 x\nuint8 y\n")
    other = stores.lookup("a_msgs/msg/A", "ros2msg", b"uint16 both\n")
    first, second = decoded(one, payload), decoded(other, payload)
    assert (first.x, first.y) == (1, 2)
    assert second.both == 0x0201
    assert stores.lookup("a_msgs/msg/A", "ros2msg", b"uint16 both\n") is other


def test_every_standard_type_is_the_same_after_its_text_was_written() -> None:
    stores = Typestores()
    for name in get_typestore(Stores.LATEST).fielddefs:
        standard = stores.lookup(name, "", b"")
        assert isinstance(standard, MessageType)
        written = stores.lookup(name, "ros2msg", standard.fields.text().encode())
        assert isinstance(written, MessageType)
        assert spelled_out(written.fields) == spelled_out(standard.fields), name


def test_windows_line_ends_a_byte_order_mark_and_odd_bytes_do_no_harm() -> None:
    whole = "\ufeff# caf\u00e9\r\nuint8 x # \u00e9\r\nOther other\r\n"
    whole += f"{RULE}\r\nMSG: a_msgs/Other\r\nuint8 y\r\n"
    raw = whole.encode() + b"# \xff\xfe\r\n"
    found = Typestores().lookup("a_msgs/msg/A", "ros2msg", raw)
    message = decoded(found, CDR + b"\x01\x02")
    assert message.other.y == 2


def test_idl_as_the_recorder_writes_it() -> None:
    whole = f"""{RULE}
IDL: a_msgs/msg/A
// generated from rosidl_adapter/resource/msg.idl.em
#include "a_msgs/msg/B.idl"
module a_msgs {{
  module msg {{
    module A_Constants {{
      @verbatim (language="comment", text="no (real) comment" "\\n" "--- more")
      const octet LIMIT = 5;
      const string NAME = "a (b)";
    }};
    @verbatim (language="comment", // of (
      text="A is (nested (twice))")
    struct A {{
      @unit (value="m")
      double x; boolean on; float least; builtin_interfaces::msg::Time at;
      /* of parts */ sequence<a_msgs::msg::B, 4> parts;
      @default (value=7)
      long corners[2];
    }};
  }};
}};
{RULE}
IDL: a_msgs/msg/B
module a_msgs {{ module msg {{ struct B {{ octet value; string name; }}; }}; }};
"""
    found = lookup("a_msgs/msg/A", whole, "ros2idl")
    same = lookup(
        "a_msgs/msg/A",
        "float64 x\nbool on\nfloat32 least\nbuiltin_interfaces/Time at\n"
        f"B[<=4] parts\nint32[2] corners\n{RULE}\nMSG: a_msgs/B\nbyte value\n"
        "string name\n",
    )
    payload = (
        CDR
        + np.array([1.5]).tobytes()
        + b"\1\0\0\0"
        + bytes(12)
        + b"\x01\0\0\0\x05\0\0\0\x03\0\0\0hi\0\0"
    )
    payload += np.array([8, 9], dtype=np.int32).tobytes()
    message, plain = decoded(found, payload), decoded(same, payload)
    for field in ("x", "on", "least", "at", "parts", "corners"):
        assert repr(getattr(message, field)) == repr(getattr(plain, field))
    assert list(message.corners) == [8, 9]


@pytest.mark.parametrize(
    ("whole", "kind"),
    [
        ("bool ask\n---\nbool answer\n", "a service definition"),
        ("int8 goal\n---\nint8 result\n---\nint8 feedback\n", "an action definition"),
    ],
)
def test_services_and_actions_are_refused_as_what_they_are(whole: str, kind: str) -> None:
    assert kind in reason(lookup("a_msgs/srv/A", whole))


@pytest.mark.parametrize("header", ["", f"{RULE}\nSRV: a_msgs/srv/A\n"])
def test_an_event_of_a_service_has_its_request_or_its_response(header: str) -> None:
    found = lookup("a_msgs/srv/A_Event", f"{header}B ask\n---\n{RULE}\nMSG: a_msgs/B\nbool b\n")
    assert isinstance(found, MessageType)
    info = b"\1\0\0\0" + bytes(4) + bytes(4) + bytes(16) + bytes(4) + (7).to_bytes(8, "little")
    asked = decoded(found, CDR + info + b"\1\0\0\0\1\0\0\0" + bytes(4))
    assert (asked.info.event_type, asked.info.sequence_number) == (1, 7)
    assert [each.ask.b for each in asked.request] == [True]
    assert list(asked.response) == []
    answered = decoded(found, CDR + info + bytes(4) + b"\1\0\0\0\0")
    assert len(answered.response) == 1


@pytest.mark.parametrize(
    "name", ["a/b/srv/A_Event", "srv/A_Event", "a_msgs/msg/A_Event", "A_Event"]
)
def test_a_service_under_another_name_is_refused(name: str) -> None:
    assert "a service definition" in reason(lookup(name, "bool ask\n---\nbool answer\n"))


def nested(depth: int) -> str:
    """A definition of so many types, each in the one before it."""
    parts = [f"{RULE}\nMSG: a_msgs/A{n}\nA{n + 1} a\n" for n in range(depth)]
    return "A0 a\n" + "".join(parts) + f"{RULE}\nMSG: a_msgs/A{depth}\nuint8 x\n"


def of_many_parts() -> str:
    """A definition of parts that are not too long each, but have too many fields in all."""
    fields = "\n".join(f"uint8 f{n}" for n in range(MAX_STATEMENTS // 2))
    count = 2 * MAX_MEMBERS // MAX_STATEMENTS + 1
    parts = [f"{RULE}\nMSG: a_msgs/B{n}\n{fields}\n" for n in range(count)]
    return "".join(f"B{n} b{n}\n" for n in range(count)) + "".join(parts)


@pytest.mark.parametrize(
    ("whole", "said"),
    [
        ("A inner\n", "contains itself"),
        (f"B b\n{RULE}\nMSG: a_msgs/B\nC[] c\n{RULE}\nMSG: a_msgs/C\nA a\n", "contains itself"),
        (nested(3000), f"more than {MAX_NESTING} levels"),
        ("#" * (MAX_TEXT_BYTES + 1), "larger than"),
        ("\n".join(f"uint8 f{n}" for n in range(20_000)), "too many"),
        (of_many_parts(), f"more than {MAX_MEMBERS} fields"),
        ("string[2000000000] s\n", "fixed arrays"),
        (f"Point[1000000] p\n{RULE}\nMSG: a_msgs/Point\nfloat64 x\n", "fixed arrays"),
        *((f"wstring{each} x\n", "which is not decoded") for each in ("", "[]", "[2]")),
    ],
    ids=count(),
)
def test_a_definition_without_an_end_or_larger_than_any_is_refused(whole: str, said: str) -> None:
    assert said in reason(lookup("a_msgs/msg/A", whole))


def test_a_large_array_of_numbers_costs_nothing_until_a_payload_contains_it() -> None:
    found = lookup("a_msgs/msg/A", "float64[2000000000] x\n")
    assert isinstance(found, MessageType)
    with pytest.raises(Exception, match="deserialize"):
        found.deserialize(CDR + bytes(16))


@pytest.mark.parametrize(
    ("inside", "said"),
    [
        *(
            (f"struct A {{ {kind} x; }};", "which is not decoded")
            for kind in ("wstring", "wchar", "sequence<wstring>", "wstring<5>")
        ),
        # The parser would not come to an end.
        ("const long X = ((((((1))))));", "is not supported"),
        ("const long X = 1 << 99999999999;", "is not supported"),
        ("struct A { sequence<sequence<sequence<sequence<long>>>> x; };", "is not supported"),
    ],
    ids=count(),
)
def test_idl_that_cannot_be_read_is_refused(inside: str, said: str) -> None:
    whole = f"module a_msgs {{ module msg {{ {inside} struct B {{ long y; }}; }}; }};"
    assert said in reason(lookup("a_msgs/msg/A", whole, "ros2idl"))


@pytest.mark.parametrize(
    "text", ["/* " * 200_000, '"' + r"\"" * 200_000, "@a(" * 200_000], ids=["/*", '"', "@"]
)
def test_idl_in_which_much_is_begun_and_nothing_ended(text: str) -> None:
    assert reason(lookup("a_msgs/msg/A", text, "ros2idl"))


def test_code_in_a_definition_is_not_run() -> None:
    for whole in (
        'string X="""\\n__import__("os").abort()\n',
        "uint8 x = __import__('os').abort()\n",
        "uint8 __import__('os').abort()\n",
        "string X='''+__import__('os').abort()+'''\n",
    ):
        found = lookup("a_msgs/msg/A", whole)
        assert isinstance(found, MessageType) or "its definition" in found


def test_a_package_a_folder_of_packages_and_an_installed_tree_are_all_found(
    vision: Path, tmp_path: Path
) -> None:
    installed = tmp_path / "install" / "share" / vision.name
    shutil.copytree(vision, installed)
    for path in (vision, vision.parent, str(vision), tmp_path / "install"):
        found = Typestores([path]).lookup("ros2_vision_interfaces/msg/VisionDetection", "", b"")
        assert isinstance(found, MessageType)


def test_feedback_of_an_action_is_decoded_by_its_action_file(tmp_path: Path) -> None:
    name = "cleaning_msgs/action/Clean_FeedbackMessage"
    missing = Typestores().lookup(name, "", b"")
    assert "put the package's .action folder into reader.custom_msg_paths" in str(missing)
    package = tmp_path / "cleaning_msgs"
    (package / "action").mkdir(parents=True)
    (package / "msg").mkdir()
    (package / "msg" / "Spot.msg").write_text("float32 dirt\n")
    actions = {
        "Clean": "string room\n---\nbool done\n---\n# So far.\nSpot spot\nuint32 rooms\n",
        "Stop": "---\n---\n",
    }
    for action, content in actions.items():
        (package / "action" / f"{action}.action").write_text(content)
    stores = Typestores([tmp_path])
    found = stores.lookup(name, "", b"")
    assert isinstance(found, MessageType)
    payload = bytes((0, 1, 0, 0, *range(16))) + struct.pack("<fI", 0.5, 3)
    message: Any = found.deserialize(payload)
    assert (message.goal_id.uuid.tolist(), message.feedback.rooms) == ([*range(16)], 3)
    assert message.feedback.spot.dirt == 0.5
    empty = stores.lookup("cleaning_msgs/action/Stop_FeedbackMessage", "", b"")
    assert isinstance(empty, MessageType)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "string room\n",
        "string room\n---\nbool done\n",
        "string room\n--- # done\n--- # so far\n",
    ],
)
def test_a_file_that_defines_no_action_stops_the_start_and_is_named(
    tmp_path: Path, text: str
) -> None:
    file = tmp_path / "cleaning_msgs" / "action" / "Clean.action"
    file.parent.mkdir(parents=True)
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"custom_msg_paths: .*Clean\.action is not an action"):
        Typestores([tmp_path])


def test_definitions_that_begin_with_a_byte_order_mark_are_read(tmp_path: Path) -> None:
    for kind, text in (("msg", "float32 dirt\n"), ("action", "---\n---\nuint32 rooms\n")):
        file = tmp_path / "cleaning_msgs" / kind / f"Spot.{kind}"
        file.parent.mkdir(parents=True)
        file.write_text(text, encoding="utf-8-sig")
    stores = Typestores([tmp_path])
    for name in ("msg/Spot", "action/Spot_FeedbackMessage"):
        assert isinstance(stores.lookup(f"cleaning_msgs/{name}", "", b""), MessageType)


def test_the_name_in_package_xml_counts_before_the_folders(vision: Path) -> None:
    (vision / "package.xml").write_text("<package><name>other_msgs</name></package>")
    stores = Typestores([vision])
    assert isinstance(stores.lookup("other_msgs/msg/StampedString", "", b""), MessageType)
    assert isinstance(stores.lookup("ros2_vision_interfaces/msg/StampedString", "", b""), str)


def test_a_wrong_path_stops_the_start_and_is_named(tmp_path: Path) -> None:
    missing = tmp_path / "missing"
    with pytest.raises(ConfigError, match=r"custom_msg_paths: .*missing is not a folder"):
        Typestores([missing])
    missing.mkdir()
    with pytest.raises(ConfigError, match=r"missing holds no msg/\*\.msg or action"):
        Typestores([missing])


def cached_texts(stores: Typestores) -> list[bytes]:
    keys = (key for _, key in stores._types._store.entries)
    return [text for _, _, text in cast("Iterator[tuple[str, str, bytes]]", keys)]


def test_the_cache_of_definitions_is_bounded_by_their_length() -> None:
    stores = Typestores()
    long = (f"# {n} {'x' * (MAX_TEXT_BYTES - 100)}\nuint8 x\n" for n in range(20))
    for each in long:
        assert isinstance(stores.lookup("a_msgs/msg/A", "ros2msg", each.encode()), MessageType)
        assert sum(map(len, cached_texts(stores))) <= MAX_CACHED_BYTES
    assert cached_texts(stores)
