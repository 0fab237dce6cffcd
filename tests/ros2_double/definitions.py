"""Where the definitions of message types lie: `share/PACKAGE/msg/NAME.msg` below a prefix.

The prefixes are those of AMENT_PREFIX_PATH, as for the real recorder, and the environment that the
wheels were installed into.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Final

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

_SEPARATOR: Final = "\n" + "=" * 80 + "\n"
_ARRAY: Final = re.compile(r"\[.*\]$|<=\d+$")


def package_is_known(package: str) -> bool:
    """Whether an ament index has the package."""
    index = Path("share/ament_index/resource_index/packages")
    return any((prefix / index / package).is_file() for prefix in _prefixes())


def full_text(type_name: str) -> str | None:
    """The type's definition and, behind separators, those of all types in it; None: not found.

    The order is the recorder's: depth first, the types in a definition by name, each once.
    """
    root = _own_text(type_name)
    if root is None:
        return None
    parts = [root]
    for nested in _nested(type_name, {type_name}):
        text = _own_text(nested)
        if text is None:
            return None
        package, _, name = nested.split("/")
        parts.append(f"MSG: {package}/{name}\n{text}")
    return _SEPARATOR.join(parts)


def type_hash(type_name: str) -> str:
    """The type's hash (REP-2016); of zeros where its definition was not found."""
    text = full_text(type_name)
    if text is None:
        return "RIHS01_" + "00" * 32
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, type_name))
    return store.hash_rihs01(type_name)


def _prefixes() -> list[Path]:
    named = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [Path(prefix) for prefix in (*filter(None, named), sys.prefix)]


def _own_text(type_name: str) -> str | None:
    package, _, name = type_name.split("/")
    for prefix in _prefixes():
        file = prefix / "share" / package / "msg" / f"{name}.msg"
        if file.is_file():
            return file.read_text("utf-8")
    return None


def _nested(type_name: str, seen: set[str]) -> list[str]:
    found: list[str] = []
    package = type_name.split("/", maxsplit=1)[0]
    for name in sorted(_types_in(_own_text(type_name) or "", package)):
        if name not in seen:
            seen.add(name)
            found += [name, *_nested(name, seen)]
    return found


def _types_in(text: str, package: str) -> set[str]:
    """The types of the fields that are messages themselves."""
    names: set[str] = set()
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if not words:
            continue
        field = _ARRAY.sub("", words[0])
        if "/" in field:
            names.add(field.replace("/", "/msg/", 1))
        elif field[0].isupper():
            names.add(f"{package}/msg/{field}")
    return names
