"""Mutations of message definitions: those that lead back to themselves, and enormous ones."""

from random import Random

from ros2_memory.core.timebase import NS_PER_S
from tests.fuzz.content import db3_with
from tests.fuzz.good import BASE_S, Good
from tests.fuzz.mutant import Mutant, mutant_of
from tests.fuzz.records import channel, header, message, schema, without_summary
from tests.support.bags import Msg

_BASE = BASE_S * NS_PER_S
_BAR = "=" * 80
_WIDTHS = (2, 10, 1000, 10**6, 10**9, 10**18)


def cyclic_definition(rng: Random, good: Good) -> Mutant:
    """A type that contains itself, at once or on the way round."""
    length = rng.choice((1, 2, 3, 10, 50))
    array = rng.choice(("", "[]", "[1]", "[<=3]"))
    names = [f"pkg/msg/T{n}" for n in range(length)]
    parts = [
        f"{names[(n + 1) % length]}{array} next\nfloat64 x\n"
        if n
        else f"{names[1 % length]}{array} next\nstd_msgs/Header header\n"
        for n in range(length)
    ]
    text = parts[0] + "".join(
        f"{_BAR}\nMSG: {name}\n{part}" for name, part in zip(names[1:], parts[1:], strict=True)
    )
    if rng.random() < 0.3:
        text += f"{_BAR}\nMSG: {names[0]}\n{parts[0]}"
    return _defined(rng, good, names[0], text)


def gigantic_definition(rng: Random, good: Good) -> Mutant:
    """A definition that is long, deep, wide, or unrolls into more than there is."""
    many = rng.choice((100, 2_000, 20_000))
    if rng.random() < 0.2:
        opened = "(" * min(many, 200)
        text = f"module pkg {{ struct T0 {{ int8 x[{opened}1{')' * len(opened)}]; }}; }};"
        return _defined(rng, good, "pkg/msg/T0", text, "ros2idl")
    return _defined(rng, good, "pkg/msg/T0", rng.choice(_GIGANTIC)(rng, many))


def _long(_rng: Random, many: int) -> str:
    return "".join(f"float64 field_{n}\n" for n in range(many))


def _wide(rng: Random, many: int) -> str:
    width = rng.choice(_WIDTHS)
    return rng.choice(
        (
            f"string[{width}] names\n",
            f"float64[{width}] numbers\n",
            f"string<={width} s\nint8[<={width}] n\nstring TEXT={'x' * many}\n",
        )
    )


def _deep(_rng: Random, many: int) -> str:
    parts = [f"{_BAR}\nMSG: pkg/msg/T{n}\nT{n + 1} next\n" for n in range(1, many)]
    return f"T1 next\n{''.join(parts)}{_BAR}\nMSG: pkg/msg/T{many}\nint8 x\n"


def _branching(rng: Random, _many: int) -> str:
    deep = rng.choice((10, 30, 60))
    parts = [f"{_BAR}\nMSG: pkg/msg/T{n}\nT{n + 1} a\nT{n + 1} b\n" for n in range(1, deep)]
    leaf = rng.choice(("int8 x\n", ""))
    return f"T1 a\nT1 b\n{''.join(parts)}{_BAR}\nMSG: pkg/msg/T{deep}\n{leaf}"


def _wordy(rng: Random, many: int) -> str:
    return rng.choice(
        (
            "\n".join("#" * 200 for _ in range(many)) + "\nint8 x\n",
            "int8 " + "x" * many + "\n",
            f"{_BAR}\n" * many + f"MSG: pkg/msg/T1\nint8 x\n{'---' * many}\n",
            "".join(rng.choice("[]<=#\n MSG:int8\t/\"'()@{};") for _ in range(many)),
        )
    )


_GIGANTIC = (
    _long,
    _wide,
    _deep,
    _branching,
    _wordy,
)


def _defined(rng: Random, good: Good, name: str, text: str, encoding: str = "ros2msg") -> Mutant:
    """A bag with messages of a type of this definition."""
    payload = rng.choice((b"\0\1\0\0" + bytes(64), bytes(4), b"\0\1\0\0" + b"\xff" * 200))
    content = [header(), schema(1, name, encoding, text.encode()), channel(1, 1, "/odom")]
    content += [message(1, _BASE + n * NS_PER_S // 10, payload) for n in range(5)]
    if good.is_mcap:
        data = without_summary(content)
        return mutant_of(good, data, f"{len(text)} characters")
    messages = [Msg("/odom", name, _BASE + n, payload) for n in range(5)]
    return db3_with(good, messages, {name: text})
