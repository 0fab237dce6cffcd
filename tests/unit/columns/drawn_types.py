"""Message types and messages of them, drawn by hypothesis, in the texts that bags hold."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from hypothesis import strategies as st
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

NUMBERS: Final = frozenset(
    (
        *("bool", "byte", "char", "int8", "uint8", "int16", "uint16", "int32", "uint32"),
        *("int64", "uint64", "float32", "float64"),
    )
)
TIME: Final = "builtin_interfaces/Time"
DURATION: Final = "builtin_interfaces/Duration"
_IDL: Final = {
    "bool": "boolean",
    "byte": "octet",
    "char": "uint8",
    "float32": "float",
    "float64": "double",
    TIME: "builtin_interfaces::msg::Time",
    DURATION: "builtin_interfaces::msg::Duration",
}
_TIME_TEXT: Final = "int32 sec\nuint32 nanosec\n"


@dataclass(frozen=True)
class DrawnField:
    """`length`: None for one value, a number of a fixed array, -1 of a sequence."""

    name: str
    kind: str
    length: int | None = None


@dataclass(frozen=True)
class DrawnTypes:
    """Types by name, each of those before it and of primitives; the last one is the root."""

    types: tuple[tuple[str, tuple[DrawnField, ...]], ...]

    @property
    def root(self) -> str:
        return f"drawn_msgs/msg/{self.types[-1][0]}"

    def msg(self) -> str:
        """The definition as ros2msg, nested types behind it."""
        parts = [_msg(fields) for _, fields in self.types]
        nested = [
            f"{'=' * 80}\nMSG: drawn_msgs/{name}\n{part}"
            for (name, _), part in zip(self.types[:-1], parts[:-1], strict=True)
        ]
        times = [f"{'=' * 80}\nMSG: {name}\n{_TIME_TEXT}" for name in (TIME, DURATION)]
        return "".join([parts[-1], *nested, *times])

    def idl(self) -> str:
        """The definition as ros2idl."""
        parts = [
            f"{'=' * 80}\nIDL: drawn_msgs/msg/{name}\n"
            f"module drawn_msgs {{ module msg {{ {_idl(name, fields)} }}; }};\n"
            for name, fields in reversed(self.types)
        ]
        parts += [
            f"{'=' * 80}\nIDL: builtin_interfaces/msg/{name}\nmodule builtin_interfaces {{ module "
            f"msg {{ struct {name} {{ int32 sec; uint32 nanosec; }}; }}; }};\n"
            for name in ("Time", "Duration")
        ]
        return "".join(parts)

    def store(self) -> Typestore:
        """A typestore of them; bytes are unsigned, as in ROS, which rosbags has signed."""
        store = Typestore()
        for name in ("Time", "Duration"):
            store.register(get_types_from_msg(_TIME_TEXT, f"builtin_interfaces/msg/{name}"))
        for name, fields in self.types:
            unsigned = [
                replace(each, kind="uint8") if each.kind == "byte" else each for each in fields
            ]
            store.register(get_types_from_msg(_msg(unsigned), f"drawn_msgs/msg/{name}"))
        return store


def _msg(fields: Sequence[DrawnField]) -> str:
    return "".join(f"{each.kind}{_array(each)} {each.name}\n" for each in fields)


def _array(drawn: DrawnField) -> str:
    if drawn.length is None:
        return ""
    return "[]" if drawn.length < 0 else f"[{drawn.length}]"


def _idl(name: str, fields: Sequence[DrawnField]) -> str:
    lines = []
    for each in fields:
        kind = _IDL.get(each.kind, each.kind)
        if each.kind not in {*NUMBERS, "string", TIME, DURATION}:
            kind = f"drawn_msgs::msg::{each.kind}"
        if each.length is not None and each.length < 0:
            lines.append(f"sequence<{kind}> {each.name};")
        elif each.length is not None:
            lines.append(f"{kind} {each.name}[{each.length}];")
        else:
            lines.append(f"{kind} {each.name};")
    if not fields:
        lines.append("uint8 structure_needs_at_least_one_member;")
    return f"struct {name} {{ {' '.join(lines)} }};"


_PRIMITIVES: Final = st.sampled_from([*sorted(NUMBERS), "string", "string", TIME, DURATION])
_LENGTHS: Final = st.one_of(
    st.none(), st.none(), st.just(-1), st.just(-1), st.sampled_from((1, 3, 9, 12, 600))
)


@st.composite
def drawn_types(draw: st.DrawFn) -> DrawnTypes:
    """Up to four types, each of the ones before it; few fields, of every kind."""
    types: list[tuple[str, tuple[DrawnField, ...]]] = []
    count = draw(st.integers(1, 4))
    for nth in range(count):
        nested = [name for name, _ in types]
        kinds = st.one_of(_PRIMITIVES, st.sampled_from(nested)) if nested else _PRIMITIVES
        fields = []
        names = ("from", "data", "length", "x", "y", "z", "stamp")
        for name in names[: draw(st.integers(0 if nth < count - 1 else 1, 6))]:
            kind, length = draw(kinds), draw(_LENGTHS)
            if length is not None and length > 12 and kind not in NUMBERS:
                length = 2
            fields.append(DrawnField(name, kind, length))
        types.append((f"Type{nth}", tuple(fields)))
    return DrawnTypes(tuple(types))
