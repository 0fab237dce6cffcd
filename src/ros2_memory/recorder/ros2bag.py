"""`recorder=ros2bag`: a supervised `ros2 bag record`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.durable_write import write_durably
from ros2_memory.bag_dir.layout import (
    QOS_FILE,
    ROS_LOG_DIR,
    STORAGE_FILE,
    node_name,
)
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import WallClock
from ros2_memory.recorder.base import Recorder
from ros2_memory.recorder.process.child import Child
from ros2_memory.recorder.process.command import SERVICES, record_argv, storage_config
from ros2_memory.recorder.process.installation import (
    Installation,
    advice_on_silence,
    find_installation,
)
from ros2_memory.recorder.process.topics import TopicsFile
from ros2_memory.recorder.reception import Reception, newest_splits
from ros2_memory.recorder.sessions import Orders, Required
from ros2_memory.recorder.supervisor import Supervisor
from ros2_memory.retention.policy import GB

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.recorder.background import Background
    from ros2_memory.recorder.housekeeping import Housekeeping
    from ros2_memory.storage.base import BagReader

ROSOUT: Final = "/rosout"
LOGS_KEPT: Final = 20

_log = get_logger(__name__)


@dataclass(eq=False, repr=False)
class Ros2BagRecorder(Recorder):
    """Records with `ros2 bag record`, and keeps it recording while `tick` is called.

    Args:
        latched_topics: topics of transient local publishers; all of their messages are recorded.
        repeat_latched: topics, as `topic` or `topic=depth`, whose last messages begin every split
            if the distribution can do that. Their log times may lie long before the split.
        keep_open: file descriptors that `ros2 bag record` inherits.
        excluding: the topics that rules of `recording.exclude_when` read, each with its rule.
    """

    reader: BagReader
    _: KW_ONLY
    bag_dir: Path
    topics_file: Path
    split_duration_s: int
    session_duration_s: float
    use_sim_time: bool
    queue_mb: int
    min_free_gb: float
    setup_files: Sequence[Path]
    latched_topics: Sequence[str]
    repeat_latched: Sequence[str]
    required: Sequence[Required]
    chunk_bytes: int
    housekeeper: Housekeeping
    own: OwnRecordings
    keep_open: Collection[int]
    excluding: Mapping[str, str]
    background: Background

    def __post_init__(self) -> None:
        self._bag_dir = self.bag_dir.absolute()
        self._checked = False
        topics = (entry.topic for entry in self.required if "*" not in entry.topic)
        by_setting = dict.fromkeys(topics, "recording.required")
        self._topics = TopicsFile(self.topics_file, {**by_setting, **self.excluding})
        self._ros = Installation("ros2", {}, frozenset())
        self._reception = Reception(
            self.reader,
            self.queue_mb * 2**20,
            bag_dir=self._bag_dir,
            latched=self.latched_topics,
            # Each new recording would receive the latched log of an excluded time again.
            volatile={ROSOUT} - self.excluding.keys() if self.excluding else (),
            background=self.background,
        )
        orders = Orders(
            bag_dir=self._bag_dir,
            split_duration_s=self.split_duration_s,
            session_duration_s=self.session_duration_s,
            min_free_bytes=round(self.min_free_gb * GB),
            start_child=self._start_child,
            reader=self.reader,
            clock=WallClock(),
            topics=self._topics,
            own=self.own,
            reception=self._reception,
            background=self.background,
            required=self.required,
            simulated=self.use_sim_time,
            advice=lambda: advice_on_silence(self._ros.env),
        )
        self._supervisor = Supervisor(orders, self.housekeeper)

    def check(self) -> None:
        """Reads the list of topics, and finds `ros2`, its environment and its options.

        Raises:
            ConfigError: as `Recorder`.
            RecorderError: as `Recorder`; or the path of the bag directory is not UTF-8.
        """
        self._topics.load()
        try:
            str(self._bag_dir).encode()
        except UnicodeEncodeError:
            raise RecorderError(
                f"ros2 bag record takes no path that is not UTF-8: {self._bag_dir}; rename the "
                "folder, or choose another recording.bag_dir"
            ) from None
        self._ros = find_installation(self.setup_files, self._bag_dir / ROS_LOG_DIR)
        services = self._topics.selection.services
        if services and SERVICES not in self._ros.options:
            _log.warning(
                "services_not_recorded",
                topics=list(services),
                reason="this ros2 bag record has no --services: Jazzy and later have it",
            )
        self._checked = True

    def start(self) -> None:
        """Begins to record; calls `check` first unless that was done since the last start."""
        if not self._supervisor.stopped:
            return
        if not self._checked:
            self.check()
        self._checked = False
        self._reception.recall(newest_splits(self._bag_dir, self.own))
        self._supervisor.start()

    def tick(self) -> None:
        """Runs the tasks of supervision that are due."""
        self._supervisor.tick()

    def stop(self) -> None:
        """Ends recording, and waits for the children as long as their patience lasts."""
        self._supervisor.stop()

    def is_running(self) -> bool:
        """Whether a child runs, and has reported that it records."""
        return self._supervisor.is_recording

    def _start_child(self, name: str, directory: Path) -> Child:
        qos_file, storage_file = self._bag_dir / QOS_FILE, self._bag_dir / STORAGE_FILE
        try:
            write_durably(qos_file, self._reception.overrides(name))
            write_durably(storage_file, storage_config(self.chunk_bytes))
        except OSError as error:
            raise RecorderError(
                f"{error.filename} cannot be written: {error.strerror}; the recorder must be able "
                "to write into recording.bag_dir"
            ) from error
        _delete_old_logs(self._bag_dir / ROS_LOG_DIR)
        argv = record_argv(
            ros2=self._ros.ros2,
            directory=directory,
            topics=self._topics.selection,
            split_duration_s=self.split_duration_s,
            qos_file=qos_file,
            storage_file=storage_file,
            node_name=node_name(name),
            cache_bytes=self._reception.queue_bytes,
            use_sim_time=self.use_sim_time,
            repeat_latched=self.repeat_latched,
            known_options=self._ros.options,
        )
        return Child.start(argv, self._ros.env, keep_open=self.keep_open)


def _delete_old_logs(log_dir: Path) -> None:
    """Deletes all but the newest logs of `ros2`; the event log has their lines as well."""
    with suppress(OSError):
        if log_dir.is_symlink():
            return  # files elsewhere are not ours
        logs = sorted(log_dir.iterdir(), key=lambda path: path.lstat().st_mtime_ns)
        for path in logs[:-LOGS_KEPT]:
            with suppress(OSError):  # such as a directory
                path.unlink()
