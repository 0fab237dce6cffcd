"""What `/health` shows, its client, and the tasks that read the bag directory between queries.

The reply counts all faults and names the newest few, so that it stays small.
"""

from __future__ import annotations

import asyncio
import http
import http.client
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import anyio
import anyio.to_thread

from ros2_memory import package_version
from ros2_memory.core.errors import BusyError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.reply import JsonObject, moment, seconds
from ros2_memory.core.text import encodable, shortened
from ros2_memory.core.timebase import NS_PER_HOUR, Ns
from ros2_memory.history.context import Call, Memory, short_name
from ros2_memory.history.coverage import recording_gaps, unexcluded
from ros2_memory.history.view import View
from ros2_memory.insights.status import clock_faults, left_open, problems_of, unrecorded
from ros2_memory.serving.auth import HEALTH_PATH
from ros2_memory.serving.fair_queue import FairQueue

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.serving.backfill import Backfill

TIMEOUT_S: Final = 2.0
"""How long the index may take; the first scan of a large directory takes longer."""
NAMED: Final = 3
"""How many files of each kind of fault, and how many undecodable topics, are named."""

_MAX_TOPICS: Final = 20
_MAX_MISSING: Final = 6
_MAX_CHARS: Final = 290
_REPLY_WITHIN_S: Final = 5.0
_LONGEST_REPLY: Final = 1 << 20


log = get_logger(__name__)


async def keep_fresh(
    memory: Memory, every_s: float, limiter: anyio.CapacityLimiter | None = None
) -> None:
    """Scans the bag directory every `every_s` seconds, until it is cancelled.

    `limiter` bounds the threads; without it they are those of all background work.
    """
    refresh = partial(refresh_logged, memory)
    while True:
        await anyio.to_thread.run_sync(refresh, abandon_on_cancel=True, limiter=limiter)
        await anyio.sleep(every_s)


def refresh_logged(memory: Memory) -> None:
    """Scans the bag directory, and logs what keeps it from being scanned."""
    try:
        memory.index.refresh()
    except Exception:
        log.exception("index_refresh_failed")


class Health:
    """Reports the state of a server, on one event loop.

    One report is made at a time, even where the request that waited for it has timed out: a disk
    that hangs must not cost a thread with every request.
    """

    def __init__(self, memory: Memory, backfill: Backfill | None = None) -> None:
        self._report = partial(_health_report, memory, backfill)
        self._queue = FairQueue("health", 1)

    def stop(self) -> None:
        """Ends the thread when it is done."""
        self._queue.stop()

    async def __call__(self) -> JsonObject:
        """Returns `ok`, or `degraded` with the reasons in `problems`. Times are Unix seconds.

        Some things are counted and are no problem: topics that cannot be decoded, bags that a crash
        left open, and bags that a wrong clock dated. Neither is an empty memory.
        """
        with anyio.move_on_after(TIMEOUT_S), suppress(BusyError):
            return await self._queue.run(None, self._report)
        return _status(["the bag directory is being scanned"], {})


@dataclass
class FleetHealth:
    """Reports the state of a fleet's server: the robots' states, each by its own `Health`."""

    _robots: Mapping[str, Health]

    def stop(self) -> None:
        """Ends the threads when they are done."""
        for health in self._robots.values():
            health.stop()

    async def __call__(self) -> JsonObject:
        """Returns the report of each robot; `degraded` if one of them is.

        Robots that do not answer in time delay the report by `TIMEOUT_S` in all.
        """
        reports = await asyncio.gather(*(health() for health in self._robots.values()))
        problems: list[str] = []
        robots: JsonObject = {}
        for name, report in zip(self._robots, reports, strict=True):
            robot_problems = report.get("problems")
            if isinstance(robot_problems, list):
                problems += [f"{name}: {problem}" for problem in robot_problems]
            robots[name] = {
                key: value for key, value in report.items() if key not in {"version", "pid"}
            }
        return _status(problems, {"robots": robots})


def _health_report(memory: Memory, backfill: Backfill | None) -> JsonObject:
    """Returns what `/health` shows of one memory."""
    now = memory.clock.now()
    snapshot = memory.snapshot()
    heartbeat = memory.heartbeat()
    dating = snapshot.dating
    faulty = {
        "damaged": snapshot.damaged,
        "incomplete": left_open(snapshot),
        "unread": snapshot.unread,
        "clock_faults": clock_faults(snapshot),
    }
    shown: JsonObject = {
        "bags": len(snapshot.bags),
        "earliest": moment(dating.earliest),
        "latest": moment(dating.latest),
        "active": len(snapshot.active),
        **{fault: len(files) for fault, files in faulty.items()},
        "gaps_last_hour": _gaps_last_hour(memory, now),
        "index_age_s": seconds(now - snapshot.scanned_at),
    }
    foreign = memory.foreign(snapshot)
    if foreign is not None:
        shown["foreign_bytes"] = foreign.total_bytes
    problems = [_short(problem) for problem in problems_of(snapshot, heartbeat, now)]
    for fault, files in faulty.items():
        if files:
            shown[f"{fault.removesuffix('s')}_files"] = [
                {"file": _short(short_name(file.path)), "reason": _short(file.reason)}
                for file in files[-NAMED:]
            ]
    if backfill is not None:
        shown |= _store_state(backfill)
        if backfill.filling is not None and backfill.filling.store.trouble is not None:
            trouble = backfill.filling.store.trouble
            problems.append(_short(f"the store of columns {trouble}; no answer depends on it"))
    if heartbeat is not None:
        shown["recorder"] = _recorder_state(heartbeat, now)
    return _status(problems, shown)


def _gaps_last_hour(memory: Memory, now: Ns) -> JsonObject:
    """Returns how often nothing was recorded in the last hour, and for how long in all."""
    view = View(memory, Call())
    gaps = [*unexcluded(view, recording_gaps(view, TimeWindow(now - NS_PER_HOUR, now)))]
    return {"count": len(gaps), "seconds": seconds(sum(end - start for start, end in gaps))}


def _store_state(backfill: Backfill) -> JsonObject:
    """Returns how many bags are stored as columns, and which topics cannot be decoded."""
    shown: JsonObject = {}
    if backfill.filling is not None:
        progress, store = backfill.progress(), backfill.filling.store
        state = "filling" if progress.waiting else "ready"
        shown["store"] = {
            "bags": progress.stored,
            "waiting": progress.waiting,
            "refused": progress.refused,
            "state": state if store.trouble is None else "failing",
        }
        if store.refusals:
            reason = _short(store.refused_for or "")
            shown["store_refusals"] = {"count": store.refusals, "reason": reason}
    undecodable = backfill.undecodable
    if undecodable:
        shown["undecodable"] = {
            "topics": len(undecodable),
            "reasons": {
                _short(topic): _short(reason) for topic, reason in [*undecodable.items()][:NAMED]
            },
        }
    return shown


def _recorder_state(heartbeat: Heartbeat, now: Ns) -> JsonObject:
    """Returns what the recorder last wrote about itself."""
    shown: JsonObject = {
        "state": str(heartbeat.state),
        "live": heartbeat.is_live(now),
        "heartbeat_age_s": seconds(now - heartbeat.updated),
        "restarts": heartbeat.restarts,
        "last_error": heartbeat.last_error and _short(heartbeat.last_error),
        "last_error_at": moment(heartbeat.last_error_at),
        "recovered": heartbeat.recovered,
        "waiting_for": heartbeat.waiting_for and _short(heartbeat.waiting_for),
        "age_held": heartbeat.age_held and _short(heartbeat.age_held),
        "unshipped": heartbeat.unshipped and _short(heartbeat.unshipped),
        "failing_rules": [_short(rule) for rule in heartbeat.failing_rules],
        "required_missing": [
            _short(missing) for missing in heartbeat.required_missing[:_MAX_MISSING]
        ],
        "degraded": [_short(reason) for reason in unrecorded(heartbeat)],
    }
    for kind, topics, most in (
        ("silent", heartbeat.silent, _MAX_TOPICS),
        ("missing", heartbeat.missing, _MAX_MISSING),
    ):
        shown[f"{kind}_topics"] = [_short(topic) for topic in topics[:most]]
        if len(topics) > most:
            shown[f"more_{kind}_topics"] = len(topics) - most
    return shown


def _status(problems: list[str], shown: JsonObject) -> JsonObject:
    """Returns a report: the status and its problems come before all that is `shown`."""
    status: JsonObject = {"status": "ok"}
    if problems:
        status = {"status": "degraded", "problems": [*problems]}
    return {**status, "version": package_version(), "pid": os.getpid(), **shown}


def _short(text: str) -> str:
    return shortened(encodable(text), _MAX_CHARS)


def read_health(host: str, port: int, token: str) -> tuple[int, JsonObject]:
    """Returns the status and the reply of `/health`; an empty reply if it refuses the token.

    `host` may be that of all interfaces: Linux then connects to the loopback address.

    Raises:
        OSError: nothing answers.
        HTTPException: the reply is not HTTP.
        ValueError: the reply is not a JSON object with a status.
    """
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    connection = http.client.HTTPConnection(host, port, timeout=_REPLY_WITHIN_S)
    try:
        connection.request("GET", HEALTH_PATH, headers=headers)
        response = connection.getresponse()
        if response.status == http.HTTPStatus.UNAUTHORIZED and token:
            return response.status, {}
        reply: JsonValue = json.loads(response.read(_LONGEST_REPLY))
    finally:
        connection.close()
    if not isinstance(reply, dict) or "status" not in reply:
        raise ValueError("it gives no status")
    return response.status, reply
