"""A question about several moments at once: each is answered as if it were asked alone."""

from __future__ import annotations

from dataclasses import replace
from functools import wraps
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

from ros2_memory.core.errors import NoDataError
from ros2_memory.history.view import AtTime, ns_argument
from ros2_memory.results import AtEach, MomentAnswer, NothingAt

if TYPE_CHECKING:
    from collections.abc import Callable

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Call, Memory, SnapshotSource
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.retention.foreign import Foreign

P = ParamSpec("P")
A = TypeVar("A", bound=MomentAnswer)


def at_each(
    query: Callable[Concatenate[Memory, Call, P], A],
) -> Callable[Concatenate[Memory, Call, P], A | AtEach]:
    """Returns a query that answers `moment.each` one by one, all from one snapshot of the index.

    Where there is nothing at one of the moments, `NothingAt` takes its place. Where there is
    nothing at any, for one and the same reason, that is raised as for a single moment.
    """

    @wraps(query)
    def answer(memory: Memory, call: Call, /, *args: P.args, **given: P.kwargs) -> A | AtEach:
        moment = given["moment"]
        if not isinstance(moment, AtTime) or not moment.each:
            return query(memory, call, *args, **given)
        reach = max(ns_argument("timestamps", one.end_s) for one in moment.each)
        index = OneSnapshot(memory.index, memory.index.snapshot(reach))
        fixed = replace(memory, index=index)
        answers: list[MomentAnswer | NothingAt] = []
        failures: list[NoDataError] = []
        for one in moment.each:
            given["moment"] = one
            try:
                answers.append(query(fixed, call, *args, **given))
            except NoDataError as error:
                at = ns_argument("timestamps", one.at_s or 0.0)
                answers.append(NothingAt(at, error.reason, error.detail, notes=error.notes))
                failures.append(error)
        if len(failures) == len(answers) and len({each.detail for each in failures}) == 1:
            raise failures[0]
        return AtEach(tuple(answers))

    return answer


class OneSnapshot:
    """An index that stays as it was: several answers are then of one and the same memory."""

    def __init__(self, index: SnapshotSource, snapshot: Snapshot) -> None:
        self.bag_dir = index.bag_dir
        self.published: Snapshot | None = snapshot
        self._index = index
        self._snapshot = snapshot

    def snapshot(self, reach: Ns | None = None) -> Snapshot:  # noqa: ARG002 - of the protocol
        """Returns the one."""
        return self._snapshot

    def refresh(self) -> Snapshot:
        """Returns the one, too."""
        return self._snapshot

    def heartbeat(self) -> Heartbeat | None:
        """Returns that of the index; so does the next."""
        return self._index.heartbeat()

    def foreign(self, snapshot: Snapshot) -> Foreign | None:
        """As above."""
        return self._index.foreign(snapshot)
