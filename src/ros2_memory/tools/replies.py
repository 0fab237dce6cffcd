"""Answers and errors as the JSON text that is sent: with their kind, and never too long.

Nearly every answer is rendered by its declaration alone (`core/reply.py`, `results/`). Here is what
looks at the reply as a whole: rows that repeat each other, lists that are shortened until it fits.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
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
from ros2_memory.core.reply import (
    JsonObject,
    Keys,
    LocalTimes,
    Scope,
    file_name,
    render,
    shown,
    with_notes,
)
from ros2_memory.core.text import quoted_keys
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, unix_rounded_up
from ros2_memory.results.things import SHORT_THING, compared, listed_things, thing
from ros2_memory.tools.reply_size import HEADERS, QUOTED, fit_reply, largest, to_json_text

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ros2_memory.core.model import JsonValue

_LONGEST_LAST_ROW_CHARS: Final = 200
"""Characters of the row that sums up those left out, whatever its numbers."""
ROBOT_NAME: Final = "robot_name"
"""The key of the robot that an answer or a row is of, in a fleet; `robot` is where one was."""
_OF_ALL: Final = ("topic", "type", "frame_id", "parent", "child", "clock")
"""Keys that a reply about several moments has once, where they have the same value at each."""
_OF_WINDOW: Final = ("start", "end", "local", "at", "now")
"""Keys of a reply that the row of its window has, or has not."""
_SUMMED: Final = (
    "total",
    "at_least",
    "entries",
    "exits",
    "minutes",
    "visits",
    "distance_m",
    "duration_s",
    "stood_s",
    "inside_s",
    "unknown_s",
)
"""Numbers of the replies for several windows that are added up."""
_COMPARISONS: Final = tuple(compared(most) for most in range(5, 0, -1))
_THINGS: Final = tuple(listed_things(thing(most_stays)) for most_stays in (8, 5, 3, 2))
_SHORT_THINGS: Final = listed_things(SHORT_THING)
_HOW: Final = "in short form; ask with one to four labels for their scores, states and moves"
_LONGEST: Final = 6_000
"""Characters of a reply about things; its lists are cut until it is no longer."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What a client receives: one text, and whether it is an error for the protocol."""

    text: str
    is_error: bool = False


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
            # "Never", which is null, becomes an object whose values are null.
            whole = value if isinstance(value, dict) else {"timestamp": None, "value": None}
            value = {ROBOT_NAME: name, **whole}
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


def as_json(answer: results.OneAnswer, bag_dir: Path) -> JsonValue:
    """Returns an answer as a JSON value of any size; files are named relative to `bag_dir`."""
    reply: JsonValue = None
    match answer:
        case tuple():
            reply = [shown(row, Scope()) for row in answer]
        case results.Match(found=None, notes=()):
            pass
        case results.AtEach():
            reply = _at_each(answer, bag_dir)
        case results.InEach():
            reply = _in_each(answer, bag_dir)
        case results.Comparison():
            reply = _shortest(answer, bag_dir, _COMPARISONS)
        case results.Things():
            reply = _things(answer, bag_dir)
        case _:
            reply = render(answer, bag_dir)
    return reply


def _at_each(answer: results.AtEach, bag_dir: Path) -> JsonObject:
    """Returns one row for each moment; what all rows share is above them, and is not repeated."""
    rendered = [render(at_moment, bag_dir) for at_moment in answer.answers]
    shared, rows, common = _joined(rendered, lambda key, _: key in _OF_ALL)
    explained: set[JsonValue] = set()
    for row in rows:
        if "error" in row:
            if row["reason"] in explained:
                del row["detail"]
            explained.add(row["reason"])
    return with_notes({**shared, "results": [*rows]}, common)


def _in_each(answer: results.InEach, bag_dir: Path) -> JsonObject:
    """Returns one row for each window, and what all have together."""
    replies = [as_json(window.answer, bag_dir) for window in answer.windows]
    bodies = [reply for reply in replies if isinstance(reply, dict)]
    shared, parts, common = _joined(
        bodies, lambda key, value: isinstance(value, str) or key in HEADERS
    )
    rows: list[JsonValue] = []
    for window, part in zip(answer.windows, parts, strict=True):
        row: JsonObject = {
            "local": LocalTimes(MIN_NS, MAX_NS).text(window.start, window.stop),
            "start": unix_rounded_up(window.start),
            "end": unix_rounded_up(window.stop),
        }
        rows.append(row | {key: item for key, item in part.items() if key not in _OF_WINDOW})
    whole = _added_up([body for body in bodies if "error" not in body], is_all=answer.is_all)
    total: JsonObject = {"all": whole} if whole else {}
    return with_notes({**total, **shared, "windows": rows}, [*answer.notes, *common])


def _joined(
    replies: Sequence[JsonObject], may_be_shared: Callable[[str, JsonValue], bool]
) -> tuple[JsonObject, list[JsonObject], list[str]]:
    """Returns what all replies with an answer share, the rest of each, and the notes of several."""
    answered = [reply for reply in replies if "error" not in reply]
    shared: JsonObject = {
        key: value
        for key, value in (answered[0] if answered else {}).items()
        if may_be_shared(key, value) and all(reply.get(key) == value for reply in answered)
    }
    occurrences = Counter(note for reply in replies for note in dict.fromkeys(_notes_in(reply)))
    common = [note for note, times in occurrences.items() if times > 1]
    rows = [
        with_notes(
            {key: value for key, value in reply.items() if key not in shared and key != "notes"},
            [note for note in _notes_in(reply) if note not in common],
        )
        for reply in replies
    ]
    return shared, rows, common


def _added_up(replies: Sequence[JsonObject], *, is_all: bool) -> JsonObject:
    """Returns the sums over replies; `at_least` so many where one of them has no total.

    And where they are not all that was asked for.
    """
    if not is_all or any("at_least" in reply for reply in replies):
        replies = [{"at_least": reply.get("total"), **reply, "total": None} for reply in replies]
    sums: JsonObject = {}
    for key in _SUMMED:
        values = [reply.get(key) for reply in replies]
        numbers = [value for value in values if isinstance(value, int | float)]
        if numbers:
            sums[key] = round(sum(numbers), 3)
    return sums


def _notes_in(reply: JsonObject) -> list[str]:
    notes = reply.get("notes")
    return [note for note in notes if isinstance(note, str)] if isinstance(notes, list) else []


def _shortest(
    answer: results.Comparison | results.Things, bag_dir: Path, forms: tuple[Keys, ...]
) -> JsonObject:
    """Returns an answer by the first keys that leave it short, else by the last."""
    reply: JsonObject = {}
    for form in forms:
        reply = render(answer, bag_dir, form)
        if _is_short(reply):
            break
    return reply


def _is_short(reply: JsonObject) -> bool:
    return len(to_json_text(reply)) <= _LONGEST


def _things(answer: results.Things, bag_dir: Path) -> JsonObject:
    """Returns the things, each with as many of its newest places as leave the reply short.

    Where that is not enough, what each is and where it was last, and only the things seen last.
    """
    reply = _shortest(answer, bag_dir, _THINGS)
    if not answer.things or _is_short(reply):
        return reply

    def first(count: int) -> JsonObject:
        things = answer.things[:count]
        # A row of several at once is so many things.
        listed = sum(thing.at_once or 1 for thing in things)
        how_many = "all" if listed == answer.total else f"{listed} of {answer.total}"
        note = f"{how_many} things are listed, {_HOW}"
        few = replace(answer, things=things, notes=(note, *answer.notes))
        return render(few, bag_dir, _SHORT_THINGS)

    return first(largest(1, len(answer.things), lambda count: _is_short(first(count))) or 1)
