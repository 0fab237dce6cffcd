"""The worlds that are asked: folders of bags that are the same whenever they are made.

Those of the shared folder are copied, so that times of files and stores lie apart from it.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Final

from mcap.exceptions import McapError
from mcap.reader import make_reader

from tests.home import recording as home
from tests.home.days import Scale
from tests.oracle import worlds as odd
from tests.support.bags import Msg, boolean, detections, odom, set_mtime, text, tf, transform
from tests.support.mcap_surgery import spoil_chunk
from tests.support.moving_map import write_moving_map
from tests.support.noisy_robots import write_noisy_robot
from tests.support.random_histories import write_history
from tests.support.shared_bags import BAGS

S: Final = 10**9
MS: Final = 10**6
T0: Final = 1_784_000_000 * S
WRITTEN_NS: Final = 1_785_000_000 * S
"""When files were written whose end is not known, or cannot be."""
COMMITTED: Final = Path(__file__).resolve().parents[2] / "data"

RECORDED, REAL, HOME, ODD = "recorded", "real", "home", "odd"


@dataclass(frozen=True)
class ReplyWorld:
    """A folder of bags that can be made again.

    Attributes:
        name: of the file of its replies, too.
        kind: worlds of one kind are alike.
        write: writes the bags into an empty folder.
        settings: besides those of every world.
        long: whether it is asked in long runs alone.
        needs: what it is a copy of, which may be absent; None where all is written.
        is_slow: whether calls take so long that a short run asks few.
    """

    name: str
    kind: str
    write: Callable[[Path], object]
    settings: Sequence[str] = ()
    long: bool = False
    needs: Path | None = None
    is_slow: bool = False

    @property
    def absent(self) -> str | None:
        """Why it cannot be made here; None if it can."""
        if self.needs is None or self.needs.exists():
            return None
        return f"{self.needs.name} of the shared bags is not beside this checkout"

    def make(self, folder: Path) -> Path:
        """Writes it into a new folder, with the times of files that it always has."""
        folder.mkdir(parents=True)
        self.write(folder)
        _date(folder)
        return folder


def _date(folder: Path) -> None:
    """Dates each file to the end of what it holds, where that is known."""
    for path in sorted(folder.rglob("*")):
        at = (_end_of(path) if path.suffix == ".mcap" else None) or WRITTEN_NS
        set_mtime(path, at)


def _end_of(path: Path) -> int | None:
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except (McapError, OSError, ValueError, KeyError, AssertionError):
        return None
    if summary is None or summary.statistics is None:
        return None
    end = summary.statistics.message_end_time
    return end if 1_500_000_000 * S < end < 1_800_000_000 * S else None


# -- bags of others ----------------------------------------------------------------------------


def _copied(sources: Sequence[Path], folder: Path) -> None:
    for source in sources:
        shutil.copytree(source, folder / source.name, copy_function=shutil.copyfile)


def _shared(kind: str, name: str, paths: Sequence[str]) -> ReplyWorld:
    sources = [BAGS / path for path in paths]
    return ReplyWorld(name, kind, partial(_copied, sources), needs=sources[0])


_SESSIONS: Final = (
    "session_mcap",
    "session_zstd_file",
    "session_sqlite3",
    "session_killed",
    "session_killed_chunk64k",
)
_EXTRA: Final = (
    "tfs",
    "customdata",
    "dbl",
    "late",
    "idle",
    "cl_fastwrite",
    "ev",
    "never",
    "nodef",
    "gc",
    "full_truncated",
)
_REAL: Final = (
    "ait_time0_images_db3",
    "bagel_filezstd_db3",
    "cougars_auv_mcap",
    "evo_tf_example_db3",
    "lichtblick_json_rosout_mcap",
    "mcap_conformance_2022",
    "mobrob_odom_mcap",
    "novatel_customtypes_nometa_db3",
    "philips_empty_db3",
    "plotjuggler_pose_db3",
    "rerun_json_protobuf_mcap",
    "rerun_sensors_mcap",
    "rosbag2_3split_nometa_mcap",
    "rosbag2_msgzstd_nometa_db3",
    "rosbag2_service_events_mcap",
    "rosbag2_time0_mcap",
    "rosbag2_v1_2018_db3",
    "rosbag2_wbag_5split_mcap",
    "rosbags_rs_94types_db3",
    "rosbags_rs_94types_mcap",
    "tiryoh_small_and_truncated",
)
_NOT_REPEATED: Final = frozenset({"evo_tf_example_db3"})
"""Their licence is no permissive one: what is kept of them is what is calculated, no message."""


def _bags_of_others() -> Iterator[ReplyWorld]:
    committed = COMMITTED / "session_zstd"
    yield ReplyWorld("session_zstd", RECORDED, partial(_copied, [committed]))
    for name in _SESSIONS:
        yield _shared(RECORDED, name, [f"recorded/{name}"])
    for name in _EXTRA:
        yield _shared(RECORDED, f"extra_{name}", [f"recorded/extra/{name}"])
    sessions = [f"recorded/{name}" for name in _SESSIONS]
    yield _shared(RECORDED, "sessions_together", sessions)
    extra = [f"recorded/extra/{name}" for name in _EXTRA]
    yield _shared(RECORDED, "extra_together", extra)
    for name in _REAL:
        yield _shared(REAL, name, [f"real/{name}"])
    robots = ("cougars_auv_mcap", "mobrob_odom_mcap", "plotjuggler_pose_db3")
    yield _shared(REAL, "real_robots_together", [f"real/{name}" for name in robots])
    others = [f"real/{name}" for name in _REAL if name not in {*robots, *_NOT_REPEATED}]
    yield _shared(REAL, "real_others_together", others)


# -- odd worlds --------------------------------------------------------------------------------


def _driving(begin: int, seconds: int, *, x: float = 0.0, rate: int = 5) -> list[Msg]:
    """A robot that drives 20 s along x, and stands for 20 s, again and again."""
    messages = []
    for step in range(seconds * rate):
        at = begin + step * S // rate
        turn, rest = divmod(step / rate, 40.0)
        moved = 0.3 * (20 * turn + min(rest, 20.0))
        messages.append(odom(at, x + moved, 0.2 * math_sign(turn), vx=0.3 if rest < 20 else 0.0))
        base = transform(at, "odom", "base_link", (x + moved, 0.2 * math_sign(turn), 0.0))
        messages.append(tf(at, base, log_time=at + MS))
        if step % rate == 0:
            messages.append(boolean(at + 2 * MS, (step // rate) % 30 < 10))
            messages.append(detections(at + 3 * MS, ["cup"], at=(1.0, 0.3, 0.2)))
            messages.append(text(at + 4 * MS, f"step {step // rate % 7}"))
    return messages


def math_sign(turn: float) -> float:
    """1 for even turns, else -1."""
    return 1.0 if turn % 2 == 0 else -1.0


def _wrong_clocks(folder: Path) -> None:
    """Three days of a robot, and recordings of it while its clock said 1970 and 2036."""
    for day in range(3):
        begin = T0 + day * 86_400 * S
        odd.written(folder / f"day_{day}", _driving(begin, 60))
    for name, begin in (("unset", 30 * S), ("ahead", 2_092_000_000 * S)):
        odd.written(folder / name, _driving(begin, 60, x=50.0))


def _stepped_clock(folder: Path) -> None:
    """The wall clock is set forward by 2 s within a recording: log times follow, stamps do not."""
    messages = []
    for message in _driving(T0, 120):
        ahead = 2 * S if message.log_time >= T0 + 61 * S else 0
        messages.append(Msg(message.topic, message.type, message.log_time + ahead, message.body))
    odd.written(folder / "stepped", messages)


def _resets(folder: Path) -> None:
    """Odometry begins anew with each recording, after pauses of 0.05, 2 and 8 s."""
    begin = T0
    for number, pause_ns in enumerate((50 * MS, 2 * S, 8 * S, 0)):
        odd.written(folder / f"run_{number}", _driving(begin, 50, x=0.5 * number))
        begin += 50 * S + pause_ns


def _silent_odometry(folder: Path) -> None:
    """/odom and /tf are silent for 100 s, while others go on."""
    quiet = range(T0 + 60 * S, T0 + 160 * S)
    messages = [
        message
        for message in _driving(T0, 220)
        if message.topic not in {"/odom", "/tf"} or message.log_time not in quiet
    ]
    odd.written(folder / "quiet", messages)


def _two_at_once(folder: Path) -> None:
    """Two robots record the same topics at the same time, far from each other."""
    odd.written(folder / "left", _driving(T0, 90))
    odd.written(folder / "right", _driving(T0 + 3 * S + 70 * MS, 90, x=30.0))


def _damaged(folder: Path) -> None:
    """A split is cut, one has a flipped bit, one is empty, one a text, one has no end."""
    odd.written(folder / "hurt", _driving(T0, 100))
    files = [folder / "hurt" / f"hurt_{number}.mcap" for number in range(10)]
    whole = files[2].read_bytes()
    files[2].write_bytes(whole[: len(whole) * 3 // 5])
    spoil_chunk(files[4], 0)
    files[6].write_bytes(b"")
    files[7].write_bytes(b"this was a split once, and is none any more")
    files[9].write_bytes(files[9].read_bytes()[:-40])


def _odd_world(name: str, seed: int, folder: Path) -> None:
    made = odd.WORLDS[name](folder / name, Random(seed))
    assert made.folder == folder / name


def _own_worlds() -> Iterator[ReplyWorld]:
    for seed, days in ((7, 2), (11, 1)):
        write = partial(_write_home, Scale(seed, days, 60.0))
        yield ReplyWorld(f"home_{seed}", HOME, write, is_slow=days > 1)
    pose_topics = {"two_robots": ("data.pose_topic=/boat/odom",)}
    for name in odd.WORLDS:
        for seed in (1, 2):
            settings = pose_topics.get(name, ())
            write = partial(_odd_world, name, seed)
            yield ReplyWorld(f"{name}_{seed}", ODD, write, settings)
    for seed in range(1, 9):
        write = partial(_write_history, seed)
        yield ReplyWorld(f"history_{seed}", ODD, write, long=seed > 4)
    yield ReplyWorld("noisy_robot", ODD, partial(write_noisy_robot, "replies"))
    yield ReplyWorld("moving_map", ODD, lambda folder: write_moving_map(folder, 3))
    made: Mapping[str, Callable[[Path], None]] = {
        "wrong_clocks": _wrong_clocks,
        "stepped_clock": _stepped_clock,
        "resets": _resets,
        "silent_odometry": _silent_odometry,
        "two_at_once": _two_at_once,
        "damaged": _damaged,
    }
    for name, write_it in made.items():
        yield ReplyWorld(name, ODD, write_it)


def _write_home(scale: Scale, folder: Path) -> None:
    folder.rmdir()
    home.write(scale, folder)


def _write_history(seed: int, folder: Path) -> None:
    write_history(folder, Random(f"replies {seed}"))


WORLDS: Final[Mapping[str, ReplyWorld]] = {
    world.name: world for world in (*_bags_of_others(), *_own_worlds())
}
