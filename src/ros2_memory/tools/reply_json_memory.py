"""Replies about the memory itself as JSON: its time range, its status, saved moments."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory import results
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import Ns, iso_local, unix_rounded_up
from ros2_memory.retention.policy import GB
from ros2_memory.tools.reply_json import LocalTimes, moment, render, seconds, with_notes

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.clock_steps import ClockStep
    from ros2_memory.analysis.silences import Silence
    from ros2_memory.bag_dir.moment_file import SaveRequest, StoredMoment
    from ros2_memory.core.model import JsonValue, SetAside
    from ros2_memory.tools.reply_size import JsonObject

_MAX_LISTED: Final = 20
_MAX_TOPICS: Final = 10
_S_PER_DAY: Final = 86_400
_LARGE_PARTS: Final = 10
_SMALL_BYTES: Final = GB // 10
"""Smaller sizes are given to the kilobyte."""


def time_range(answer: results.DataTimeRange, bag_dir: Path) -> JsonObject:
    """Returns what `data_time_range` replies; files are named relative to the bag directory."""
    notes = list(answer.notes)
    local = LocalTimes(answer.earliest, answer.now)
    gaps: list[JsonValue] = [
        {
            "start": unix_rounded_up(gap.start),
            "end": unix_rounded_up(gap.end),
            "duration_s": seconds(gap.end - gap.start),
            **({"deleted_s": seconds(gap.deleted)} if gap.deleted else {}),
            **local.of(gap.start, gap.end),
        }
        for gap in answer.gaps
    ]
    lists: dict[str, list[JsonValue]] = {
        "gaps": gaps,
        "silences": [_silence(each, local) for each in answer.silences],
        "clock_steps": [_clock_step(each, local) for each in answer.clock_steps],
        "active": _files(answer.active, bag_dir),
        "damaged": _files(answer.damaged, bag_dir),
        "incomplete": _files(answer.incomplete, bag_dir),
        "unread": _files(answer.unread, bag_dir),
        "clock_faults": _files(answer.clock_faults, bag_dir),
        "undecodable": [
            {"topic": each.topic, "type": each.type, "reason": each.reason}
            for each in answer.undecodable
        ],
    }
    reply: JsonObject = {
        "earliest": moment(answer.earliest),
        "latest": moment(answer.latest),
        "earliest_local": _local(answer.earliest),
        "latest_local": _local(answer.latest),
        "now": moment(answer.now),
        "now_local": _local(answer.now),
        "bags": answer.bags,
    }
    for name, rows in lists.items():
        reply[name] = rows[-_MAX_LISTED:]
        if len(rows) > _MAX_LISTED:
            notes.append(f"{name}: the last {_MAX_LISTED} of {len(rows)} are listed")
            reply[f"{name}_count"] = len(rows)
    reply["silent_topics"] = answer.silent_topics
    return with_notes(reply, notes)


def _silence(silence: Silence, local: LocalTimes) -> JsonObject:
    """Returns a silence; `silent_s` is how long the robot was on in it."""
    return {
        "topic": silence.topic,
        "start": unix_rounded_up(silence.start),
        "end": None if silence.goes_on else unix_rounded_up(silence.end),
        "silent_s": seconds(silence.length),
        **local.of(silence.start, None if silence.goes_on else silence.end),
    }


def _clock_step(step: ClockStep, local: LocalTimes) -> JsonObject:
    """Returns a step of the clock; `step_s` is negative where it was set back."""
    return {"at": unix_rounded_up(step.at), "step_s": seconds(step.by), **local.of(step.at)}


def _local(at: Ns | None) -> str | None:
    return None if at is None else iso_local(at)


def _files(files: Sequence[SetAside], bag_dir: Path) -> list[JsonValue]:
    return [{"file": file_name(file.path, bag_dir), "reason": file.reason} for file in files]


def file_name(path: Path | str, bag_dir: Path) -> str:
    """Returns a bag's path below the bag directory; never an absolute path of the machine."""
    bag = Path(path)
    return str(bag.relative_to(bag_dir)) if bag.is_relative_to(bag_dir) else bag.name


def _doubts(answer: results.Status) -> Iterator[str]:
    """Yields in short why answers may be missing something, or be wrong."""
    yield from answer.problems
    topics = {each.topic for each in answer.silences}
    if len(answer.silences) == 1:
        one = answer.silences[0]
        still = ", and still is" if one.goes_on else ""
        yield f"{one.topic} was silent for {seconds(one.length):.0f} s{still}"
    elif topics:
        named = next(iter(topics)) if len(topics) == 1 else counted(len(topics), "topic")
        yield f"{named} fell silent {len(answer.silences)} times (see silences)"
    if len(answer.clock_steps) == 1:
        [(_, by)] = answer.clock_steps
        how = f"{seconds(by):.3g} s ahead" if by > 0 else f"back by {seconds(-by):.3g} s or more"
        yield f"the clock was set {how}"
    elif answer.clock_steps:
        yield f"the clock was set {len(answer.clock_steps)} times (see clock_steps)"


@render.register(results.Status)
def _status(answer: results.Status) -> JsonObject:
    latest, heard = answer.latest, answer.heard
    local = LocalTimes(answer.earliest, answer.now)
    lists: dict[str, list[JsonValue]] = {
        "fell_silent": [
            {
                "topic": each.topic,
                "last_ts": moment(each.last),
                "ago_s": seconds(answer.now - each.last),
                **local.of(each.last),
            }
            for each in answer.fell_silent
        ],
        "silences": [_silence(each, local) for each in reversed(answer.silences)],
        "clock_steps": [_clock_step(each, local) for each in reversed(answer.clock_steps)],
        "never_heard": [*answer.never_heard],
        "missing": [*answer.missing],
    }
    is_ours = answer.recorder != results.ANOTHER and bool(answer.recorder or answer.budget.most)
    reply: JsonObject = {
        "trust": "; ".join(_doubts(answer)) or "nothing is known to be missing",
        "recorder": answer.recorder,
        "recorder_alive": answer.live if is_ours else None,
        "restarts": answer.restarts,
        **({"lost_last_hour": dict(answer.lost)} if answer.lost else {}),
        "now": moment(answer.now),
        "earliest": moment(answer.earliest),
        "latest": moment(latest),
        **local.of(answer.earliest, latest),
        "newest_age_s": None if heard is None else max(seconds(answer.now - heard), 0.0),
        **{name: topics[:_MAX_TOPICS] for name, topics in lists.items()},
        "damaged": answer.damaged,
        "incomplete": answer.incomplete,
        "unread": answer.unread,
        "budget": _budget(answer.budget),
        **_newest_moments(answer.moments),
        **{
            f"{name}_count": len(topics)
            for name, topics in lists.items()
            if len(topics) > _MAX_TOPICS
        },
    }
    return with_notes(reply, answer.notes)


def _newest_moments(newest: results.MomentList | None) -> JsonObject:
    """Returns the moments of a status, and how many there are where not all are listed."""
    if newest is None:
        return {}
    reply: JsonObject = {"moments": _stored_moments(newest)["moments"]}
    if newest.more:
        reply["moments_count"] = len(newest.moments) + newest.more
    return {**reply, **_fired_rules(newest)}


def _budget(budget: results.Budget) -> JsonObject:
    """Returns gigabytes, and for how many days they last; older bags are deleted then.

    `state_gb` is the size of all but recordings, if that is a large part of the budget.
    `foreign_gb` is the size of bags that the recorder did not make; the others exclude it.
    """
    most, per_day = budget.most, budget.per_day
    reply: JsonObject = {
        "used_gb": _gigabytes(budget.used),
        "max_gb": _gigabytes(most),
        **({"state_gb": _gigabytes(budget.state)} if _is_large(budget) else {}),
        "foreign_gb": _gigabytes(budget.foreign),
        "growth_gb_per_day": _gigabytes(per_day),
    }
    if most is not None and per_day:
        reply["full_in_days"] = round(max(most - budget.used, 0) / per_day, 2)
        lasting = most / per_day
        allowed = lasting if budget.max_age is None else seconds(budget.max_age) / _S_PER_DAY
        reply["keeps_days"] = round(min(lasting, allowed), 2)
    return reply


def _is_large(budget: results.Budget) -> bool:
    return budget.most is not None and _LARGE_PARTS * budget.state > budget.most


def _gigabytes(size: float | None) -> float | None:
    return None if size is None else round(size / GB, 3 if size >= _SMALL_BYTES else 6)


@render.register(results.RememberedMoment)
def _saved_moment(answer: results.RememberedMoment) -> JsonObject:
    return {
        **_labelled_window(answer.moment, answer),
        "bags": answer.bags,
        "pending": answer.pending,
    }


@render.register(results.MomentList)
def _stored_moments(answer: results.MomentList) -> JsonObject:
    begun = (each.moment.request.start for each in answer.moments)
    local = LocalTimes(min(begun, default=None), answer.now)
    reply: JsonObject = {"moments": [_stored(each, answer.now, local) for each in answer.moments]}
    if answer.more:
        reply["more"] = answer.more
    return {**reply, **_fired_rules(answer)}


def _fired_rules(answer: results.MomentList) -> JsonObject:
    """Returns what rules did, where there are any; without a time where one never fired."""
    rows: list[JsonValue] = []
    for each in answer.rules[:_MAX_LISTED]:
        row: JsonObject = {"rule": each.name, "fired": each.fired, "moments": each.moments}
        if each.last is not None:
            row |= {"last_ts": moment(each.last), "last_ago_s": seconds(answer.now - each.last)}
        if each.refused:
            row["refused"] = each.refused
        if each.always_since is not None:
            row["matches_since"] = moment(each.always_since)
        if each.problem is not None:
            row["problem"] = each.problem
        rows.append(row)
    if len(answer.rules) > len(rows):
        return {"rules": rows, "rules_count": len(answer.rules)}
    return {"rules": rows} if rows else {}


@render.register(results.ShownMoment)
def _shown_moment(answer: results.ShownMoment) -> JsonObject:
    begun = answer.stored.moment.request.start
    return _stored(answer.stored, answer.now, LocalTimes(begun, answer.now))


def _stored(stored: StoredMoment, now: Ns, local: LocalTimes) -> JsonObject:
    saved = stored.moment
    reply: JsonObject = {
        **_labelled_window(stored.folder.name, saved.request),
        **local.of(saved.request.start, saved.request.end),
        "ago_s": seconds(now - saved.request.end),
        "bags": len(stored.files),
        "size_gb": round(sum(stored.files.values()) / GB, 6),
        "complete": not (saved.pending or saved.missing),
    }
    if saved.rule is not None:
        reply |= {"rule": saved.rule, "matches": saved.matches}
    return with_notes(reply, saved.missing, pending=saved.pending)


def _labelled_window(name: str, saved: results.RememberedMoment | SaveRequest) -> JsonObject:
    return {
        "moment": name,
        "label": saved.label,
        "start": moment(saved.start),
        "end": moment(saved.end),
    }
