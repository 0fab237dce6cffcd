"""Values derived from an object, which live as long as the object."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, TypeVar, cast

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


class Key(Generic[T]):
    """Names one value of a `Memo`, and says its type."""


class Memo:
    """Values by key, each made on demand. Thread-safe: if two threads make one, the first stays."""

    def __init__(self) -> None:
        self._values: dict[Key[object], object] = {}

    def of(self, key: Key[T], make: Callable[[], T]) -> T:
        """Returns the value of a key; makes it at the first call."""
        name = cast("Key[object]", key)
        if name not in self._values:
            return cast("T", self._values.setdefault(name, make()))
        return cast("T", self._values[name])
