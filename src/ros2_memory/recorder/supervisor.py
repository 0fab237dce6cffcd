"""Keeps recording: when to begin, rotate, pause and restart, and who is told.

Everything happens in `tick`, which its caller runs some times a second from the main thread, and
which does not wait. What to do is decided elsewhere (`plan`, `rotation`, `watchdog`), and done
elsewhere (`crew`); here the two meet.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.chores import QUIET_HOUSE_S, Chores
from ros2_memory.recorder.event_log import EventLog
from ros2_memory.recorder.handover.plan import (
    BOTH_S,
    SUBSCRIBE_TIMEOUT_S,
    ClockReading,
    Step,
)
from ros2_memory.recorder.heartbeat_writer import HeartbeatWriter
from ros2_memory.recorder.policies import Backoff, SilenceWatch, session_over
from ros2_memory.recorder.sessions import RecordingSessions
from ros2_memory.recorder.watchdog import Space, resume_bytes, space, time_was_set_back
from ros2_memory.retention.disk import HomeDisk, device_of, free_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ros2_memory.core.timebase import Clock
    from ros2_memory.recorder.ports import Housekeeper, RecorderProcess
    from ros2_memory.storage.base import BagReader

LOOK_S: Final = 0.5
SPACE_S: Final = 1.0
MOMENTS_S: Final = 1.0
"""How often it is looked whether somebody asks for a moment to be kept, and waits for the reply."""
FAULT_S: Final = 60.0
"""How often it is told that a task fails, which is tried again with every tick."""
SETTLE_S: Final = 5.0
"""A young recording writes its headers and the latched messages; the robot has said nothing yet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """What is to be done. Durations in seconds.

    `simulated`: log times come from a simulated clock. `subscribe_timeout_s` and `both_s` are
    those of a handover (see `rotation`), the next three those of a recorder that dies.
    """

    bag_dir: Path
    split_duration_s: float
    session_duration_s: float
    min_free_bytes: int
    simulated: bool = False
    heartbeat_s: float = 5.0
    subscribe_timeout_s: float = SUBSCRIBE_TIMEOUT_S
    both_s: float = BOTH_S
    first_backoff_s: float = 1.0
    longest_backoff_s: float = 60.0
    stable_s: float = 60.0


class Supervisor:
    """Keeps one recording going, two during a handover.

    `start_child` starts the recorder of a recording, given its name and its directory. `expected`
    gives the topics that are to be recorded by name, `own` is the list of recordings made here.
    """

    def __init__(
        self,
        orders: Orders,
        start_child: Callable[[str, Path], RecorderProcess],
        reader: BagReader,
        housekeeper: Housekeeper,
        clock: Clock,
        *,
        monotonic: Callable[[], float] = time.monotonic,
        free_bytes_of: Callable[[Path], int] = free_bytes,
        device: Callable[[Path], int] = device_of,
        expected: Callable[[], Sequence[str]] = tuple,
        own: OwnRecordings | None = None,
    ) -> None:
        self._orders = orders
        self._clock = clock
        self._monotonic = monotonic
        self._free_bytes_of = free_bytes_of
        self._home = HomeDisk(orders.bag_dir, device)
        self._away = False
        self._journal = EventLog()
        self._chores = Chores(orders.bag_dir, housekeeper, self._journal, monotonic())
        self._pulse = HeartbeatWriter(
            orders.bag_dir,
            orders.heartbeat_s,
            clock,
            self._journal,
            expected=expected,
            age_held=housekeeper.age_held,
        )
        self._crew = RecordingSessions(
            orders.bag_dir,
            start_child,
            self._announce,
            reader,
            self._journal,
            own=own or OwnRecordings(orders.bag_dir),
            simulated=orders.simulated,
            subscribe_timeout_s=orders.subscribe_timeout_s,
            both_s=orders.both_s,
        )
        limits = (orders.first_backoff_s, orders.longest_backoff_s, orders.stable_s)
        self._backoff = Backoff(*limits)
        self._rotation_backoff = Backoff(*limits)
        self._silence = SilenceWatch(orders.split_duration_s, orders.session_duration_s)
        self._rotating_for_silence = False
        self._rotate_now = False
        self._paused = False
        self._room_made = False
        self._stopped = True
        self._due_s: dict[str, float] = {}
        self._last = self._now()

    @property
    def is_recording(self) -> bool:
        """Whether a recorder runs and has said that it records."""
        current = self._crew.current
        return current is not None and current.ready and current.child.exit_status() is None

    def start(self) -> None:
        """Begins a first recording, unless one is under way or the disk is full.

        Raises:
            RecorderError: it cannot be begun.
        """
        if not self._stopped:
            return
        self._last = now = self._now()
        self._due_s.clear()
        self._make_bag_dir()
        self._remember_disk()
        self._mind_space(now)
        if not self._paused:
            self._begin(now)
        self._stopped = False
        self._beat()

    def tick(self) -> None:
        """Does what is due. Raises nothing: what goes wrong is reported, and tried again."""
        if self._stopped:
            return
        now = self._now()
        if time_was_set_back(self._last, now):
            self._rotate_now = True
            self._journal.warn("clock_set_back", "the clock was set back: a new recording begins")
        self._last = now
        self._mind_all(now)
        if self._is_due("beat", self._orders.heartbeat_s, now):
            self._beat()
        elif not self._away:
            self._pulse.beat_if_news(self._state, self._crew)

    def stop(self) -> None:
        """Ends everything that runs, within the patience of its children."""
        if self._stopped:
            return
        self._stopped = True
        self._beat(RecorderState.STOPPING)
        self._crew.end(self._now())
        self._paused = False
        self._beat(RecorderState.STOPPED)

    def _mind_all(self, now: ClockReading) -> None:
        tasks: dict[str, Callable[[ClockReading], object]] = {
            "disk": self._mind_disk,
            "look": self._look,
            "deaths": self._mind_deaths,
            "space": self._mind_space,
            "takeover": self._mind_takeover,
            "rotation": self._mind_rotation,
            "restart": self._mind_restart,
            "reap": self._crew.collect_ended,
            "recorded": self._note_recorded,
            "house": self._keep_house,
            "moments": self._keep_moments,
        }
        for task, mind in tasks.items():
            try:
                mind(now)
            except OSError as error:
                # Of a disk or a server that fails at any touch: the next tick tries again.
                if self._is_due(f"tell {task}", FAULT_S, now):
                    self._journal.fail("supervision_failed", str(error), task=task)

    def _look(self, now: ClockReading) -> None:
        if self._is_due("look", LOOK_S, now):
            self._chores.splits_closed |= self._crew.look(now)

    def _mind_disk(self, now: ClockReading) -> None:
        """Ends recording while another disk lies under the bag directory than at the start."""
        there = [each.name for each in self._crew.sessions if each.splits.exists]
        before, self._away = self._away, self._home.is_away(there)
        if self._away and not before:
            self._crew.dismiss(now)
            self._journal.fail(
                "disk_gone",
                f"recording is paused: the disk of {self._bag_dir} has been unmounted, and another "
                "lies there; recording resumes by itself when it is mounted again (to record onto "
                "the other one, start the recorder anew)",
            )
        elif before and not self._away:
            self._put_off("restart", self._backoff.failed(0.0), now)
            self._journal.note("disk_back", bag_dir=str(self._bag_dir))

    def _mind_deaths(self, now: ClockReading) -> None:
        before = self._crew.current
        for lived_s in self._crew.handle_exits(now):
            self._put_off("rotate", self._rotation_backoff.failed(lived_s), now)
            self._put_off("restart", self._backoff.failed(lived_s), now)
        if self._crew.give_up(now):
            self._put_off("restart", self._backoff.failed(0.0), now)
        current = self._crew.current
        if current is not None and current is not before:
            self._silence.began(now.monotonic_s, SETTLE_S)

    def _mind_space(self, now: ClockReading) -> None:
        """Deletes more, pauses and resumes, by what the disk has left."""
        if self._away or not self._is_due("space", SPACE_S, now):
            return
        free = self._free_bytes()
        if free is None:
            return
        action = self._space(free)
        if action is Space.MAKE_ROOM:
            self._room_made = True
            self._make_room()
            free = self._free_bytes() or 0
            action = self._space(free)
        if action is Space.STAY_PAUSED and self._is_due("room", QUIET_HOUSE_S, now):
            # What was being written when recording was paused may be deleted since.
            self._make_room()
        if action is Space.PAUSE:
            self._pause(now, free)
        elif action is Space.RESUME:
            self._paused = False
            self._put_off("restart", 0.0, now)
            self._journal.note("recording_resumed", free_bytes=free)
        elif action is Space.ENOUGH:
            self._room_made = False

    def _space(self, free: int) -> Space:
        return space(
            free,
            self._orders.min_free_bytes,
            paused=self._paused,
            room_made=self._room_made,
            making=self._chores.making_room(),
        )

    def _pause(self, now: ClockReading, free: int) -> None:
        self._paused = True
        self._crew.dismiss(now)
        self._journal.fail(
            "recording_paused",
            f"recording is paused: {free} bytes are free on the disk, and "
            f"{self._orders.min_free_bytes} are the least (retention.min_free_gb); it resumes "
            f"by itself at {resume_bytes(self._orders.min_free_bytes)}",
        )
        self._beat()

    def _mind_takeover(self, now: ClockReading) -> None:
        step = self._crew.advance_takeover(now)
        if step is Step.COMPLETE:
            self._silence.rotated(for_silence=self._rotating_for_silence)
            self._silence.began(now.monotonic_s, SETTLE_S)
        elif step is Step.ABANDON:
            self._put_off("rotate", self._rotation_backoff.failed(0.0), now)

    def _mind_rotation(self, now: ClockReading) -> None:
        current = self._crew.current
        if current is None:
            return
        silent = self._silence.is_silent(now.monotonic_s, current.splits.bytes_written)
        age_s = now.monotonic_s - current.began.monotonic_s
        over = session_over(age_s, self._orders.session_duration_s)
        wanted = self._rotate_now or silent or over
        ready = current.ready and current.splits.exists and self._crew.takeover is None
        if not (wanted and ready and self._is_due("rotate", 0.0, now)):
            return
        if silent:
            sentence = (
                f"{current.name} has stopped growing: the robot is silent, or its messages do not "
                "arrive; what was recorded is closed"
            )
            self._journal.warn("no_growth", sentence, recording=current.name)
        self._rotating_for_silence = silent and not over
        self._rotate_now = False
        try:
            self._crew.begin_takeover(now)
        except RecorderError as error:
            self._journal.fail("rotation_failed", str(error), recording=current.name)
            self._put_off("rotate", self._rotation_backoff.failed(0.0), now)

    def _mind_restart(self, now: ClockReading) -> None:
        if self._crew.current is not None or self._paused or self._away:
            return
        if not self._is_due("restart", 0.0, now):
            return
        try:
            self._begin(now)
        except RecorderError as error:
            self._journal.fail("recorder_not_started", str(error))
            self._put_off("restart", self._backoff.failed(0.0), now)

    def _begin(self, now: ClockReading) -> None:
        self._make_bag_dir()
        self._crew.begin(now)
        self._silence.began(now.monotonic_s, SETTLE_S)

    def _remember_disk(self) -> None:
        try:
            self._home.remember()
        except OSError as error:
            raise RecorderError(f"{self._bag_dir}: {error.strerror or error}") from error
        self._away = False

    def _make_bag_dir(self) -> None:
        try:
            self._bag_dir.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecorderError(
                f"{self._bag_dir} cannot be made: {error.strerror or error}"
            ) from error

    def _make_room(self) -> None:
        self._chores.make_room(resume_bytes(self._orders.min_free_bytes))

    def _keep_house(self, now: ClockReading) -> None:
        self._chores.tell()
        if not self._away:
            self._chores.keep_house(now.monotonic_s)

    def _note_recorded(self, now: ClockReading) -> None:
        names = () if self._away else tuple(each.name for each in self._crew.sessions if each.ready)
        self._chores.note_recorded(names, self._crew.bytes_written, now.monotonic_s)

    def _keep_moments(self, now: ClockReading) -> None:
        if not self._away and self._is_due("moments", MOMENTS_S, now):
            self._chores.keep_moments()

    def _announce(self, name: str) -> None:
        self._pulse.announce(name)
        self._beat()
        # It stays in that heartbeat until the next, and then is one of the crew's.
        self._pulse.arrived()

    def _beat(self, state: RecorderState | None = None) -> None:
        # Below where the bags' own disk is unmounted nothing is written, as nothing is recorded.
        if not self._away:
            self._pulse.beat(state or self._state, self._crew)

    @property
    def _state(self) -> RecorderState:
        if self._paused or self._away:
            return RecorderState.PAUSED
        return RecorderState.RECORDING if self.is_recording else RecorderState.STARTING

    def _free_bytes(self) -> int | None:
        try:
            free = self._free_bytes_of(self._bag_dir)
        except OSError as error:
            sentence = f"{self._bag_dir}: {error.strerror or error}"
            self._journal.fail_once("free_space_unknown", "", sentence)
            return None
        self._journal.over("free_space_unknown", "")
        return free

    def _is_due(self, task: str, every_s: float, now: ClockReading) -> bool:
        """Whether a task is due; it then is not for `every_s`."""
        if now.monotonic_s < self._due_s.get(task, 0.0):
            return False
        self._due_s[task] = now.monotonic_s + every_s
        return True

    def _put_off(self, task: str, wait_s: float, now: ClockReading) -> None:
        self._due_s[task] = now.monotonic_s + wait_s

    def _now(self) -> ClockReading:
        return ClockReading(self._monotonic(), self._clock.now())

    @property
    def _bag_dir(self) -> Path:
        return self._orders.bag_dir
