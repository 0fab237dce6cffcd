"""`.episodic/triggers.json`: how far the rules of `recording.keep_when` know the recordings.

The recorder writes it after each look at closed splits: until when each recording was searched,
which matches go on, and how often each rule fired. The query server reads how often. A recorder
that was killed goes on from here, so what it had found since is found again.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

from pydantic import Field, StrictBool, TypeAdapter

from ros2_memory.bag_dir.durable_write import read_small_file, write_durably
from ros2_memory.bag_dir.json_fields import Count, Int64, json_object, validated
from ros2_memory.bag_dir.layout import OWN_FOLDER, TRIGGERS_FILE

if TYPE_CHECKING:
    from pathlib import Path

FORMAT: Final = 1
_READABLE: Final = 0o644  # the two programs may run as different users

_Number: TypeAlias = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]


@dataclass(slots=True)
class RunRecord:
    """A match that goes on: the log times of its first and its newest message.

    `fired`: the rule has fired for it. `lasts`: a silence of the topic does not end it.
    """

    first: Int64
    last: Int64
    fired: StrictBool = False
    lasts: StrictBool = False


@dataclass(slots=True)
class RuleMoment:
    """A moment of a rule, which its next match may extend; log times, inclusive.

    `matches` is how often the rule fired in it. `known`: it was stored before, perhaps shorter;
    `stored`: it is stored as it is here.
    """

    number: _Number
    start: Int64
    end: Int64
    matches: Count = 1
    known: StrictBool = False
    stored: StrictBool = False


@dataclass(slots=True)
class RuleRecord:
    """The state of one rule.

    Attributes:
        fired: how often it fired.
        moments: how many moments that made.
        refused: how often nothing was kept of it.
        last_fired: log time at which it fired last.
        problem: why it may have missed something, or keeps nothing; None where nothing is wrong.
        always_since: since when it has matched without an end, where that is long; else None.
        begun: log times at which its moments of the last hour began.
        newest: its moments that are not stored yet, and the newest one, in order.
        runs: its matches that go on, by topic.
    """

    fired: Count = 0
    moments: Count = 0
    refused: Count = 0
    last_fired: Int64 | None = None
    problem: str | None = None
    always_since: Int64 | None = None
    begun: list[Int64] = field(default_factory=list)
    newest: list[RuleMoment] = field(default_factory=list)
    runs: dict[str, RunRecord] = field(default_factory=dict)


@dataclass(slots=True)
class LatchedMark:
    """How far a latched topic is known: each recording receives its messages again.

    By recording, `published` is the latest publish time and `begun` the first log time; `payload`
    is a hash of the last message.
    """

    published: dict[str, Int64] = field(default_factory=dict)
    begun: dict[str, Int64] = field(default_factory=dict)
    payload: str = ""


@dataclass(slots=True)
class TriggerState:
    """All that the rules know.

    Attributes:
        rules: by name; those that are not configured any more are dropped.
        searched: until which log time (excluded) the newest recordings were searched.
        before: a recording; it and all that were listed before it were searched, or lie before the
            rules. None if there is none.
        latched: by topic.
    """

    rules: dict[str, RuleRecord] = field(default_factory=dict)
    searched: dict[str, Int64] = field(default_factory=dict)
    before: str | None = None
    latched: dict[str, LatchedMark] = field(default_factory=dict)


_STATE: Final = TypeAdapter(TriggerState)


def read_trigger_state(bag_dir: Path) -> TriggerState | None:
    """Returns the state; None if there is none yet.

    Raises:
        OSError: it cannot be read.
        ValueError: it is damaged, or of another format.
    """
    try:
        text = read_small_file(bag_dir / TRIGGERS_FILE)
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        return validated(_STATE, json_object(text, FORMAT))
    except RecursionError as error:
        raise ValueError("it is nothing but brackets") from error


def write_trigger_state(bag_dir: Path, state: TriggerState) -> None:
    """Replaces the state atomically and flushes it.

    Raises:
        OSError: it cannot be written; the old one remains.
    """
    (bag_dir / OWN_FOLDER).mkdir(exist_ok=True)
    content = {"format": FORMAT, **asdict(state)}
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
    write_durably(bag_dir / TRIGGERS_FILE, text, mode=_READABLE)
