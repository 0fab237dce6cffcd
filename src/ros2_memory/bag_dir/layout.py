"""The names of files and folders in the bag directory.

    bag_dir/
      recorder.json                heartbeat (see `heartbeat`)
      recorder.lock                who records here (see `lock`)
      recorder.qos.yaml            how topics are subscribed to: QoS and depth
      recorder.storage.yaml        how MCAP files are written
      .ros_log/                    logs of `ros2`: the newest few runs
      rec_20261120T043000Z/        one recording: what one `ros2 bag record` wrote
        rec_20261120T043000Z_0.mcap, ...   its splits (ROS distributions name them differently)
        metadata.yaml                      written by rosbag2 at a clean end
        handover.json                      which messages count (see `handover_file`)
      latched/carried.mcap         latched messages of deleted bags (see `retention.latched_carry`)
      memory/20261120.thinned.mcap messages of a day's deleted bags (see `recorder.days`)
      moments/                     bags that somebody, or a rule, saved (see `moment_file`)
        20261120T043012Z-charging/         one saved moment
          moment.json                      its label and its time
          rec_20261120T043000Z/            hard links, under the names that the bags have above
      .episodic/recordings.jsonl   recordings that the recorder made (see `own_recordings`)
      .episodic/requests/          requests of the query server (see `moment_file`)
      .episodic/*.json, *.jsonl    the state of the two programs (see `state_files`)

The two YAML files lie beside the recordings: a recording's own directory must not exist before
`ros2 bag record` creates it, and `ros2 bag record` reads one of them again at every split.
No name here has the suffix of a bag, so the index ignores these files.
"""

from __future__ import annotations

import os
import re
import stat
from contextlib import suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.bag_dir.json_files import state_path
from ros2_memory.core.directories import mode_of
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.model import BAG_KINDS, COMPRESSED, MCAP
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Container
    from pathlib import Path

LOCK_FILE: Final = "recorder.lock"
QOS_FILE: Final = "recorder.qos.yaml"
STORAGE_FILE: Final = "recorder.storage.yaml"
ROS_LOG_DIR: Final = ".ros_log"
HANDOVER_FILE: Final = "handover.json"
METADATA_FILE: Final = "metadata.yaml"
CARRY_FOLDER: Final = "latched"
CARRY_FILE: Final = "carried.mcap"
_CARRIED: Final = f"/{CARRY_FOLDER}/{CARRY_FILE}"
MEMORY_FOLDER: Final = "memory"
THINNED_NAME: Final = "thinned.json"
THINNED_FILE: Final = f"{MEMORY_FOLDER}/{THINNED_NAME}"
MOMENTS_FOLDER: Final = "moments"
MOMENT_FILE: Final = "moment.json"
LOST_AND_FOUND: Final = "lost+found"
"""A folder in the root of every ext4 file system, which only root may open."""
OWN_FOLDER: Final = ".episodic"
RECORDED_FILE: Final = f"{OWN_FOLDER}/recorded.jsonl"
REQUESTS_FOLDER: Final = f"{OWN_FOLDER}/requests"
LOST_FILE: Final = f"{OWN_FOLDER}/lost.jsonl"
LIST_FILE: Final = f"{OWN_FOLDER}/recordings.jsonl"
ERASING_FILE: Final = f"{OWN_FOLDER}/erasing.json"
TRIGGERS_FILE: Final = f"{OWN_FOLDER}/triggers.json"
SCREENED_FILE: Final = f"{OWN_FOLDER}/screened.json"
SHIPPED_FILE: Final = f"{OWN_FOLDER}/shipped.jsonl"
SUPERSEDED_FILE: Final = f"{OWN_FOLDER}/superseded.json"
LEAVING_FILE: Final = f"{OWN_FOLDER}/leaving.json"
FORGOTTEN_FILE: Final = f"{OWN_FOLDER}/forgotten.jsonl"
DELETED_FILE: Final = f"{OWN_FOLDER}/deleted.jsonl"
EXPIRED_FILE: Final = f"{OWN_FOLDER}/expired.json"

OWN_FILES: Final = frozenset({HEARTBEAT_FILE, QOS_FILE, STORAGE_FILE})
"""Files in the bag directory itself that may be deleted: the recorder writes them again."""
TIMED_FILES: Final = frozenset(
    {LOST_FILE, DELETED_FILE, EXPIRED_FILE, ERASING_FILE, SCREENED_FILE, TRIGGERS_FILE}
)
"""State by log times: it would apply to the next simulation, which has the same times."""
RECORDING_FILES: Final = frozenset({METADATA_FILE, HANDOVER_FILE, THINNED_NAME})
"""Files beside the bags of a recording that mean nothing without the bags."""

_TIME_FORMAT: Final = "%Y%m%dT%H%M%SZ"
_DAY_FILE: Final = re.compile(r"\d{8}(?:-\d+)?\.thinned\.mcap")
_RECORDING_NAME: Final = re.compile(r"rec_(\d{8}T\d{6}Z)(?:_\d+)?")


def has_recorded(bag_dir: Path) -> bool:
    """Whether a recorder of this program has run here, by its files. Links do not count.

    In other bag directories nothing is written beside bags.
    """
    for name in (HEARTBEAT_FILE, LIST_FILE):
        with suppress(OSError):
            if stat.S_ISREG(state_path(bag_dir, name).lstat().st_mode):
                return True
    return False


def is_carried(bag: Path | str) -> bool:
    """Whether a bag holds carried messages: it does not show when anything was recorded."""
    return f"/{bag}".endswith(_CARRIED)


def is_thinned(bag: Path | str) -> bool:
    """Whether a bag is a day of `memory/`."""
    folder, _, name = f"/{bag}".rpartition("/")
    return folder.endswith(f"/{MEMORY_FOLDER}") and _DAY_FILE.fullmatch(name) is not None


def is_derived(bag: Path | str) -> bool:
    """Whether a bag holds messages of other bags: carried ones, or those of a thinned day."""
    return is_carried(bag) or is_thinned(bag)


def utc_day(at: Ns) -> str:
    """Returns the day (UTC) of a time, as `20261120`."""
    return utc_stamp(at).partition("T")[0]


def memory_file(day: str, number: int = 0) -> str:
    """Returns the name of a day's file, numbered if the first one cannot be changed."""
    return f"{day}-{number}.thinned.mcap" if number else f"{day}.thinned.mcap"


def is_kept_apart(name: str) -> bool:
    """Whether a path in the bag directory belongs to moments, thinned days or carried messages.

    They are no recordings.
    """
    return name.partition("/")[0] in {MOMENTS_FOLDER, CARRY_FOLDER, MEMORY_FOLDER}


def is_saved(bag_dir: Path, path: str) -> bool:
    """Whether a path lies in the folder of the saved moments."""
    return path.startswith(f"{str(bag_dir).rstrip('/')}/{MOMENTS_FOLDER}/")


def recorded_as(bag_dir: Path, path: str) -> str:
    """Returns the path where a saved moment's bag was recorded; any other path unchanged."""
    if not is_saved(bag_dir, path):
        return path
    _, slash, name = os.path.relpath(path, bag_dir / MOMENTS_FOLDER).partition("/")
    return str(bag_dir / name) if slash else path


def utc_stamp(at: Ns) -> str:
    """Returns a time (UTC) as `20261120T043000Z`."""
    return datetime.fromtimestamp(at // NS_PER_S, tz=UTC).strftime(_TIME_FORMAT)


def recording_name(now: Ns, bag_dir: Path, deleted: Container[str]) -> str:
    """Returns a free name for a recording that begins now: its UTC time, with a number if taken.

    A name is taken if two recordings begin within a second, or the clock was set back. Names of
    `deleted` recordings are taken as well: files in `.episodic` still have them.

    Raises:
        RecorderError: the disk fails.
    """
    stem = f"rec_{utc_stamp(now)}"
    name, number = stem, 1
    try:
        while name in deleted or mode_of(bag_dir / name):
            number += 1
            name = f"{stem}_{number}"
    except OSError as error:
        raise RecorderError(f"{bag_dir / name}: {error.strerror or error}") from error
    return name


def has_own_name(name: str) -> bool:
    """Whether a directory has a name of the form that `recording_name` returns."""
    return _RECORDING_NAME.fullmatch(name) is not None


def split_name(recording: str, number: int) -> str:
    """Returns the name that `ros2 bag record` gives a split of a recording."""
    return f"{recording.rpartition('/')[2]}_{number}{MCAP}"


def split_number(recording: str, file: str) -> int | None:
    """Returns the number of a split of a recording, by its name; None of other files."""
    digits = file.removesuffix(MCAP).rpartition("_")[2]
    if not digits.isdecimal() or file != split_name(recording, int(digits)):
        return None
    return int(digits)


def named_start(recording: str) -> Ns | None:
    """Returns when a recording began, by its name; None of a name of other programs."""
    named = _RECORDING_NAME.fullmatch(recording)
    if named is None:
        return None
    try:
        start = datetime.strptime(named[1], _TIME_FORMAT).replace(tzinfo=UTC)
    except ValueError:
        return None
    return int(start.timestamp()) * NS_PER_S


def node_name(recording: str) -> str:
    """Returns the ROS node name of a recording's recorder.

    During a handover, two recorders of one name would make their services ambiguous.
    """
    return f"ros2_memory_{recording}"


def bag_kind(name: str) -> str | None:
    """Returns the suffix of a bag's name, one of `BAG_KINDS`; None of other or hidden files."""
    lowered = name.lower()
    if not lowered.startswith("."):
        for kind in BAG_KINDS:
            if lowered.endswith(kind):
                return kind
    return None


def bags_in(folder: Path) -> list[Path]:
    """Returns the bag files in a directory.

    Raises:
        OSError: the directory cannot be listed.
    """
    return sorted(path for path in folder.iterdir() if bag_kind(path.name))


def other_form(path: str) -> str:
    """Returns the name of a bag's other form: with `.zstd`, or without."""
    return path.removesuffix(COMPRESSED) if path.endswith(COMPRESSED) else path + COMPRESSED
