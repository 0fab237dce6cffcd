"""Message definitions: the fields of each type, and a deserializer for it.

A definition is looked up first in the bag (the schema text, nested types included), then in the
configured `.msg` folders, then among the standard types. Every distinct schema text has a typestore
of its own, so that two bags that define one type differently are read correctly.

Definitions are read from files that anybody may have written. Their size, nesting and arrays are
bounded before the parser and the code generator of rosbags see them: both take exponential time or
memory on some inputs.
"""

from __future__ import annotations

import re
import threading
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ros2_memory.core import directories
from ros2_memory.core.errors import ConfigError
from ros2_memory.storage.base import SEQUENCE, Definition, Field
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from rosbags.interfaces.typing import BaseDesc, FieldDesc, Typesdict

MAX_TEXT_BYTES: Final = 1 << 20
MAX_STATEMENTS: Final = 2_000
"""Of the definition of one type; the parser takes half a millisecond for each."""
MAX_MEMBERS: Final = 4_000
"""Fields and constants of a type and all that it is made of; the largest standard type has 112."""
MAX_NESTING: Final = 40
MAX_UNROLLED: Final = 5_000
"""Elements of fixed arrays of strings or messages: rosbags writes a line of code for each."""
MAX_CACHED_BYTES: Final = 8 << 20
"""Of definitions whose deserializers are cached; a deserializer takes some ten times as much."""
_CACHED_TYPE_BYTES: Final = 2_048
"""Added to the size of each text, so that at most 4,096 types are cached."""
_REASON_LENGTH: Final = 300

_SEPARATOR: Final = re.compile(r"^=+[ \t]*\n(MSG|IDL):[ \t]*(\S+)[ \t]*\n", re.MULTILINE)
_WIDE: Final = frozenset({"wchar", "wstring"})
"""Types that rosbags makes no deserializer for; in a `.msg` it takes them for messages."""
_EVENT: Final = "_Event"
_HALVES: Final = ("Request", "Response")
_SERVICE_HEADER: Final = re.compile(r"={80}\nSRV: .*\n")
_EVENT_INFO: Final = """\
uint8 event_type  # 0 request sent, 1 request received, 2 response sent, 3 response received
builtin_interfaces/Time stamp
uint8[16] client_gid
int64 sequence_number
"""
_KIND: Final = re.compile(r"/(?:srv|action)/")
_SERVICE: Final = re.compile(r"^---[ \t]*$", re.MULTILINE)
_ACTION_PARTS: Final = 3
_MSG_NOISE: Final = re.compile(r"^[ \t]*(?:#[^\n]*)?\n", re.MULTILINE)
_IDL_PIECE: Final = re.compile(
    r'"(?:\\.|[^"\\])*"?|/\*(?:.*?\*/|.*)|//[^\n]*|@[A-Za-z_]\w*(?:[ \t]*\()?|[()]|[^"/@()]+|.',
    re.DOTALL,
)
_IDL_DIRECTIVE: Final = re.compile(r"^[ \t]*#[^\n]*", re.MULTILINE)
_IDL_NESTED_SEQUENCE: Final = re.compile(r"sequence\s*<\s*sequence")


class MessageType(NamedTuple):
    """The type that a schema defines.

    Attributes:
        fields: the definition, for readers that do not know rosbags.
        store: compiles a deserializer when it is first used; columns need none.
    """

    fields: Definition
    store: Typestore

    def compiled(self) -> MessageType | str:
        """Compiles the deserializer; returns the type, or why it cannot be compiled."""
        try:
            with _run_by_rosbags():
                self.store.get_msgdef(self.fields.type)
        except _UnusableError as error:
            return str(error)
        return self

    def deserialize(self, payload: bytes) -> object:
        """Decodes a payload."""
        return self.store.deserialize_cdr(payload, self.fields.type)

    def serialize(self, message: object) -> bytes:
        """Encodes a decoded message as CDR."""
        return bytes(self.store.serialize_cdr(message, self.fields.type))


class _UnusableError(Exception):
    """A definition that no deserializer can be made of; the text is the reason."""


class _Section(NamedTuple):
    encoding: str
    text: str


class Typestores:
    """Deserializers by schema content. Thread-safe.

    Args:
        custom_msg_paths: folders that contain `<package>/msg/*.msg` or `<package>/action/*.action`
            at any depth, or a package. If several folders have a type, the first one counts.

    Raises:
        ConfigError: a path is not a folder, has no such file in it, or cannot be read; or an
            `.action` file lacks its parts.
    """

    def __init__(self, custom_msg_paths: Sequence[Path | str] = ()) -> None:
        self._folders: dict[str, _Section] = {}
        for path in custom_msg_paths:
            for name, text in _definitions_below(Path(path)):
                self._folders.setdefault(name, _Section("ros2msg", text))
        self._types: ByteLru[MessageType | str] = ByteLru(MAX_CACHED_BYTES)
        self._lock = threading.Lock()

    def lookup(self, name: str, encoding: str, text: bytes) -> MessageType | str:
        """Returns the type that a schema of a bag defines, or why it cannot be decoded.

        Args:
            name: of the type, `package/msg/Name`.
            encoding: `ros2msg`, `ros2idl`, or empty if the bag has no definition.
            text: the definition followed by the nested ones, as rosbag2 concatenates them.
        """
        key = (name, encoding, text)
        # One thread at a time compiles: another that waits here then finds the type.
        with self._lock:
            known = self._types.get(key)
            if known is None:
                known = self._build(name, encoding, text)
                self._types.put(key, known, _CACHED_TYPE_BYTES + len(name) + len(text))
            return known

    def _build(self, name: str, encoding: str, text: bytes) -> MessageType | str:
        root = full_name(name)
        try:
            definitions = self._closure(root, _sections(root, encoding, text))
            store = Typestore()
            with _run_by_rosbags():
                store.register(definitions)
        except _UnusableError as error:
            return " ".join(str(error).split())[:_REASON_LENGTH]
        return MessageType(definition_of(definitions, root), store)

    def _closure(self, root: str, in_bag: Mapping[str, _Section]) -> Typesdict:
        """Returns the definitions of `root` and of all nested types, checked to be bounded."""
        definitions: Typesdict = {}
        visited: set[str] = set()
        members = unrolled = 0
        # Depth first: an error about a type that contains itself names the trail to it.
        to_visit: list[tuple[str, tuple[str, ...]]] = [(root, ())]
        while to_visit:
            name, trail = to_visit.pop()
            if name in trail:
                raise _UnusableError(f"its definition contains itself: {' > '.join(trail)}")
            if name in visited:
                continue
            visited.add(name)
            if len(trail) > MAX_NESTING:
                raise _UnusableError(f"its definition nests more than {MAX_NESTING} levels deep")
            if name not in definitions:
                parsed = self._definition(name, in_bag, trail)
                members += sum(
                    len(constants) + len(fields) for constants, fields in parsed.values()
                )
                if members > MAX_MEMBERS:
                    raise _UnusableError(f"its definition has more than {MAX_MEMBERS} fields")
                definitions.update(parsed)
            _, fields = definitions[name]
            shapes = [_shape(field) for _, field in fields]
            unrolled += _unrolled_elements(shapes)
            if unrolled > MAX_UNROLLED:
                raise _UnusableError(
                    f"its fixed arrays of strings and messages hold more than {MAX_UNROLLED}"
                    " elements"
                )
            nested = dict.fromkeys(kind for kind, _ in shapes if "/" in kind)
            to_visit += [(inner, (*trail, name)) for inner in reversed(nested)]
        return {
            name: (constants, [(field_name, _unsigned(field)) for field_name, field in fields])
            for name, (constants, fields) in definitions.items()
            if name in visited
        }

    def _definition(
        self, name: str, in_bag: Mapping[str, _Section], trail: tuple[str, ...]
    ) -> Typesdict:
        section = in_bag.get(name)
        if section is None or not section.text:
            section = self._folders.get(name, section)
        if section is None or not section.text:
            standard = _standard_definitions()
            if name in standard:
                return {name: standard[name]}
        if section is not None:
            parsed = _parse(name, section)
            if name in parsed:
                return parsed
            raise _UnusableError(f"its definition defines {', '.join(parsed)}, not {name}")
        missing = f"its part {name} (in {trail[-1]})" if trail else "it"
        kind = "action" if "/action/" in name else "msg"
        raise _UnusableError(
            f"{missing} has no definition in the bag or elsewhere; put the package's .{kind} folder"
            " into reader.custom_msg_paths"
        )


def _unrolled_elements(shapes: Sequence[tuple[str, int | None]]) -> int:
    """Returns how many elements the fixed arrays of strings and messages of a type have.

    Raises:
        _UnusableError: a field is of a type that is not decoded.
    """
    wide = _WIDE.intersection(kind.rpartition("/")[2] for kind, _ in shapes)
    if wide:
        raise _UnusableError(f"its definition has a {min(wide)}, which is not decoded")
    elements = 0
    for kind, length in shapes:
        if length != SEQUENCE and ("/" in kind or kind == "string"):
            elements += length or 0
    return elements


@cache
def _standard_definitions() -> Typesdict:
    """Returns the definitions of ROS's own messages.

    Called only if a bag lacks a definition, since rosbags derives them from six distributions in
    60 ms of processor time.
    """
    return get_typestore(Stores.LATEST).fielddefs


def _sections(name: str, encoding: str, text: bytes) -> dict[str, _Section]:
    """Returns the definitions in one schema text, by type name."""
    if encoding not in {"", "ros2msg", "ros2idl", "omgidl"}:
        raise _UnusableError(f"its schema encoding {encoding!r} is not read")
    if len(text) > MAX_TEXT_BYTES:
        raise _UnusableError(f"its definition is larger than {MAX_TEXT_BYTES} bytes")
    plain = text.decode("utf-8", errors="replace").replace("\r\n", "\n").lstrip("\ufeff")
    if not plain.strip():
        # A type without fields has an empty text, and so has one whose text was not found.
        return {name: _Section(encoding, "")} if encoding else {}
    sections: dict[str, _Section] = {}
    if encoding != "ros2idl" and _SERVICE.search(plain):
        sections, plain = _service_event(name, plain)
    # The root's text, then kind, name and text of each nested definition.
    root, *nested = _SEPARATOR.split(plain if plain.endswith("\n") else plain + "\n")
    if root.strip():
        sections[name] = _Section("ros2msg" if encoding in {"", "ros2msg"} else "ros2idl", root)
    for kind, nested_name, body in zip(nested[::3], nested[1::3], nested[2::3], strict=True):
        section = _Section("ros2idl" if kind == "IDL" else "ros2msg", body)
        sections.setdefault(full_name(nested_name), section)
    return sections


def _service_event(name: str, text: str) -> tuple[dict[str, _Section], str]:
    """Returns the definitions of the events of a service, and the text of the nested ones.

    rosbag2 stores the definition of the service itself. An event of rosidl's service introspection
    (REP-2012) has who called when, and the request or the response if contents are published.
    """
    separator = _SEPARATOR.search(text)
    own_end = len(text) if separator is None else separator.start()
    own_text, nested = text[:own_end], text[own_end:]
    parts = _SERVICE.split(_SERVICE_HEADER.sub("", own_text, count=1))
    words = name.removesuffix(_EVENT).split("/")
    is_event = name.endswith(_EVENT) and len(words) == 3 and words[1] == "srv"
    if not is_event or len(parts) != len(_HALVES):
        kind = "an action" if len(parts) > len(_HALVES) else "a service"
        raise _UnusableError(f"{kind} definition, and no message")
    package, _, short = words
    sections = {"service_msgs/msg/ServiceEventInfo": _Section("ros2msg", _EVENT_INFO)}
    fields = ["service_msgs/ServiceEventInfo info"]
    for half, part in zip(_HALVES, parts, strict=True):
        member = f"{package}/{short}_{half}"
        parsed = _parse(full_name(member), _Section("ros2msg", part))
        _, members = parsed[full_name(member)]
        body = part if members else f"{part}\nuint8 structure_needs_at_least_one_member\n"
        sections[full_name(member)] = _Section("ros2msg", body)
        fields.append(f"{member}[<=1] {half.lower()}")
    sections[name] = _Section("ros2msg", "\n".join(fields))
    return sections, nested


def full_name(name: str) -> str:
    """Returns `package/Name` as `package/msg/Name`."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


def _parse(name: str, section: _Section) -> Typesdict:
    is_idl = section.encoding == "ros2idl"
    text = _plain_idl(section.text) if is_idl else _MSG_NOISE.sub("", section.text + "\n")
    statements = text.count(";" if is_idl else "\n")
    if statements > MAX_STATEMENTS:
        raise _UnusableError(f"its definition of {name} has {statements} statements, too many")
    try:
        if is_idl:
            return get_types_from_idl(text)
        # Names without a package are of messages, also in services and actions.
        message = _KIND.sub("/msg/", name)
        parsed = get_types_from_msg(text, message)
        return {name: parsed[message]} if message != name else parsed
    # The parser raises its own error, or whatever Python does with what it took for a number.
    except Exception as error:
        reason = f"its definition of {name} cannot be parsed: {_brief(error)}"
        raise _UnusableError(reason) from error


@contextmanager
def _run_by_rosbags() -> Iterator[None]:
    """Translates errors of rosbags, which turns definitions into Python code and runs it."""
    try:
        yield
    # Errors of that code have no common base.
    except Exception as error:
        raise _UnusableError(f"its definition cannot be used: {_brief(error)}") from error


def _plain_idl(text: str) -> str:
    """Returns IDL without comments and annotations.

    Raises:
        _UnusableError: the parser would take too long. rosbags parses an expression 128 times for
            each parenthesis around it, and a sequence twice for each sequence around it; message
            definitions need neither.
    """
    kept: list[str] = []
    depth = 0  # of parentheses, inside the arguments of an annotation
    for piece in _IDL_PIECE.findall(text):
        if piece.startswith(("//", "/*")):
            kept.append(" ")
        elif depth or piece[0] == "@":
            if piece[-1] == "(":
                depth += 1
            elif piece == ")":
                depth -= 1
        elif piece == "(":
            raise _UnusableError(
                "its IDL contains an expression in parentheses, which is not supported"
            )
        else:
            kept.append(piece)
    plain = _IDL_DIRECTIVE.sub("", "".join(kept))
    if "<<" in plain or _IDL_NESTED_SEQUENCE.search(plain):
        raise _UnusableError(
            "its IDL contains a shift or a sequence of sequences, which is not supported"
        )
    return plain


def definition_of(definitions: Typesdict, root: str) -> Definition:
    """Returns a type and its nested types as the port of bag readers describes them.

    Args:
        definitions: of the type and of its nested types; no type contains itself.
        root: the name of the type.
    """

    @cache
    def defined(name: str) -> Definition:
        shapes = [(field_name, *_shape(field)) for field_name, field in definitions[name][1]]
        return Definition(
            name,
            tuple(
                Field(field_name, defined(kind) if "/" in kind else kind, length)
                for field_name, kind, length in shapes
            ),
            tuple(
                (constant, value)
                for constant, _, value in definitions[name][0]
                if type(value) is int  # a boolean names no number
            ),
        )

    return defined(root)


def _shape(field: FieldDesc) -> tuple[str, int | None]:
    """Returns the type of a field or of its elements, and its length as of a `Field`.

    Names of messages have a slash; names of primitive types have none.
    """
    length: int | None = None
    if field[0] == Nodetype.ARRAY or field[0] == Nodetype.SEQUENCE:
        length = field[1][1] if field[0] == Nodetype.ARRAY else SEQUENCE
        field = field[1][0]
    return str(field[1][0] if field[0] == Nodetype.BASE else field[1]), length


def _unsigned(field: FieldDesc) -> FieldDesc:
    """Returns a field with `uint8` in place of `byte`, which rosbags would decode as int8."""
    if _shape(field)[0] != "byte":
        return field
    byte: BaseDesc = (Nodetype.BASE, ("uint8", 0))
    if field[0] == Nodetype.ARRAY:
        return (Nodetype.ARRAY, (byte, field[1][1]))
    return (Nodetype.SEQUENCE, (byte, field[1][1])) if field[0] == Nodetype.SEQUENCE else byte


def _definitions_below(folder: Path) -> Iterator[tuple[str, str]]:
    """Yields (type name, text) of every `<package>/msg/<Name>.msg` below the folder.

    And of the feedback of every `<package>/action/<Name>.action`.
    """
    if not folder.is_dir():
        raise ConfigError(
            f"reader.custom_msg_paths: {folder} is not a folder; give a folder of packages, or one"
            " package, with msg/*.msg in it"
        )
    try:
        files = [
            file
            for kind in ("msg", "action")
            for file in sorted(directories.files_below(folder.resolve(), f".{kind}"))
            if file.parent.name == kind
        ]
        if not files:
            raise ConfigError(
                f"reader.custom_msg_paths: {folder} holds no msg/*.msg or action/*.action file"
            )
        folders = {file.parent.parent for file in files}
        packages = {package: _package_name(package) for package in folders}
        for file in files:
            text = file.read_text(encoding="utf-8-sig", errors="replace")
            package = packages[file.parent.parent]
            if file.suffix == ".msg":
                yield f"{package}/msg/{file.stem}", text
                continue
            parts = _SERVICE.split(text)
            if len(parts) < _ACTION_PARTS:
                raise ConfigError(
                    f"reader.custom_msg_paths: {file} is not an action definition: goal, result and"
                    " feedback need a line between them that is '---' alone; correct or remove it"
                )
            yield from _feedback_of(f"{package}/action/{file.stem}", parts[2])
    except OSError as error:
        raise ConfigError(f"reader.custom_msg_paths: {folder} cannot be read: {error}") from error


def _feedback_of(action: str, text: str) -> Iterator[tuple[str, str]]:
    """Yields the names and texts of an action's feedback, and of the message that has it."""
    fields = _MSG_NOISE.sub("", text + "\n").strip()
    yield f"{action}_Feedback", fields or "uint8 structure_needs_at_least_one_member"
    message = f"unique_identifier_msgs/UUID goal_id\n{action}_Feedback feedback\n"
    yield f"{action}_FeedbackMessage", message


def _package_name(package: Path) -> str:
    """Returns the name in package.xml, else the folder's."""
    manifest = package / "package.xml"
    if manifest.is_file():
        text = manifest.read_text(encoding="utf-8", errors="replace")
        named = re.search(r"<name>\s*([A-Za-z][A-Za-z0-9_]*)\s*</name>", text)
        if named:
            return named[1]
    return package.name


def _brief(error: Exception) -> str:
    """Returns an error as one short line; its text may contain the whole definition."""
    words = " ".join(f"{error}".split()) or "no reason given"
    return f"{type(error).__name__}: {words[:160]}"
