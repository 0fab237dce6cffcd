"""What a mutation makes: files to lay beside good bags, and what then happens to them."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import TypeAlias

from tests.fuzz.good import Good

FOLDER = "mutant"
LONG_AGO_S = 1_784_030_000
"""When mutants were last written, as far as their mtime tells: nobody is writing them."""


@dataclass(frozen=True)
class Trap:
    """Something that happens to the mutant's bag while it is being read.

    `at` is how often it was opened or read from before that.
    """

    at: int
    spring: Callable[[Path], None]


@dataclass
class Mutant:
    """Files by their place below a folder of their own; `bag` is the name of the one that counts.

    `lay` makes what is more than files; `expected` are how many bag files lie there.
    """

    bag: str
    files: dict[str, bytes] = field(default_factory=dict)
    lay: Callable[[Path], None] | None = None
    trap: Trap | None = None
    told: str = ""

    def place(self, bag_dir: Path, number: int) -> Path:
        """Lays it into a bag directory; the path of its bag. No other has this number."""
        # At one place it would be a file that changes, and so one that is being written.
        folder = bag_dir / f"{FOLDER}_{number}"
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in self.files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data)
        # What it was made of is not what the program needs.
        self.files.clear()
        if self.lay is not None:
            self.lay(folder)
        # Another time for each, or the store would take it for the one before.
        for path in [*folder.rglob("*"), folder]:
            when = LONG_AGO_S + number
            os.utime(path, (when, when), follow_symlinks=False)
        return folder / self.bag


Mutation: TypeAlias = "Callable[[Random, Good], Mutant]"


def mutant_of(good: Good, data: bytes, told: str = "") -> Mutant:
    """A mutant that is one file: this content, as the good bag's kind packs it."""
    name = f"bag_0{good.suffix}"
    return Mutant(name, {name: good.packed(data)}, told=told)


def mutant_file(good: Good, data: bytes, told: str = "") -> Mutant:
    """A mutant that is one file of exactly these bytes."""
    name = f"bag_0{good.suffix}"
    return Mutant(name, {name: data}, told=told)
