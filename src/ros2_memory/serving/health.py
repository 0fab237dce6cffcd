"""What `/health` says, and the task that keeps the index fresh while nobody asks.

It stays small whatever is amiss: of many things the newest few are named, and all are counted.
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final

import anyio
import anyio.to_thread

from ros2_memory.core.errors import BusyError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import Ns, unix_from_ns, unix_rounded_up
from ros2_memory.history.notes import short_name
from ros2_memory.insights.status import clock_faults, left_open, problems_of
from ros2_memory.serving.fair_queue import FairQueue

if TYPE_CHECKING:
    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.history.context import Memory
    from ros2_memory.serving.backfill import Backfill
    from ros2_memory.tools.reply_size import JsonObject

PATIENCE_S: Final = 2.0
"""How long the index may take to answer; the first scan of a large directory takes longer."""
NAMED: Final = 3
"""Files of each kind that does not answer, and topics that cannot be decoded, that are named."""

_MOST_TOPICS: Final = 20
_MOST_MISSING: Final = 6
_MOST_CHARS: Final = 300

log = get_logger(__name__)


async def keep_fresh(memory: Memory, every_s: float) -> None:
    """Looks through the bag directory every `every_s` seconds, until it is cancelled."""
    while True:
        try:
            await anyio.to_thread.run_sync(memory.index.refresh, abandon_on_cancel=True)
        except Exception:
            log.exception("index_refresh_failed")
        await anyio.sleep(every_s)


class Health:
    """Says how a server is, to whoever asks; for one event loop.

    One look is under way at a time, also where nobody waits for it any more: a disk that hangs
    must not cost a thread with every question.
    """

    def __init__(
        self,
        memory: Memory,
        version: str,
        filler: Backfill | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._look = partial(_health, memory, version, filler)
        self._version = version
        self._patience_s = patience_s
        self._lane = FairQueue("health", 1)

    def stop(self) -> None:
        """Lets its thread go."""
        self._lane.stop()

    async def __call__(self) -> JsonObject:
        """How it is: `ok`, or `degraded` with the reasons in `problems`.

        An empty memory is no problem, and neither are a topic that cannot be decoded, a bag that a
        crash left open, or one that a wrong clock dated; they are counted. Times are Unix seconds.
        """
        with anyio.move_on_after(self._patience_s), suppress(BusyError):
            return await self._lane.run(None, self._look)
        return _status(self._version, ["the bag directory is being looked through"], {})


def _health(memory: Memory, version: str, filler: Backfill | None) -> JsonObject:
    now = memory.clock.now()
    snapshot = memory.index.snapshot()
    heartbeat = memory.heartbeat()
    dating = snapshot.dating
    amiss = {
        "damaged": snapshot.damaged,
        "incomplete": left_open(snapshot),
        "unread": snapshot.unread,
        "clock_faults": clock_faults(snapshot),
    }
    shown: JsonObject = {
        "bags": len(snapshot.bags),
        "earliest": None if dating.earliest is None else unix_rounded_up(dating.earliest),
        "latest": None if dating.latest is None else unix_rounded_up(dating.latest),
        "active": len(snapshot.active),
        **{what: len(files) for what, files in amiss.items()},
        "index_age_s": _seconds(now - snapshot.scanned_at),
    }
    foreign = memory.foreign(snapshot)
    if foreign is not None:
        shown["foreign_bytes"] = foreign.total_bytes
    problems = [_short(each) for each in problems_of(snapshot, heartbeat, now)]
    for what, files in amiss.items():
        if files:
            shown[f"{what.removesuffix('s')}_files"] = [
                {"file": _short(short_name(each.path)), "reason": _short(each.reason)}
                for each in files[-NAMED:]
            ]
    if filler is not None:
        shown |= _of_catalogue(filler)
        if filler.trouble is not None:
            problems.append(_short(f"the catalogue {filler.trouble}; no answer depends on it"))
    if heartbeat is not None:
        shown["recorder"] = _of_recorder(heartbeat, now)
    return _status(version, problems, shown)


def _of_catalogue(filler: Backfill) -> JsonObject:
    progress, undecodable = filler.progress(), filler.undecodable
    shown: JsonObject = {
        "catalogue": {
            "bags": progress.closed - progress.waiting - progress.refused,
            "waiting": progress.waiting,
            "refused": progress.refused,
            "state": _state(filler, progress.waiting),
        }
    }
    if undecodable:
        shown["undecodable"] = {
            "topics": len(undecodable),
            "reasons": {
                _short(topic): _short(reason) for topic, reason in [*undecodable.items()][:NAMED]
            },
        }
    return shown


def _state(filler: Backfill, waiting: int) -> str:
    """`ready`, `filling`, or `failing` where it is not what it should be."""
    if filler.trouble is not None:
        return "failing"
    return "filling" if waiting else "ready"


def _of_recorder(heartbeat: Heartbeat, now: Ns) -> JsonObject:
    error = heartbeat.last_error
    shown: JsonObject = {
        "state": str(heartbeat.state),
        "live": heartbeat.is_live(now),
        "heartbeat_age_s": _seconds(now - heartbeat.updated),
        "restarts": heartbeat.restarts,
        "last_error": None if error is None else _short(error),
        "age_held": None if heartbeat.age_held is None else _short(heartbeat.age_held),
    }
    for kind, topics, most in (
        ("silent", heartbeat.silent, _MOST_TOPICS),
        ("missing", heartbeat.missing, _MOST_MISSING),
    ):
        shown[f"{kind}_topics"] = [_short(topic) for topic in topics[:most]]
        if len(topics) > most:
            shown[f"more_{kind}_topics"] = len(topics) - most
    return shown


def _status(version: str, problems: list[str], shown: JsonObject) -> JsonObject:
    if problems:
        return {"status": "degraded", "problems": [*problems], "version": version, **shown}
    return {"status": "ok", "version": version, **shown}


def _short(text: str) -> str:
    return text if len(text) <= _MOST_CHARS else f"{text[: _MOST_CHARS - 3]}..."


def _seconds(duration: Ns) -> float:
    return round(unix_from_ns(duration), 3)
