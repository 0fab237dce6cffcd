"""Globs over topic names: `*`, `?` and `[...]`, in which a slash is a character like any other."""

from __future__ import annotations

import re
from fnmatch import translate
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


def match_topics(names: Iterable[str], glob: str) -> list[str]:
    """The names that a glob matches, in their order; upper and lower case differ.

    `fnmatch` matches likewise, but keeps the last 32,768 globs: what clients may send without end
    would fill memory.
    """
    matches = re.compile(translate(glob)).match
    return [name for name in names if matches(name)]
