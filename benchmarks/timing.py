"""Fills the memory of a world and asks it, each in processes of their own, by processor time.

Processor time hardly depends on what the machine does besides. Each question is asked in a process
in which the server has looked at the bags and answered nothing: the first time, and again.
"""

from __future__ import annotations

import asyncio
import gc
import hashlib
import json
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, cast

from benchmarks.worlds import STRANGERS
from ros2_memory.bootstrap import NEW_OBJECTS, build_dispatcher, build_memory
from ros2_memory.bootstrap_fleet import build_fleet
from ros2_memory.config import Settings, load_settings
from ros2_memory.core.logging_setup import configure_logging
from ros2_memory.core.malloc import share_one_arena

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.questions import Question
    from ros2_memory.core.model import JsonValue
    from ros2_memory.serving.dispatch import Dispatcher

_FORKED: Final = multiprocessing.get_context("fork")  # imports are not counted
_PARTIAL: Final = ("out of time", "not read", "of the bags so far", "needs more than")
_NOW: Final = re.compile(r".*ago_s|.*age_s|now.*|there_now|notes")
"""Keys whose values depend on when it is asked, or say how it was answered."""
_COUNTS: Final = ("total", "at_least", "count", "distance_m", "mean", "visits", "things")


class Ran(NamedTuple):
    """What a command took: processor seconds of all its processes, by the clock, MB at its peak."""

    seconds: float
    elapsed_s: float
    peak_mb: float


class Asked(NamedTuple):
    """What a question took (ms of processor time), and its answer in short."""

    start_ms: float
    first_ms: float
    again_ms: float
    told: str
    trouble: str


class Server(NamedTuple):
    """What a server that answered all questions took: ms each, and its resident MB."""

    spent_ms: tuple[float, ...]
    resident_mb: float
    peak_mb: float


def overrides(place: Path) -> list[str]:
    """Returns what of the configuration is not as shipped: the bags, and the named rooms."""
    facts = json.loads((place / "world.json").read_bytes())
    named = {
        name: {"x": bounds[:2], "y": bounds[2:]} for name, bounds in facts.get("rooms", {}).items()
    }
    places = place / "places.yaml"
    places.write_text(json.dumps({"places": named}), encoding="utf-8")
    words = ["logging.level=error", f"data.places_file='{places}'"]
    if facts.get("robots"):
        fleet = f"fleet.robots='{place}/robots/*'"
        words += ["deployment=fleet", fleet, "fleet.shared_map=true"]
    else:
        words.append(f"recording.bag_dir='{place / 'bags'}'")
    if facts["kind"] == STRANGERS:
        words.append("storage=rosbag2")  # reads .db3, too
    if facts.get("lake"):
        words += ["lake=duckdb", f"lake.warehouse='{place / 'lake'}'"]
    return words


def settings_of(place: Path) -> Settings:
    """Returns the shipped configuration over a world; its store lies beside the world."""
    os.environ |= {"XDG_CACHE_HOME": str(place / "store"), "TZ": "UTC"}
    time.tzset()
    configure_logging("error", "json")
    return load_settings(overrides(place), env={})


def filled(place: Path) -> Ran:
    """Indexes a world anew, as `ros2-memory index` does.

    Raises:
        subprocess.CalledProcessError: the command failed.
    """
    shutil.rmtree(place / "store", ignore_errors=True)
    return _command(place, "index", "--json", *overrides(place))


def first_answer(place: Path, question: Question) -> Ran:
    """Starts a program that answers one question and ends: Python, imports, all bags, the answer.

    Raises:
        subprocess.CalledProcessError: the command failed.
    """
    arguments = json.dumps(dict(question.arguments))
    return _command(place, "ask", "--json", question.tool, arguments, *overrides(place))


def shipped(place: Path) -> Ran:
    """Ships a fleet's bags into a lake, made anew, and takes them away from the robots.

    Raises:
        subprocess.CalledProcessError: the command failed.
    """
    words = [word for word in overrides(place) if not word.startswith(("deploy", "lake="))]
    done = _command(place, "ship", "--once", "--json", "deployment=lake", *words)
    for robot in (place / "robots").iterdir():
        shutil.rmtree(robot)
        robot.mkdir()
    return done


def _command(place: Path, *words: str) -> Ran:
    program = [sys.executable, "-m", "ros2_memory.cli", *words]
    environment = os.environ | {"XDG_CACHE_HOME": str(place / "store"), "TZ": "UTC"}
    begun = time.monotonic()
    with subprocess.Popen(program, env=environment, stdout=subprocess.DEVNULL) as child:
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    elapsed_s = time.monotonic() - begun
    if child.returncode not in {0, 1}:  # 1: no data, which is an answer
        raise subprocess.CalledProcessError(child.returncode, program)
    return Ran(used.ru_utime + used.ru_stime, elapsed_s, used.ru_maxrss * 1024 / 1e6)


def stored(place: Path) -> int:
    """Returns the bytes that the store of a world takes."""
    folders = (place / "store", place / "lake")
    return sum(path.stat().st_size for one in folders for path in one.rglob("*") if path.is_file())


def asked(place: Path, question: Question) -> Asked:
    """Asks a question twice in a process of its own."""
    with _FORKED.Pool(1) as pool:
        return pool.apply(_asked, (place, question._replace(plain=None)))


def server(place: Path, questions: Sequence[Question]) -> Server:
    """Asks all questions in one process, one after the other."""
    with _FORKED.Pool(1) as pool:
        return pool.apply(_server, (place, [each._replace(plain=None) for each in questions]))


def imported(place: Path, questions: Sequence[Question]) -> None:
    """Has this process import what answers them, over a few bags, so that forks have it."""
    with tempfile.TemporaryDirectory() as folder:
        few = Path(folder)
        facts = json.loads((place / "world.json").read_bytes())
        facts["lake"] = False
        (few / "world.json").write_text(json.dumps(facts), encoding="utf-8")
        robot = few / ("robots/r00" if facts.get("robots") else "bags")
        robot.mkdir(parents=True)
        for bag in sorted((place / "bags").rglob("*.mcap"))[:2]:
            shutil.copy(bag, robot)
        _server(few, questions)


def _asked(place: Path, question: Question) -> Asked:
    times = [time.process_time()]
    dispatcher = _dispatcher(settings_of(place))
    times.append(time.process_time())
    replies = []
    for _ in range(2):
        reply = asyncio.run(dispatcher.answer(question.tool, dict(question.arguments)))
        times.append(time.process_time())
        replies.append(reply.text)
    start, first, again = ((after - before) * 1e3 for before, after in pairwise(times))
    told, trouble = in_short(replies[0])
    if in_short(replies[1])[0] != told:
        trouble = f"{trouble} another answer again".strip()
    return Asked(start, first, again, told, trouble)


def _dispatcher(settings: Settings) -> Dispatcher:
    """Returns what answers as the server does, having looked at all bags."""
    share_one_arena()
    gc.set_threshold(NEW_OBJECTS)
    memory, fleet = build_memory(settings), build_fleet(settings)
    if fleet is None:
        memory.index.refresh()
    else:
        for robot in fleet.robots.values():
            robot.memory.index.refresh()
    return build_dispatcher(settings, memory, fleet=fleet)


def _server(place: Path, questions: Sequence[Question]) -> Server:
    dispatcher = _dispatcher(settings_of(place))
    spent = []
    for question in questions:
        begun = time.process_time()
        asyncio.run(dispatcher.answer(question.tool, dict(question.arguments)))
        spent.append((time.process_time() - begun) * 1e3)
    return Server(tuple(spent), resident_mb("VmRSS"), resident_mb("VmHWM"))


def in_short(reply: str) -> tuple[str, str]:
    """Returns a reply's count with a hash of it without what depends on now, and its trouble."""
    parsed = cast("JsonValue", json.loads(reply))
    lasting = json.dumps(_lasting(parsed), sort_keys=True).encode()
    digest = hashlib.sha256(lasting).hexdigest()[:6]
    if isinstance(parsed, list):
        return f"{len(parsed)} rows {digest}", ""
    if not isinstance(parsed, dict):
        return digest, ""
    if "error" in parsed:
        error = str(parsed["error"])
        # No data is an answer; what took too long is none.
        return f"{error} {digest}", error if "time" in error else ""
    notes = [str(note) for note in cast("list[JsonValue]", parsed.get("notes") or [])]
    trouble = "; ".join(note for note in notes if any(word in note for word in _PARTIAL))
    counts = parsed
    if isinstance(parsed.get("all"), list):  # of several robots each has one
        columns, cells = (cast("list[str]", parsed[name]) for name in ("columns", "all"))
        counts = dict(zip(columns[1:], cells, strict=True))
    name = next((name for name in _COUNTS if name in counts), "")
    value = counts.get(name)
    count = f"{name} {value} " if isinstance(value, str | int | float) else ""
    return f"{count}{digest}", trouble


def _lasting(value: JsonValue) -> JsonValue:
    if isinstance(value, dict):
        return {name: _lasting(inner) for name, inner in value.items() if not _NOW.fullmatch(name)}
    return [_lasting(inner) for inner in value] if isinstance(value, list) else value


def resident_mb(field: str, process: str = "self") -> float:
    """Resident memory of a process: `VmRSS` as it is, `VmHWM` at its peak. Linux only.

    Not from `getrusage`, whose peak a child inherits from the program that started it.
    """
    text = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line.startswith(field))
    return int(line.split()[1]) * 1024 / 1e6
