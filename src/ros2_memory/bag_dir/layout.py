"""What the recorder puts into the bag directory, by name.

    bag_dir/
      recorder.json                heartbeat
      recorder.lock                who records here
      recorder.qos.yaml            how latched topics are subscribed to
      recorder.storage.yaml        how MCAP files are written
      .ros_log/                    what `ros2` logs of itself: the newest few runs
      rec_20261120T043000Z/        one recording: what one `ros2 bag record` wrote
        rec_20261120T043000Z_0.mcap, ...   its splits (distributions differ in the names)
        metadata.yaml                      written by it at a clean end
        handover.json                      which of it counts (see `handover`)
      latched/carried.mcap         latched messages of bags that were deleted (see `latched`)
      moments/                     bags that were asked to be kept (see `keepsake`)
        20261120T043012Z-charging/         one moment
          moment.json                      what it is called, and when it was
          rec_20261120T043000Z/            hard links, under the names that the bags have above
      .episodic/recorded.jsonl     how long was recorded when each recording ended (`recorded_time`)
      .episodic/requests/          what the query server asks of the recorder (see `mailbox`)
      .episodic/recordings.jsonl   which recordings the recorder made (see `ownership`)

The two YAML files stand beside the recordings, since a recording's own directory must not exist
before `ros2 bag record` creates it, and it reads one of them again at every split. They say the
same for every recording, so there is one pair.
No name here ends as a bag file's does, so the index passes them by.
"""

from __future__ import annotations

import stat
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from pathlib import Path

LOCK_FILE: Final = "recorder.lock"
QOS_FILE: Final = "recorder.qos.yaml"
STORAGE_FILE: Final = "recorder.storage.yaml"
ROS_LOG_DIR: Final = ".ros_log"
HANDOVER_FILE: Final = "handover.json"
METADATA_FILE: Final = "metadata.yaml"
CARRY_FOLDER: Final = "latched"
CARRY_FILE: Final = "carried.mcap"
MOMENTS_FOLDER: Final = "moments"
MOMENT_FILE: Final = "moment.json"
OWN_FOLDER: Final = ".episodic"
RECORDED_FILE: Final = "recorded.jsonl"
REQUESTS_FOLDER: Final = f"{OWN_FOLDER}/requests"
LIST_FILE: Final = f"{OWN_FOLDER}/recordings.jsonl"

OWN_FILES: Final = frozenset({HEARTBEAT_FILE, QOS_FILE, STORAGE_FILE})
"""What may be deleted from the bag directory itself, besides bags: it is written anew."""
RECORDING_FILES: Final = frozenset({METADATA_FILE, HANDOVER_FILE})
"""What stands in a recording's directory besides its bags, and has no meaning without them."""
BAG_KINDS: Final = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
"""How the names of bag files end, whichever reader reads them."""
COMPRESSED: Final = ".zstd"


def has_recorded(bag_dir: Path) -> bool:
    """Whether a recorder of this program has been at work in a directory, by its own files.

    Only there anything is written beside bags. Nothing behind a link counts.
    """
    return any(_is_file(bag_dir / name) for name in (HEARTBEAT_FILE, LIST_FILE))


def _is_file(path: Path) -> bool:
    try:
        here = stat.S_ISREG(path.lstat().st_mode)
        return here and not path.parent.is_symlink() if path.parent.name == OWN_FOLDER else here
    except OSError:
        return False


def is_carried(bag: Path) -> bool:
    """Whether a bag file is that of carried messages: it says nothing of what was recorded when."""
    return bag.name == CARRY_FILE and bag.parent.name == CARRY_FOLDER


def recording_name(now: Ns, bag_dir: Path) -> str:
    """A name for a recording that begins `now`: its UTC time, and a number where that is taken.

    It is taken where two begin within one second, or where the clock was set back.

    Raises:
        RecorderError: what is in the bag directory cannot be told, as on a disk that fails.
    """
    moment = datetime.fromtimestamp(now // NS_PER_S, tz=UTC)
    stem = f"rec_{moment:%Y%m%dT%H%M%SZ}"
    name, number = stem, 1
    try:
        while (bag_dir / name).exists():
            number += 1
            name = f"{stem}_{number}"
    except OSError as error:
        raise RecorderError(f"{bag_dir / name}: {error.strerror or error}") from error
    return name


def node_name(recording: str) -> str:
    """A ROS node name of its own for each recording.

    Two recorders of one name, as at a handover, would make their services ambiguous.
    """
    return f"ros2_memory_{recording}"


def bag_kind(name: str) -> str | None:
    """The kind of bag that a file name claims, one of `BAG_KINDS`, or None, as of hidden files."""
    lowered = name.lower()
    if not lowered.endswith(BAG_KINDS) or lowered.startswith("."):
        return None
    return next(kind for kind in BAG_KINDS if lowered.endswith(kind))


def other_form(path: str) -> str:
    """The name of the same bag compressed as a whole, or no longer so."""
    return path.removesuffix(COMPRESSED) if path.endswith(COMPRESSED) else path + COMPRESSED
