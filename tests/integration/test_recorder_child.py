"""One child process: how it is started, what it inherits, and that it always comes to an end."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import patch

import pytest

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process.child import (
    MAX_LINE,
    MAX_LINES,
    UNKNOWN_STATUS,
    Child,
    Patience,
    end_all,
    run_bounded,
)
from tests.support.processes import PATIENCE_S, until

ENV = {"PATH": os.environ["PATH"], "ONLY": "this"}
PATIENT = Patience(interrupt_s=PATIENCE_S, terminate_s=PATIENCE_S, kill_s=PATIENCE_S)
# For children that do not answer the first signal, and the second.
DEAF = Patience(interrupt_s=0.2, terminate_s=PATIENCE_S, kill_s=PATIENCE_S)
DEAFER = Patience(interrupt_s=0.2, terminate_s=0.2, kill_s=PATIENCE_S)
LEAVING = "p = subprocess.Popen([sys.executable, '-IS', '-c', 'import time; time.sleep(600)'])\n"
"""It leaves a process behind, in its group."""
Start = Callable[..., Child]
"""A child that runs a program of some lines."""
ROOT = Path(__file__).resolve().parents[2]


def program(folder: Path, body: str) -> str:
    """A program of a few lines; it says "up" when it has done what stands before `up()`."""
    path = folder / f"program{len(list(folder.iterdir()))}"
    path.write_text(
        f"#!{sys.executable} -IS\nimport os, signal, subprocess, sys, time\n"
        "def up(): print('up', flush=True)\n"
        f"def idle():\n    while True: time.sleep(60)\n{body}\n"
    )
    path.chmod(0o755)
    return str(path)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Children that a failing test leaves are ended."""
    children: list[Child] = []

    def started(body: str, keep_open: tuple[int, ...] = (), patience: Patience = PATIENT) -> Child:
        argv = [program(tmp_path, body)]
        children.append(Child.start(argv, ENV, keep_open=keep_open, patience=patience))
        return children[-1]

    yield started
    assert end_all(children) == []


def lines_until(child: Child, last: str) -> list[str]:
    taken: list[str] = []

    def come() -> bool:
        taken.extend(child.take_lines())
        return last in taken

    until(come)
    return taken


def finished(child: Child) -> int:
    """Its exit status, when all that it printed has been read."""
    status = until(child.exit_status)
    reader = f"output of {child.pid}"
    until(lambda: all(thread.name != reader for thread in threading.enumerate()))
    return status


def is_gone(pid: int) -> bool:
    """Whether a process is no more, not even as a zombie."""
    return not Path(f"/proc/{pid}").exists()


def is_dead(pid: int) -> bool:
    """Whether a process that is not ours to reap has ended."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return True
    return state in {"Z", "X"}


@pytest.mark.parametrize(
    ("body", "lines"),
    [
        (
            "print('one', flush=True)\nsys.stderr.write('two\\n')\nprint('three', end='')",
            ["one", "two", "three"],
        ),
        ("sys.stderr.write('x' * 10000)", ["x" * MAX_LINE, "x" * MAX_LINE, "x" * (10000 - 8192)]),
        ("os.write(2, b'\\xff\\xfe ok\\n')", ["\ufffd\ufffd ok"]),
        ("print(sorted(k for k in os.environ if k != 'LC_CTYPE'))", [str(sorted(ENV))]),
        ("print(os.getpid() == os.getsid(0) == os.getpgid(0))", ["True"]),
    ],
    ids=[
        "both streams, in order",
        "a line without an end, in pieces",
        "no text",
        "the environment that it is given, and nothing else",
        "a session and a group of its own",
    ],
)
def test_what_it_prints_is_taken_line_by_line(start: Start, body: str, lines: list[str]) -> None:
    child = start(body)
    assert finished(child) == 0
    assert child.take_lines() == lines
    assert child.take_lines() == []


def test_a_flood_neither_stops_the_child_nor_fills_the_memory(start: Start) -> None:
    child = start("for n in range(60000): sys.stderr.write(f'[WARN] [1.0] [n]: line {n}\\n')")
    assert finished(child) == 0
    lines = child.take_lines()
    assert len(lines) == MAX_LINES
    assert lines[-1].endswith("line 59999")


def test_no_signal_is_ignored_or_blocked_though_they_are_here(start: Start) -> None:
    body = (
        "status = dict(l.split(':\\t', 1) for l in open('/proc/self/status') if ':\\t' in l)\n"
        # Python itself ignores two; those below SIGRTMIN are the C library's own.
        "ours = 1 << signal.SIGPIPE - 1 | 1 << signal.SIGXFSZ - 1 | 3 << 31\n"
        "print(int(status['SigBlk'], 16), int(status['SigIgn'], 16) & ~ours)\n"
        "print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    )
    kept = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGHUP)}
    masked = {signal.SIGINT, signal.SIGTERM, signal.SIGUSR1}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, masked)
    for each in kept:
        signal.signal(each, signal.SIG_IGN)
    try:
        child = start(body)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for each, handler in kept.items():
            signal.signal(each, handler)
    finished(child)
    assert child.take_lines() == ["0 0", "True"]


def test_it_inherits_its_streams_what_it_is_given_and_nothing_else(
    tmp_path: Path, start: Start
) -> None:
    body = (
        "names = [os.readlink(f'/proc/self/fd/{n}') for n in os.listdir('/proc/self/fd')\n"
        "         if os.path.exists(f'/proc/self/fd/{n}')]\n"
        "print(sum('given' in n for n in names), sum('kept back' in n for n in names))\n"
        "print(os.readlink('/proc/self/fd/0'))"
    )
    with (tmp_path / "given").open("w") as given, (tmp_path / "kept back").open("w"):
        child = start(body, keep_open=(given.fileno(),))
    finished(child)
    assert child.take_lines() == ["1 0", "/dev/null"]


@pytest.mark.parametrize(
    ("begin", "patience", "status", "lines"),
    [
        # The signal may come while print() has not returned, which it does not stand twice.
        (
            "def end(*_): os.write(1, b'closing\\n'); os._exit(0)\nsignal.signal(2, end)",
            PATIENT,
            0,
            ["closing"],
        ),
        ("signal.signal(signal.SIGINT, signal.SIG_IGN)", DEAF, -signal.SIGTERM, []),
        ("for n in (2, 15): signal.signal(n, signal.SIG_IGN)", DEAFER, -signal.SIGKILL, []),
    ],
    ids=["SIGINT", "SIGTERM", "SIGKILL"],
)
def test_it_is_ended_by_sigint_and_by_stronger_signals_where_it_does_not_answer(
    start: Start, begin: str, patience: Patience, status: int, lines: list[str]
) -> None:
    child = start(f"{begin}\nup()\nidle()", patience=patience)
    lines_until(child, "up")
    assert end_all([child]) == []
    assert child.exit_status() == status
    assert child.take_lines() == lines


def test_a_signal_in_the_first_moment_of_its_life_ends_it(start: Start) -> None:
    # The first one may come while it still ignores what is ignored here.
    child = start("idle()", patience=DEAF)
    assert end_all([child]) == []
    assert is_gone(child.pid)


def test_what_it_leaves_in_its_group_is_killed_with_it(start: Start) -> None:
    child = start(f"{LEAVING}print(p.pid, flush=True)\nos._exit(3)")
    assert until(child.exit_status) == 3
    (pid,) = child.take_lines()
    until(lambda: is_dead(int(pid)))


def test_its_death_is_noticed_without_anybody_asking_for_it(start: Start) -> None:
    child = start("os.abort()")
    assert finished(child) == child.exit_status() == child.end() == -signal.SIGABRT


def test_neither_zombies_nor_descriptors_stay(start: Start) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(5):
        child = start("print('hello')")
        finished(child)
        assert is_gone(child.pid)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_where_the_system_reaps_children_its_end_is_no_success(start: Start) -> None:
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        assert until(start("sys.exit(4)").exit_status) == UNKNOWN_STATUS
    finally:
        signal.signal(signal.SIGCHLD, before)


def test_a_program_that_is_not_there_says_so_and_ends() -> None:
    child = Child.start(["/nowhere/ros2", "bag"], ENV)
    assert finished(child) == 127
    assert child.take_lines() == ["/nowhere/ros2: No such file or directory"]
    with pytest.raises(RecorderError, match="/nowhere/x cannot be started: No such file"):
        run_bounded(["/nowhere/x"], ENV, PATIENCE_S)


def test_another_thread_than_the_main_one_may_not_start_it(start: Start) -> None:
    with ThreadPoolExecutor() as pool:
        attempt = pool.submit(start, "idle()")
    with pytest.raises(RecorderError, match=r"^a child must be started from the main thread"):
        attempt.result()


def test_it_is_interrupted_when_the_process_that_started_it_is_killed(tmp_path: Path) -> None:
    recorder = program(
        tmp_path,
        "def end(*_):\n    open(sys.argv[1] + '/ended', 'w').close(); os._exit(0)\n"
        "signal.signal(signal.SIGINT, end)\n"
        "open(sys.argv[1] + '/up', 'w').write(str(os.getpid()))\nidle()",
    )
    daemon = (
        "import sys, time\nfrom ros2_memory.recorder.process.child import Child\n"
        "Child.start(sys.argv[1:], {})\ntime.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", daemon, recorder, str(tmp_path)]) as process:
        up = tmp_path / "up"
        until(lambda: up.exists() and bool(up.read_text()))
        process.send_signal(signal.SIGKILL)
    until((tmp_path / "ended").exists)
    until(lambda: is_dead(int(up.read_text())))


def test_a_parent_that_died_before_is_noticed(tmp_path: Path) -> None:
    launcher = ROOT / "src/ros2_memory/recorder/process/launch.py"
    ran = subprocess.run(
        [sys.executable, "-IS", launcher, "1", program(tmp_path, "print('ran')")],
        check=False,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 1
    assert "parent has died" in ran.stderr
    assert ran.stdout == ""


def test_a_bounded_run_kills_what_takes_too_long_with_all_it_started(tmp_path: Path) -> None:
    told = tmp_path / "pid"
    body = f"{LEAVING}open({str(told)!r}, 'w').write(str(p.pid))\nidle()"
    for bound_s in (1, 10, 100):
        with pytest.raises(RecorderError, match=f"did not come to an end within {bound_s} s"):
            run_bounded([program(tmp_path, body)], ENV, bound_s)
        if told.exists() and told.read_text():
            break
    pid = int(told.read_text())
    until(lambda: is_dead(pid))


@patch.object(tempfile, "tempdir", "/dev/null")
def test_a_bounded_run_needs_no_temporary_file(tmp_path: Path) -> None:
    body = "print('out'); print('error', file=sys.stderr)"
    ran = run_bounded([program(tmp_path, body)], ENV, PATIENCE_S)
    assert (ran.stdout, ran.stderr) == (b"out\n", b"error\n")


def test_a_bounded_run_does_not_wait_for_what_goes_on_in_the_background(tmp_path: Path) -> None:
    ran = run_bounded([program(tmp_path, f"{LEAVING}print(p.pid)")], ENV, PATIENCE_S)
    assert ran.returncode == 0
    os.kill(int(ran.stdout), signal.SIGKILL)
