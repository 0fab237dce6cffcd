"""Answers and errors as the JSON text that is sent: with their kind, and never too long.

Nearly every answer is rendered by its declaration alone (`core/reply.py`, `results/`). This module
looks at replies as a whole: it leaves out what rows repeat, and shortens lists until a reply fits.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
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
    LocalTimes,
    file_name,
    render,
    shown,
    with_notes,
)
from ros2_memory.core.text import quoted_keys
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, unix_rounded_up
from ros2_memory.results.things import SHORT_THING, compared, listed_things, thing
from ros2_memory.tools.reply_size import (
    HEADERS,
    QUOTED,
    add_notes,
    fit_reply,
    largest,
    notes_in,
    to_json_text,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ros2_memory.core.model import JsonValue

ROBOT_NAME: Final = "robot_name"
"""The key of the name of a fleet's robot in a reply or a row; `robot` is the place of one."""
_OF_ALL: Final = ("topic", "type", "frame_id", "parent", "child", "clock")
"""Keys that a reply about several moments has once, if their value is the same at each."""
_OF_WINDOW: Final = ("start", "end", "local", "at", "now")
"""Keys of a reply that are left out of the row of its window, which has bounds of its own."""
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
"""Numbers that are added up over the replies for several windows."""
_COMPARISONS: Final = tuple(compared(most) for most in range(5, 0, -1))
_THINGS: Final = tuple(listed_things(thing(most_stays)) for most_stays in (8, 5, 3, 2))
_SHORT_THINGS: Final = listed_things(SHORT_THING)
_SHORT_FORM: Final = "in short form; ask with one to four labels for their scores, states and moves"
_LONGEST: Final = 6_000
"""Characters of a reply about things; its lists are cut until it is short enough."""


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

        A reply that is an object shows what is passed beside the answer:

        Args:
            answer: of the query.
            from_active: whether messages of a split that is still being written were read.
            from_memory: whether messages of thinned days were read, which have a pose a second.
            now: what its ages count from (ns); None for the wall clock.
        """
        if isinstance(answer, results.OfRobot):
            if isinstance(answer.answer, tuple):
                return Reply(self._topic_list(answer.answer, {ROBOT_NAME: answer.name}))
            value: JsonValue = _of_robot(answer)
            now = answer.now
        elif isinstance(answer, results.OfFleet):
            value = answer.value
        elif isinstance(answer, tuple):
            return Reply(self._topic_list(answer, {}))
        else:
            value = as_json(answer, self.bag_dir)
        if not isinstance(value, dict):
            return Reply(to_json_text(value))
        if from_active:
            value = {**value, "from_active": True}
        if from_memory:
            value = {**value, "from": "memory", "resolution_s": 1}
        if now is not None:
            value = {"now": unix_rounded_up(now), **value}
        return self._fit(value)

    def _fit(self, value: JsonObject, *, is_error: bool = False) -> Reply:
        """Returns a reply that says first, and in full, where it repeats texts of messages."""
        quoted = quoted_keys(value)
        marked: JsonObject = {QUOTED: [*quoted], **value} if quoted else value
        return Reply(fit_reply(marked, self.max_chars), is_error)

    def _topic_list(self, rows: tuple[results.TopicRow, ...], robot: JsonObject) -> str:
        """Returns the topics as a list; `robot` are keys of each row.

        If the list would be too long, the busiest topics come first, and the last row sums up the
        others: their first and last time and all their messages.
        """
        text = to_json_text([robot | shown(row) for row in rows])
        if len(text) <= self.max_chars:
            return text
        busiest = sorted(rows, key=lambda row: -row.count)

        def text_of(most: int) -> str:
            rest = busiest[most:]
            last = results.TopicRow(
                f"({len(rest)} more: use pattern)",
                "",
                min(row.first for row in rest),
                max(row.last for row in rest),
                sum(row.count for row in rest),
            )
            return to_json_text([robot | shown(row) for row in (*busiest[:most], last)])

        fit = largest(0, len(rows) - 1, lambda most: len(text_of(most)) <= self.max_chars)
        return text_of(fit or 0)

    def error(self, error: EpisodicError) -> Reply:
        """Returns the reply for an error. Having no data is an answer; the others are errors."""
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
        return self._fit(with_notes(reply, notes))

    def _failure(self, code: str, detail: str, **more: JsonValue) -> Reply:
        reply: JsonObject = {"error": code, **more, "detail": detail}
        return self._fit(reply, is_error=True)


def _of_robot(answer: results.OfRobot) -> JsonObject:
    """Returns the answer of a fleet's robot, with its name."""
    body = as_json(answer.answer, answer.bag_dir)
    if not isinstance(body, dict):  # null, which means "never"
        body = {"timestamp": None, "value": None}
    return add_notes({ROBOT_NAME: answer.name, **body}, answer.notes)


def as_json(answer: results.OneAnswer, bag_dir: Path) -> JsonValue:
    """Returns an answer as a JSON value of any size; files are named relative to `bag_dir`."""
    match answer:
        case tuple():
            return [shown(row) for row in answer]
        case results.Match(found=None, notes=()):
            return None
        case results.AtEach():
            return _at_each(answer, bag_dir)
        case results.InEach():
            return _in_each(answer, bag_dir)
        case results.Comparison() | results.Things():
            return _shortened(answer, bag_dir)
        case _:
            return render(answer, bag_dir)


def _at_each(answer: results.AtEach, bag_dir: Path) -> JsonObject:
    """Returns one row for each moment; keys that all rows share are above them."""
    replies = [render(at_moment, bag_dir) for at_moment in answer.answers]
    shared, rows, common_notes = _split_shared(replies, lambda key, _: key in _OF_ALL)
    explained: set[JsonValue] = set()
    for row in rows:
        if "error" in row:
            if row["reason"] in explained:
                del row["detail"]
            explained.add(row["reason"])
    return with_notes({**shared, "results": [*rows]}, common_notes)


def _in_each(answer: results.InEach, bag_dir: Path) -> JsonObject:
    """Returns one row for each window, keys that all rows share, and sums over the windows."""
    replies = [as_json(window.answer, bag_dir) for window in answer.windows]
    bodies = [reply for reply in replies if isinstance(reply, dict)]
    shared, parts, common_notes = _split_shared(
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
    sums = _sums([body for body in bodies if "error" not in body], is_all=answer.is_all)
    total: JsonObject = {"all": sums} if sums else {}
    return with_notes({**total, **shared, "windows": rows}, [*answer.notes, *common_notes])


def _split_shared(
    replies: Sequence[JsonObject], may_be_shared: Callable[[str, JsonValue], bool]
) -> tuple[JsonObject, list[JsonObject], list[str]]:
    """Splits replies into what they repeat and what each has alone.

    Returns:
        The keys that all replies with an answer share, the rest of each reply, and the notes that
        several of them have.
    """
    answered = [reply for reply in replies if "error" not in reply]
    shared: JsonObject = {
        key: value
        for key, value in (answered[0] if answered else {}).items()
        if may_be_shared(key, value) and all(reply.get(key) == value for reply in answered)
    }
    occurrences = Counter(note for reply in replies for note in dict.fromkeys(notes_in(reply)))
    common_notes = [note for note, times in occurrences.items() if times > 1]
    rows = [
        with_notes(
            {key: value for key, value in reply.items() if key not in shared and key != "notes"},
            [note for note in notes_in(reply) if note not in common_notes],
        )
        for reply in replies
    ]
    return shared, rows, common_notes


def _sums(replies: Sequence[JsonObject], *, is_all: bool) -> JsonObject:
    """Returns the sums of `_SUMMED` over replies.

    The total is `at_least` so much unless all windows were asked about, and each has a total.
    """
    is_total = is_all and not any("at_least" in reply for reply in replies)
    sums: JsonObject = {}
    for key in _SUMMED:
        if key == "total" and not is_total:
            continue
        values = [reply.get(key) for reply in replies]
        if key == "at_least" and not is_total:
            values = [reply.get("at_least", reply.get("total")) for reply in replies]
        numbers = [value for value in values if isinstance(value, int | float)]
        if numbers:
            sums[key] = round(sum(numbers), 3)
    return sums


def _shortened(answer: results.Comparison | results.Things, bag_dir: Path) -> JsonObject:
    """Returns a comparison or things in the fullest form that leaves the reply short."""
    reply: JsonObject = {}
    for form in _COMPARISONS if isinstance(answer, results.Comparison) else _THINGS:
        reply = render(answer, bag_dir, form)
        if _is_short(reply):
            return reply
    if isinstance(answer, results.Comparison) or not answer.things:
        return reply
    few = largest(1, len(answer.things), lambda few: _is_short(_short_things(answer, bag_dir, few)))
    return _short_things(answer, bag_dir, few or 1)


def _is_short(reply: JsonObject) -> bool:
    return len(to_json_text(reply)) <= _LONGEST


def _short_things(answer: results.Things, bag_dir: Path, most: int) -> JsonObject:
    """Returns what each of the things seen last is and where it was last."""
    things = answer.things[:most]
    # A row may stand for several things at once.
    listed = sum(thing.at_once or 1 for thing in things)
    how_many = "all" if listed == answer.total else f"{listed} of {answer.total}"
    note = f"{how_many} things are listed, {_SHORT_FORM}"
    few = replace(answer, things=things, notes=(note, *answer.notes))
    return render(few, bag_dir, _SHORT_THINGS)
