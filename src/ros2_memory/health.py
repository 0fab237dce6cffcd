"""What `/health` says, and the task that keeps the index fresh while nobody asks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import anyio
import anyio.to_thread

from ros2_memory.logs import get_logger
from ros2_memory.recorder.heartbeat import RecorderState
from ros2_memory.timebase import Ns, unix_from_ns, unix_rounded_up

if TYPE_CHECKING:
    from ros2_memory.filling import Filler
    from ros2_memory.fitting import JsonObject
    from ros2_memory.memory import Memory
    from ros2_memory.recorder.heartbeat import Heartbeat
    from ros2_memory.recorder.index_manager import Snapshot

PATIENCE_S: Final = 2.0
"""How long the index may take to answer; the first scan of a large directory takes longer."""

log = get_logger(__name__)


async def keep_fresh(memory: Memory, every_s: float) -> None:
    """Looks through the bag directory every `every_s` seconds, until it is cancelled."""
    while True:
        try:
            await anyio.to_thread.run_sync(memory.index.refresh, abandon_on_cancel=True)
        except Exception:
            log.exception("index_refresh_failed")
        await anyio.sleep(every_s)


async def health(
    memory: Memory,
    version: str,
    filler: Filler | None = None,
    patience_s: float = PATIENCE_S,
) -> JsonObject:
    """How the server is: `ok`, or `degraded` with the reasons in `problems`.

    An empty memory is no problem. Times are Unix seconds.
    """
    with anyio.move_on_after(patience_s):
        return await anyio.to_thread.run_sync(
            _health, memory, version, filler, abandon_on_cancel=True
        )
    return _status(version, ["the bag directory is being looked through"], {})


def _health(memory: Memory, version: str, filler: Filler | None) -> JsonObject:
    now = memory.clock.now()
    snapshot = memory.index.snapshot()
    heartbeat = memory.index.heartbeat()
    shown: JsonObject = {
        "bags": len(snapshot.bags),
        "earliest": None if snapshot.earliest is None else unix_rounded_up(snapshot.earliest),
        "latest": None if snapshot.latest is None else unix_rounded_up(snapshot.latest),
        "active": len(snapshot.active),
        "damaged": len(snapshot.damaged),
        "index_age_s": _seconds(now - snapshot.scanned_at),
    }
    if filler is not None:
        progress = filler.progress()
        shown["catalogue"] = {
            "bags": progress.closed - progress.waiting - progress.refused,
            "waiting": progress.waiting,
            "refused": progress.refused,
        }
    if heartbeat is not None:
        shown["recorder"] = {
            "state": str(heartbeat.state),
            "live": heartbeat.is_live(now),
            "heartbeat_age_s": _seconds(now - heartbeat.updated),
            "silent_topics": [*heartbeat.silent],
            "last_error": heartbeat.last_error,
        }
    return _status(version, _problems(snapshot, heartbeat, now), shown)


def _status(version: str, problems: list[str], shown: JsonObject) -> JsonObject:
    if problems:
        return {"status": "degraded", "problems": [*problems], "version": version, **shown}
    return {"status": "ok", "version": version, **shown}


def _problems(snapshot: Snapshot, heartbeat: Heartbeat | None, now: Ns) -> list[str]:
    problems = [snapshot.problem] if snapshot.problem else []
    if snapshot.damaged:
        problems.append(f"{len(snapshot.damaged)} damaged bag files; data_time_range lists them")
    if heartbeat is None or heartbeat.state is RecorderState.STOPPED:
        return problems
    if not heartbeat.is_live(now):
        problems.append("the recorder has stopped without saying so")
    elif heartbeat.state is RecorderState.PAUSED:
        problems.append(f"the recorder is paused: {heartbeat.last_error or 'it does not say why'}")
    return problems


def _seconds(duration: Ns) -> float:
    return round(unix_from_ns(duration), 3)
