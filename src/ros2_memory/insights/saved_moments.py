"""Saved moments: asks the recorder to save one, and lists them. The recorder alone writes them."""

from __future__ import annotations

import time
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.bag_dir.layout import MOMENTS_FOLDER, TRIGGERS_FILE
from ros2_memory.bag_dir.moment_file import (
    Outcome,
    PendingRequest,
    StoredMoments,
    stored_moments_in,
)
from ros2_memory.bag_dir.state_files import TRIGGERS
from ros2_memory.core.errors import InvalidArgumentsError, RefusedError
from ros2_memory.core.text import abbreviate, counted, listed
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Deadline, Ns, ns_from_unix
from ros2_memory.history.view import View
from ros2_memory.results import FiredRule, MomentList, RememberedMoment, ShownMoment

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.history.context import Call, Memory

ANSWER_TIMEOUT_S: Final = 5.0
"""The recorder looks for requests once a second, and may be deleting bags."""
MAX_LISTED: Final = 20
_POLL_S: Final = 0.05
_ENDED: Final = frozenset({RecorderState.STOPPING, RecorderState.STOPPED})


def remember_moment(
    memory: Memory, call: Call, label: str, *, seconds_before: float, seconds_after: float
) -> RememberedMoment:
    """Asks the recorder to save the recording around now.

    Raises:
        RefusedError: nothing records here, or the recorder does not save it.
        QueryTimeoutError: there is no time to wait for the recorder.
    """
    now = _now(memory, call)
    _require_recorder(memory)
    start, end = now - ns_from_unix(seconds_before), now + ns_from_unix(seconds_after)
    asked = memory.clock.now()
    request = PendingRequest(
        memory.bag_dir, label, max(start, MIN_NS + 1), min(end, MAX_NS - 1), asked
    )
    try:
        request.post()
    except OSError as error:
        raise RefusedError(
            f"the recorder cannot be asked: {error.strerror or error}; this server must be allowed "
            "to write into .episodic/requests of the bag directory (as a service that was started "
            "before the recorder made that: restart it)"
        ) from error
    try:
        outcome = _await_outcome(request, call)
    finally:
        request.withdraw()
        request.close()
    if outcome is None:
        raise RefusedError(
            f"the recorder did not answer within {ANSWER_TIMEOUT_S:g} s; memory_status shows "
            "whether it keeps the moment anyway; if not, ask again"
        )
    if outcome.moment is None:
        raise RefusedError(outcome.refused or "the recorder gave no reason")
    return RememberedMoment(outcome.moment, label, start, end, outcome.bags, outcome.pending)


def list_moments(memory: Memory, call: Call) -> MomentList:
    """Returns the saved moments, newest first.

    Raises:
        RefusedError: the moments cannot be read.
    """
    return newest_moments(memory, _now(memory, call), MAX_LISTED)


def show_moment(memory: Memory, call: Call, name: str) -> ShownMoment:
    """Returns a saved moment by the name of its folder.

    Raises:
        InvalidArgumentsError: there is no moment of this name.
        RefusedError: the moments, or this one, cannot be read.
    """
    with _refuse_unreadable():
        moments, unreadable = _moments_of(memory)
    if name in unreadable:
        raise RefusedError(f"its moment.json cannot be read: {unreadable[name].problem}")
    if name not in moments:
        near = get_close_matches(name, moments, n=3, cutoff=0.3)
        hint = f"do you mean {' or '.join(near)}?" if near else f"{len(moments)} moments are saved"
        raise InvalidArgumentsError(f"there is no moment {abbreviate(name)}; {hint}")
    return ShownMoment(moments[name], _now(memory, call))


def newest_moments(memory: Memory, now: Ns, at_most: int) -> MomentList:
    """Returns the newest saved moments, newest first. `now` (ns) is what "ago" counts from.

    Raises:
        RefusedError: the moments cannot be read.
    """
    with _refuse_unreadable():
        moments, unreadable = _moments_of(memory)
    with _refuse_unreadable(TRIGGERS_FILE):
        rules = fired_rules(memory.bag_dir)
    newest = sorted(
        moments.values(),
        key=lambda saved: (saved.moment.request.end, saved.folder.name),
        reverse=True,
    )
    notes = []
    if unreadable:
        problems = listed([*dict.fromkeys(moment.problem for moment in unreadable.values())])
        notes.append(
            f"{counted(len(unreadable), 'folder')} in {MOMENTS_FOLDER}/ without a readable "
            f"moment.json: {listed([*unreadable])} ({problems})"
        )
    return MomentList(tuple(newest[:at_most]), len(newest[at_most:]), now, rules, tuple(notes))


@contextmanager
def _refuse_unreadable(name: str = f"{MOMENTS_FOLDER}/") -> Iterator[None]:
    """Raises `RefusedError`, which names a path in the bag directory, in place of an `OSError`."""
    try:
        yield
    except OSError as error:
        raise RefusedError(
            f"the moments cannot be listed: {error.strerror or error}; this server must be allowed "
            f"to read {name} of the bag directory"
        ) from error


def _moments_of(memory: Memory) -> StoredMoments:
    """Returns the saved moments; if one recording alone answers, the moments with bags of it."""
    recording, bag_dir = memory.limits.recording, memory.bag_dir
    stored = stored_moments_in(bag_dir)
    if not recording:
        return stored

    def has_bags(name: str) -> bool:
        moment = Path(MOMENTS_FOLDER, name)
        return Path(recording).is_relative_to(moment) or (bag_dir / moment / recording).is_dir()

    return StoredMoments(
        {name: moment for name, moment in stored.readable.items() if has_bags(name)},
        {name: moment for name, moment in stored.unreadable.items() if has_bags(name)},
    )


def fired_rules(bag_dir: Path) -> tuple[FiredRule, ...]:
    """Returns what the recorder's rules did so far, by name; nothing if the file is damaged.

    Raises:
        OSError: the file is there and cannot be read.
    """
    try:
        state = TRIGGERS.read(bag_dir)
    except ValueError:
        return ()  # the recorder reports that, and starts again
    if state is None:
        return ()
    unread = next(iter(state.unread.values()), None)
    return tuple(FiredRule(name, rule, unread) for name, rule in sorted(state.rules.items()))


def _now(memory: Memory, call: Call) -> Ns:
    """Returns the time (ns) that "ago" counts from."""
    wall = memory.clock.now()
    latest = None
    if memory.limits.now == "latest":
        latest = View(memory, call, wall).snapshot.latest
    return memory.now(latest, call)


def _require_recorder(memory: Memory) -> None:
    """Checks that a recorder runs that would read a request.

    Raises:
        RefusedError: nothing records here, or not just now.
    """
    if memory.limits.kept is None:
        raise RefusedError(
            "nothing is recorded here (recorder=none), and nothing deleted: copy the bags, or ask "
            "the server of the robot that records"
        )
    heartbeat = memory.index.heartbeat()
    if heartbeat is None or not heartbeat.is_live(memory.clock.now()) or heartbeat.state in _ENDED:
        raise RefusedError(
            "only the recorder saves moments, and it is not running: start ros2-memory-recorder, "
            "then ask again"
        )


def _await_outcome(request: PendingRequest, call: Call) -> Outcome | None:
    """Returns the recorder's answer; None if it has not begun in time, and never will."""
    # A request that cannot be withdrawn has been begun: wait for the answer once more.
    for _ in range(2):
        timeout = Deadline.after(ANSWER_TIMEOUT_S)
        while not timeout.expired() and not call.deadline.expired():
            outcome = request.outcome()
            if outcome is not None:
                return outcome
            time.sleep(_POLL_S)
        if request.withdraw():
            return None
    return request.outcome()
