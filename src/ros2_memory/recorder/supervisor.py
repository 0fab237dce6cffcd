"""Keeps a recording going: begins, rotates, pauses and restarts it, and reports what happens.

The main thread calls `tick` several times a second, which never waits. `policies` and `handover`
decide what to do, `sessions` does it, and this module connects them.
"""

from __future__ import annotations

import os
import time
from dataclasses import KW_ONLY, dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, process_of, write_heartbeat
from ros2_memory.core.errors import EpisodicError, RecorderError
from ros2_memory.core.sd_notify import Watchdog
from ros2_memory.recorder.event_log import EventLog
from ros2_memory.recorder.handover import Step
from ros2_memory.recorder.policies import (
    OWN_TOPICS,
    RESUME_FACTOR,
    SET_BACK_NS,
    Backoff,
    ClockReading,
    SilenceWatch,
    set_back,
)
from ros2_memory.recorder.sessions import Orders, RecordingSessions
from ros2_memory.recorder.shortfall import TopicWatch
from ros2_memory.retention.disk import HomeDisk, device_of, free_bytes

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ros2_memory.bag_dir.state_files import Interruption
    from ros2_memory.core.timebase import Ns
    from ros2_memory.recorder.housekeeping import Housekeeping

HEARTBEAT_S: Final = 5.0
"""How often `recorder.json` is written."""
OBSERVE_S: Final = 0.5
SPACE_S: Final = 1.0
MOMENTS_S: Final = 1.0
"""How often requests to save a moment are looked for: their callers wait for the reply."""
SCREENING_S: Final = 2.0
"""How often closed splits are looked for that may have messages to exclude."""
FAULT_S: Final = 60.0
"""How often the fault of a failing task is reported; every tick tries the task again."""
RETENTION_S: Final = 10.0
"""How often the limits are applied after splits were closed."""
QUIET_RETENTION_S: Final = 60.0
"""How often the limits are applied without closed splits: bags still get older."""
UNSETTLED_S: Final = 60.0
"""How often handovers that could not be settled are tried again; each closed split does so, too."""
LIST_S: Final = 2.0
"""How often the file of topics is read."""
TOPICS_S: Final = 1.0
"""How often topics are looked for that are not recorded as they should be."""


class _Task(NamedTuple):
    """A task of `tick`: what it runs, how often, and whether it needs the bag directory's disk.

    Its name is in the log event `supervision_failed`.
    """

    name: str
    run: Callable[[ClockReading], object]
    every_s: float = 0.0
    needs_disk: bool = False


@dataclass(eq=False, repr=False)
class Supervisor:
    """Keeps one recording going, two during a handover.

    Args:
        free_bytes_of: returns the free bytes on the disk of a directory.
        device: returns the device of a directory.
        keep_alive: tells the service manager's watchdog that the recorder runs. It is called before
            each task, since a slow disk may take seconds for one.

    Attributes:
        stopped: whether `start` was not called yet, or `stop` was.
    """

    orders: Orders
    housekeeper: Housekeeping
    _: KW_ONLY
    monotonic: Callable[[], float] = time.monotonic
    free_bytes_of: Callable[[Path], int] = free_bytes
    device: Callable[[Path], int] = device_of
    keep_alive: Callable[[], None] | None = None

    def __post_init__(self) -> None:
        orders = self.orders
        self._bag_dir = orders.bag_dir
        self._reception = orders.reception
        self._keep_alive = self.keep_alive or Watchdog().keep_alive
        self._disk = HomeDisk(orders.bag_dir, self.device)
        self._events = EventLog(orders.clock)
        self._sessions = RecordingSessions(
            orders, self._announce, self._add_interruption, self._events
        )
        self._topic_watch = TopicWatch(self._sessions)
        self._beat: Heartbeat | None = None
        self._backoff = {"restart": Backoff(), "rotate": Backoff()}
        self._silence = SilenceWatch(orders.split_duration_s, orders.session_duration_s)
        self._watched = ""  # the recording of `_silence`
        self._rotating_for_silence = False
        self._paused = False
        self._room_requested = False
        self._splits_closed = False
        # Since when nothing is recorded, by the wall clock; written down when that is over.
        self._interruptions: dict[Interruption, Ns] = {}
        self.stopped = True
        self._due_s: dict[str, float] = {}
        self._last = self._now()
        self._applied_s = -QUIET_RETENTION_S
        self._tasks = self._make_tasks()

    def _make_tasks(self) -> tuple[_Task, ...]:
        """Returns the tasks in the order in which a tick runs them."""
        housekeeper, background = self.housekeeper, self.orders.background
        return (
            _Task("disk", self._check_disk),
            _Task("look", self._observe, OBSERVE_S),
            _Task("deaths", self._check_exits),
            _Task("space", self._check_space, SPACE_S, needs_disk=True),
            _Task("takeover", self._check_handover),
            _Task("list", self._check_list, LIST_S),
            _Task("rotation", self._check_rotation),
            _Task("restart", self._check_restart, needs_disk=True),
            _Task("topics", self._topic_watch.look, TOPICS_S),
            _Task("interruptions", self._end_interruptions, needs_disk=True),
            _Task("recorded", self._note_recorded),
            _Task("settle", lambda _: self._sessions.recover(), UNSETTLED_S, needs_disk=True),
            _Task("faults", lambda _: self._events.report_faults(background.faults())),
            _Task("house", self._apply_retention, needs_disk=True),
            _Task("moments", lambda _: housekeeper.keep_moments(), MOMENTS_S, needs_disk=True),
            _Task(
                "screen", lambda _: housekeeper.screen(self._names()), SCREENING_S, needs_disk=True
            ),
        )

    @property
    def is_recording(self) -> bool:
        """Whether a child runs, and has reported that it records."""
        current = self._sessions.current
        return current is not None and current.is_recording and current.child.exit_status() is None

    def start(self) -> None:
        """Begins a first recording, unless the recorder runs already or the disk is full.

        Raises:
            RecorderError: the recording cannot start.
        """
        if not self.stopped:
            return
        self._last = now = self._now()
        self._due_s.clear()
        make_bag_dir(self._bag_dir)
        try:
            self._disk.remember()
        except OSError as error:
            raise RecorderError(f"{self._bag_dir}: {error.strerror or error}") from error
        self._check_space(now)
        if not self._paused:
            try:
                self._begin_recording(now)
            except RecorderError:
                self._write_heartbeat(RecorderState.STOPPED)
                raise
        self.stopped = False
        self._write_heartbeat()

    def tick(self) -> None:
        """Runs the tasks that are due. Raises nothing: a failure is reported and tried again."""
        if self.stopped:
            return
        now = self._now()
        if set_back(self._last, now, SET_BACK_NS):
            self._sessions.must_rotate = True
            self._events.warn("clock_set_back", "the clock was set back: a new recording begins")
        self._last = now
        self._run_tasks(now)
        self._write_heartbeat(only_changes=not self._is_due("beat", HEARTBEAT_S, now))

    def stop(self) -> None:
        """Ends all recordings, and waits for them as long as the children's patience lasts."""
        if self.stopped:
            return
        self.stopped = True
        self._write_heartbeat(RecorderState.STOPPING)
        self._sessions.stop(self._now())
        self._reception.flush()
        self._paused = False
        if not self._disk.away:
            self._report_interruptions()
            self.housekeeper.finish()
            # Splits that were held back are compared only now.
            self._sessions.settle_handovers()
        self.orders.background.wait()
        self._write_heartbeat(RecorderState.STOPPED)

    def _run_tasks(self, now: ClockReading) -> None:
        for task in self._tasks:
            is_blocked = task.needs_disk and self._disk.away
            if is_blocked or not self._is_due(task.name, task.every_s, now):
                continue
            self._keep_alive()
            try:
                task.run(now)
            except (EpisodicError, OSError) as error:
                # A disk or a server may fail at any access: the next tick tries again.
                if self._is_due(f"report {task.name}", FAULT_S, now):
                    self._events.fail("supervision_failed", str(error), task=task.name)

    def _observe(self, now: ClockReading) -> None:
        closed = self._sessions.observe(now)
        self._splits_closed |= closed
        current = self._sessions.current
        if current is not None and current.splits.messages:
            self._backoff["restart"].reset()
            if closed:
                self._events.note_recording()

    def _check_disk(self, now: ClockReading) -> None:
        """Ends recording while another disk than at the start is mounted at the bag directory."""
        recordings = [session.name for session in self._sessions.running if session.splits.exists]
        was_away, is_away = self._disk.away, self._disk.is_away(recordings)
        self._reception.may_write = not is_away
        if is_away and not was_away:
            self._end_for_now(now)
            self._events.fail(
                "disk_gone",
                f"recording is paused: the disk of {self._bag_dir} has been unmounted, and another "
                "one is there; recording resumes when it is mounted again (to record onto the "
                "other one, restart the recorder)",
            )
        elif was_away and not is_away:
            self._put_off("restart", now)
            self._events.info("disk_back", bag_dir=str(self._bag_dir))

    def _check_exits(self, now: ClockReading) -> None:
        for _ in range(self._sessions.collect_ended(now)):
            self._put_off("rotate", now)
            self._put_off("restart", now)
        if self._sessions.end_unready(now):
            self._put_off("restart", now)

    def _check_space(self, now: ClockReading) -> None:
        """Deletes bags, pauses or resumes recording, by the free space on the disk."""
        least, free = self.orders.min_free_bytes, self._free_bytes()
        enough = round(least * RESUME_FACTOR)
        if free is None:
            return
        if self._paused:
            if free >= enough:
                self._paused = False
                self._due_s["restart"] = now.monotonic_s
                self._events.info("recording_resumed", free_bytes=free)
            elif self._is_due("room", QUIET_RETENTION_S, now):
                # Bags that were being written when recording was paused may be deleted by now.
                self.housekeeper.make_room(enough)
            return
        if free < least and not self._room_requested:
            self.housekeeper.make_room(enough)
            free = self._free_bytes()
            if free is None:
                return
        self._room_requested = free < least
        # Recording waits for room that is being made while half of it is free.
        is_waiting = self.housekeeper.is_making_room() and free >= least // 2
        if free < least and not is_waiting:
            self._paused = True
            self._end_for_now(now)
            self._events.fail(
                "recording_paused",
                f"recording is paused: {free} bytes are free on the disk, and {least} are "
                f"required (retention.min_free_gb); it resumes by itself at {enough}",
            )
            self._write_heartbeat()

    def _end_for_now(self, now: ClockReading) -> None:
        self._sessions.end_all(now)
        self._interruptions.setdefault("paused", now.wall)

    def _check_handover(self, now: ClockReading) -> None:
        step = self._sessions.advance_handover(now)
        if step is Step.COMPLETE:
            self._backoff["rotate"].reset()
            self._silence.note_rotation(for_silence=self._rotating_for_silence)
        elif step is Step.ABANDON:
            self._put_off("rotate", now)

    def _check_rotation(self, now: ClockReading) -> None:
        current = self._sessions.current
        if current is None:
            return
        if current.name != self._watched:
            self._watched = current.name
            self._silence.note_begin(now.monotonic_s)
        is_silent = self._silence.is_silent(
            now.monotonic_s,
            current.splits.bytes_written,
            offered=bool(current.subscribed - OWN_TOPICS),
        )
        # Every split repeats the list of all splits before it, so a recording that is never
        # rotated grows with the square of its age.
        is_over = current.age_s(now) >= self.orders.session_duration_s
        resubscribe = self._reception.rotation_due(
            current.name, now.monotonic_s, current.subscribed
        )
        is_wanted = self._sessions.must_rotate or is_silent or is_over or resubscribe is not None
        is_alone = self._sessions.handover is None
        may_rotate = is_alone and current.is_recording and current.splits.exists
        if not (is_wanted and may_rotate and self._is_due("rotate", 0.0, now)):
            return
        if is_silent:
            sentence = (
                f"{current.name} does not grow: the robot is silent, or its messages do not "
                "arrive or not reach the disk; a new recording is to close it"
            )
            self._events.warn("no_growth", sentence, recording=current.name)
        self._rotating_for_silence = is_silent and not is_over
        # A recorder that receives nothing may have missed the newest latched messages.
        self._reception.skip_latched(() if is_silent else self.housekeeper.excluded_latched())
        try:
            self._sessions.begin_handover(now)
        except RecorderError as error:
            self._events.fail("rotation_failed", str(error), recording=current.name)
            self._put_off("rotate", now)
            return
        if resubscribe is not None:
            self._reception.note_rotation(resubscribe, now.monotonic_s)
            event, sentence = resubscribe.event, resubscribe.sentence
            if resubscribe.is_fault:
                self._events.warn(event, sentence, recording=current.name)
            else:
                self._events.info(event, reason=sentence, recording=current.name)

    def _check_list(self, _: ClockReading) -> None:
        """Requests a rotation if the list of topics was changed."""
        topics = self.orders.topics
        before = {*topics.selection.listed}
        if topics.look():
            after = {*topics.selection.listed}
            self._sessions.must_rotate = True
            added, dropped = sorted(after - before), sorted(before - after)
            self._events.info("topics_changed", added=added, dropped=dropped)
        self._events.lasting("topics_refused", "", topics.refused)

    def _check_restart(self, now: ClockReading) -> None:
        if self._sessions.current is not None or self._paused:
            return
        try:
            self._begin_recording(now)
        except RecorderError:
            self._put_off("restart", now)

    def _begin_recording(self, now: ClockReading) -> None:
        self._reception.skip_latched(())
        try:
            make_bag_dir(self._bag_dir)
            self._sessions.begin(now)
        except RecorderError as error:
            self._events.fail("recorder_not_started", str(error))
            raise
        self._topic_watch.note_begin(now)

    def _note_recorded(self, now: ClockReading) -> None:
        names = [session.name for session in self._sessions.running if session.has_recorded]
        self.housekeeper.note_recorded(
            () if self._disk.away else names, self._sessions.bytes_written, now.monotonic_s
        )

    def _apply_retention(self, now: ClockReading) -> None:
        every_s = RETENTION_S if self._splits_closed else QUIET_RETENTION_S
        if now.monotonic_s - self._applied_s >= every_s:
            self._applied_s = now.monotonic_s
            self._splits_closed = False
            self.housekeeper.apply()

    def _announce(self, name: str) -> None:
        """Writes down the name of a recording before anything of it exists.

        Raises:
            RecorderError: the name cannot be written, so the recording must not begin.
        """
        self.housekeeper.announce(name)
        self._write_heartbeat(announced=name)

    def _add_interruption(self, first: Ns, how: Interruption) -> None:
        # No recording follows one that hangs when all are ended.
        if not self.stopped:
            self._interruptions.setdefault(how, first)

    def _end_interruptions(self, _: ClockReading) -> None:
        if self.is_recording:
            self._report_interruptions()

    def _report_interruptions(self) -> None:
        for how, first in self._interruptions.items():
            self.housekeeper.note_restart(first, how)
        self._interruptions.clear()

    def _write_heartbeat(
        self,
        state: RecorderState | None = None,
        *,
        announced: str | None = None,
        only_changes: bool = False,
    ) -> None:
        """Writes a heartbeat; a failure is reported and stops nothing.

        Args:
            state: the recorder's state; None for the present one.
            announced: the name of a recording that is about to begin.
            only_changes: write nothing unless more than times and amounts changed.
        """
        # The disk below an unmounted one must stay empty.
        if self._disk.away:
            return
        last, now, state = self._beat, self.orders.clock.now(), state or self._state
        since = last.since if last is not None and last.state is state else now
        beat = self._make_heartbeat(now, state, since, announced)
        if only_changes and last is not None and _without_amounts(beat) == _without_amounts(last):
            return
        self._beat = beat
        with self._events.lasting_if_refused("heartbeat_not_written", ""):
            write_heartbeat(self._bag_dir, beat)

    def _make_heartbeat(
        self, now: Ns, state: RecorderState, since: Ns, announced: str | None
    ) -> Heartbeat:
        """Returns the heartbeat of this moment."""
        sessions, watch, events = self._sessions, self._topic_watch, self._events
        names = dict.fromkeys(filter(None, (*self._names(), announced)))
        silent = frozenset() if sessions.current is None else sessions.current.silent_topics()
        return Heartbeat(
            pid=os.getpid(),
            updated=now,
            state=state,
            recordings=tuple(names),
            since=since,
            bytes_written=sessions.bytes_written,
            subscribed=tuple(sorted(sessions.subscribed)),
            silent=tuple(sorted(silent | watch.gone)),
            last_error=events.last_error,
            last_error_at=events.last_error_at,
            recovered=events.recovered,
            interval_s=HEARTBEAT_S,
            restarts=sessions.restarts,
            missing=watch.missing(),
            lost=self._reception.lost_in_last_hour(now),
            waiting_for=watch.waiting_for if state is RecorderState.WAITING else None,
            cut_short=tuple(sorted(self._reception.cut_short)),
            listed=self.orders.topics.selection.listed,
            list_refused=self.orders.topics.refused,
            process=process_of(os.getpid()),
            advice=self.orders.advice() if watch.shortfall.unheard else None,
            **self.housekeeper.status()._asdict(),
            **watch.shortfall._asdict(),
        )

    @property
    def _state(self) -> RecorderState:
        if self._paused or self._disk.away:
            return RecorderState.PAUSED
        if not self.is_recording:
            return RecorderState.STARTING
        waits = self._topic_watch.waiting_for is not None
        return RecorderState.WAITING if waits else RecorderState.RECORDING

    def _free_bytes(self) -> int | None:
        fault = None
        try:
            return self.free_bytes_of(self._bag_dir)
        except OSError as error:
            fault = f"{self._bag_dir}: {error.strerror or error}"
            return None
        finally:
            self._events.lasting("free_space_unknown", "", fault)

    def _is_due(self, task: str, every_s: float, now: ClockReading) -> bool:
        """Returns whether a task is due, and if so has it wait `every_s` seconds."""
        if now.monotonic_s < self._due_s.get(task, 0.0):
            return False
        self._due_s[task] = now.monotonic_s + every_s
        return True

    def _put_off(self, task: str, now: ClockReading) -> None:
        """Delays the next attempt of a task that failed."""
        self._due_s[task] = now.monotonic_s + self._backoff[task].next_wait_s()

    def _names(self) -> list[str]:
        return [session.name for session in self._sessions.running]

    def _now(self) -> ClockReading:
        return ClockReading(self.monotonic(), self.orders.clock.now())


def _without_amounts(beat: Heartbeat) -> Heartbeat:
    return replace(beat, updated=0, bytes_written=0, counted_bytes=None, state_bytes=0)


def make_bag_dir(bag_dir: Path) -> None:
    """Makes the bag directory if it does not exist.

    Raises:
        RecorderError: the directory cannot be made.
    """
    try:
        bag_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = f"cannot be made: {error.strerror or error}"
        if isinstance(error, FileExistsError | NotADirectoryError):
            reason = "is a file, or lies below one, and not a directory"
        raise RecorderError(f"{bag_dir} {reason}; correct recording.bag_dir") from error
