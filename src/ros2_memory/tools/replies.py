"""Answers and errors as the JSON text that is sent: with their kind, and never too long."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING, Final

from ros2_memory import results
from ros2_memory.core.errors import (
    BagError,
    EpisodicError,
    NoDataError,
    NoDataReason,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.reply import JsonObject, Scope, file_name, shown, with_notes
from ros2_memory.core.text import quoted_keys
from ros2_memory.core.timebase import Ns, unix_rounded_up
from ros2_memory.tools.reply_json import ROBOT_NAME, as_json
from ros2_memory.tools.reply_size import QUOTED, fit_reply, to_json_text

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.model import JsonValue

_LONGEST_LAST_ROW_CHARS: Final = 200
"""Characters of the row that sums up those left out, whatever its numbers."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What a client receives: one text, and whether it is an error for the protocol."""

    text: str
    is_error: bool = False


def named(robot_name: str, value: JsonValue) -> JsonObject:
    """Returns the JSON value of an answer with the name of its robot.

    That is first in an object; "never", which is null, becomes an object whose values are null.
    """
    whole = value if isinstance(value, dict) else {"timestamp": None, "value": None}
    return {ROBOT_NAME: robot_name, **whole}


@dataclass(frozen=True, slots=True)
class Replies:
    """Renders answers and errors. File names are shown relative to `bag_dir`, never absolute."""

    bag_dir: Path
    max_chars: int

    def answer(
        self,
        answer: results.Answer,
        *,
        from_active: bool = False,
        from_memory: bool = False,
        now: Ns | None = None,
    ) -> Reply:
        """Returns an answer in the shape that the tool's description promises.

        `from_active`: whether messages of a split that is still being written were read, which a
        reply that is an object shows. `from_memory`: likewise, days of which only some messages
        stayed, a pose for each second. `now`: what its ages count from, where that is not the wall
        clock (`data.now=latest`).
        """
        name: str | None = None
        notes: tuple[str, ...] = ()
        if isinstance(answer, results.OfRobot):
            name, bag_dir, notes, now = answer.name, answer.bag_dir, answer.notes, answer.now
            answer = answer.answer
        else:
            bag_dir = self.bag_dir
        if isinstance(answer, tuple):
            return Reply(self._topics(answer, {} if name is None else {ROBOT_NAME: name}))
        value = answer.value if isinstance(answer, results.OfFleet) else as_json(answer, bag_dir)
        if name is not None:
            value = named(name, value)
        if not isinstance(value, dict):
            return Reply(to_json_text(value))
        if notes:
            stated = value.get("notes")
            value = {**value, "notes": [*(stated if isinstance(stated, list) else ()), *notes]}
        if from_active:
            value = {**value, "from_active": True}
        if from_memory:
            value = {**value, "from": "memory", "resolution_s": 1}
        if now is not None:
            value = {"now": unix_rounded_up(now), **value}
        return self._fitted(value)

    def _fitted(self, value: JsonObject, *, is_error: bool = False) -> Reply:
        """Returns a reply that says first, and in full, where it repeats texts of messages."""
        quoted = quoted_keys(value)
        marked: JsonObject = {QUOTED: [*quoted], **value} if quoted else value
        return Reply(fit_reply(marked, self.max_chars), is_error)

    def _topics(self, rows: tuple[results.TopicRow, ...], name: JsonObject) -> str:
        """Returns the list of topics, each row with the name of the robot, if there is one.

        It is always a list of rows. Where it would be too long, the busiest topics come first, and
        the last row sums up those left out: their first and last time and all their messages.
        """

        def named_row(row: results.TopicRow) -> JsonObject:
            return name | shown(row, Scope())

        text = to_json_text([named_row(row) for row in rows])
        if len(text) <= self.max_chars:
            return text
        busiest = sorted(rows, key=lambda row: -row.count)
        fitting = self.max_chars - _LONGEST_LAST_ROW_CHARS - len(to_json_text(name))
        sizes = accumulate(len(to_json_text(named_row(row))) + 1 for row in busiest)
        kept = sum(size <= fitting for size in sizes)
        rest = busiest[kept:]
        others = results.TopicRow(
            f"({len(rest)} more: use pattern)",
            "",
            min(row.first for row in rest),
            max(row.last for row in rest),
            sum(row.count for row in rest),
        )
        return to_json_text([named_row(row) for row in (*busiest[:kept], others)])

    def error(self, error: EpisodicError) -> Reply:
        """Returns an error of the tree. Having no data is an answer; the others are errors."""
        match error:
            case NoDataError():
                return self._no_data(error.reason, error.detail, error.notes)
            case UndecodableError():
                return self._no_data(NoDataReason.UNDECODABLE, str(error))
            case QueryTimeoutError(searched_back_to=int(back_to)):
                return self._failure(
                    error.code, str(error), searched_back_to=unix_rounded_up(back_to)
                )
            case BagError():
                name = file_name(error.path, self.bag_dir)
                return self._failure(error.code, f"{name}: {error.reason}; ask again")
            case _:
                return self._failure(error.code, str(error))

    def internal(self, correlation_id: str) -> Reply:
        """Returns the error of a fault of this program, with the id that finds its log event."""
        return self._failure(
            "internal",
            "the question failed through a fault in this server, not in the arguments; "
            f"its log has the cause under correlation_id {correlation_id}",
        )

    def _no_data(self, reason: NoDataReason, detail: str, notes: tuple[str, ...] = ()) -> Reply:
        reply: JsonObject = {"error": NoDataError.code, "reason": reason.value, "detail": detail}
        return self._fitted(with_notes(reply, notes))

    def _failure(self, code: str, detail: str, **more: JsonValue) -> Reply:
        reply: JsonObject = {"error": code, **more, "detail": detail}
        return self._fitted(reply, is_error=True)
