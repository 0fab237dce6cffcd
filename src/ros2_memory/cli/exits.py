"""What the exit code of each command says: its help and the reference tell it from here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

EXITS: Final[Mapping[str, Mapping[int, str]]] = {
    "ask": {
        0: "there is an answer, also that it was never so (null)",
        1: "there is none: the reply is an error, which says why",
    },
    "topics": {0: "there are some", 1: "nothing is recorded"},
    "info": {0: "it was told", 1: "there is nothing to tell of"},
    "watch": {0: "it was ended, by --count or Ctrl-C, whatever it saw"},
    "doctor": {
        0: "all is in order",
        1: "something wants attention",
        2: "something does not work",
    },
    "export": {
        0: "all of the window was copied",
        1: "what could be read of it was; stderr says what could not",
    },
    "forget": {
        0: "all that lies in the window is deleted (with --dry-run: would be), or there is nothing",
        1: "something in the window stays and is named, or the question was answered with no",
    },
    "adopt": {
        0: "the bags are the recorder's own now, or were before",
        1: "no bag files lie there",
    },
    "demo": {0: "all answers were right", 1: "one was wrong"},
    "index": {0: "every bag was looked into, or was found to be one that cannot be"},
    "recover": {0: "every file is whole", 1: "a file could not be repaired"},
    "config": {0: "it was shown"},
}
"""By command and code. `EVERYWHERE` holds besides."""
EVERYWHERE: Final[Mapping[int, str]] = {
    2: "it could not run, and stderr says why",
    130: "it was interrupted before it was done",
}


def codes(command: str) -> Mapping[int, str]:
    """All that a command may end with."""
    own = EXITS[command]
    return {**own, **{code: why for code, why in EVERYWHERE.items() if code not in own}}


def epilog(command: str) -> str:
    """The last lines of a command's help."""
    return f"Exit code: {'; '.join(f'{code}: {why}' for code, why in codes(command).items())}."
