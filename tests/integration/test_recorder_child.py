"""One child process: how it is started, what it inherits, and that it always comes to an end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process.child import (
    MAX_LINE,
    MAX_LINES,
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
def started() -> Iterator[list[Child]]:
    """Children that a failing test leaves are ended."""
    children: list[Child] = []
    yield children
    assert end_all(children) == []


def start(
    started: list[Child],
    *argv: str,
    keep_open: tuple[int, ...] = (),
    patience: Patience = PATIENT,
) -> Child:
    child = Child.start(argv, ENV, keep_open=keep_open, patience=patience)
    started.append(child)
    return child


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


class TestOutput:
    def test_both_streams_are_read_line_by_line_in_order(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        body = "print('one', flush=True)\nsys.stderr.write('two\\n')\nprint('three', end='')"
        child = start(started, program(tmp_path, body))
        assert finished(child) == 0
        assert child.take_lines() == ["one", "two", "three"]
        assert child.take_lines() == []

    def test_a_flood_neither_stops_the_child_nor_fills_the_memory(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        body = "for n in range(60000): sys.stderr.write(f'[WARN] [1.0] [n]: line {n}\\n')"
        child = start(started, program(tmp_path, body))
        assert finished(child) == 0
        lines = child.take_lines()
        assert len(lines) == MAX_LINES
        assert lines[-1].endswith("line 59999")

    def test_a_line_without_an_end_is_taken_in_pieces(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        child = start(started, program(tmp_path, "sys.stderr.write('x' * 10000)"))
        assert finished(child) == 0
        assert [len(line) for line in child.take_lines()] == [MAX_LINE, MAX_LINE, 10000 - 8192]

    def test_bytes_that_are_no_text_are_taken_too(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        child = start(started, program(tmp_path, "os.write(2, b'\\xff\\xfe ok\\n')"))
        finished(child)
        (line,) = child.take_lines()
        assert line.endswith(" ok")


class TestInheritance:
    def test_the_environment_is_the_one_given_and_nothing_else(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        body = "print(sorted(k for k in os.environ if k not in ('LC_CTYPE',)))"
        child = start(started, program(tmp_path, body))
        finished(child)
        assert child.take_lines() == [str(sorted(ENV))]

    def test_no_signal_is_ignored_or_blocked_though_they_are_here(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        body = (
            "status = dict(l.split(':\\t', 1) for l in open('/proc/self/status') if ':\\t' in l)\n"
            # Python itself ignores these two.
            "ours = 1 << signal.SIGPIPE - 1 | 1 << signal.SIGXFSZ - 1\n"
            "print(int(status['SigBlk'], 16), int(status['SigIgn'], 16) & ~ours)\n"
            "print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
        )
        path = program(tmp_path, body)
        kept = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGHUP)}
        masked = {signal.SIGINT, signal.SIGTERM, signal.SIGUSR1}
        before = signal.pthread_sigmask(signal.SIG_BLOCK, masked)
        for each in kept:
            signal.signal(each, signal.SIG_IGN)
        try:
            child = start(started, path)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            for each, handler in kept.items():
                signal.signal(each, handler)
        finished(child)
        assert child.take_lines() == ["0 0", "True"]

    def test_it_is_a_session_and_a_group_of_its_own(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        body = "print(os.getpid() == os.getsid(0) == os.getpgid(0), os.getpid())"
        child = start(started, program(tmp_path, body))
        finished(child)
        assert child.take_lines() == [f"True {child.pid}"]

    def test_it_inherits_its_streams_what_it_is_given_and_nothing_else(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        body = (
            "names = [os.readlink(f'/proc/self/fd/{n}') for n in os.listdir('/proc/self/fd')\n"
            "         if os.path.exists(f'/proc/self/fd/{n}')]\n"
            "print(sum('given' in n for n in names), sum('kept back' in n for n in names))\n"
            "print(os.readlink('/proc/self/fd/0'))"
        )
        path = program(tmp_path, body)
        with (tmp_path / "given").open("w") as given, (tmp_path / "kept back").open("w"):
            child = start(started, path, keep_open=(given.fileno(),))
        finished(child)
        assert child.take_lines() == ["1 0", "/dev/null"]


class TestEnd:
    def test_sigint_ends_it_cleanly(self, tmp_path: Path, started: list[Child]) -> None:
        # The signal may come while print() has not returned, which it does not stand twice.
        body = (
            "def end(*_): os.write(1, b'closing\\n'); os._exit(0)\n"
            "signal.signal(signal.SIGINT, end)\nup()\nidle()"
        )
        child = start(started, program(tmp_path, body))
        lines_until(child, "up")
        assert end_all([child]) == []
        assert child.exit_status() == 0
        assert child.take_lines() == ["closing"]

    @pytest.mark.parametrize(
        ("ignored", "patience", "status"),
        [
            ("[signal.SIGINT]", DEAF, -signal.SIGTERM),
            ("[signal.SIGINT, signal.SIGTERM]", DEAFER, -signal.SIGKILL),
        ],
    )
    def test_one_that_does_not_answer_is_ended_by_stronger_signals(
        self,
        tmp_path: Path,
        started: list[Child],
        ignored: str,
        patience: Patience,
        status: int,
    ) -> None:
        body = f"for s in {ignored}: signal.signal(s, signal.SIG_IGN)\nup()\nidle()"
        child = start(started, program(tmp_path, body), patience=patience)
        lines_until(child, "up")
        assert end_all([child]) == []
        assert child.exit_status() == status

    def test_a_signal_in_the_first_moment_of_its_life_ends_it(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        # The first one may come while it still ignores what is ignored here.
        child = start(started, program(tmp_path, "idle()"), patience=DEAF)
        assert end_all([child]) == []
        assert is_gone(child.pid)

    def test_what_it_leaves_in_its_group_is_killed_with_it(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        body = (
            "p = subprocess.Popen([sys.executable, '-IS', '-c', 'import time; time.sleep(600)'])\n"
            "print(p.pid, flush=True)\nos._exit(3)"
        )
        child = start(started, program(tmp_path, body))
        assert until(child.exit_status) == 3
        (pid,) = child.take_lines()
        until(lambda: is_dead(int(pid)))

    def test_its_death_is_noticed_without_anybody_asking_for_it(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        child = start(started, program(tmp_path, "os.abort()"))
        assert finished(child) == -signal.SIGABRT
        assert child.exit_status() == -signal.SIGABRT
        assert child.end() == -signal.SIGABRT

    def test_neither_zombies_nor_descriptors_stay(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        path = program(tmp_path, "print('hello')")
        before = len(list(Path("/proc/self/fd").iterdir()))
        for _ in range(5):
            child = start(started, path)
            finished(child)
            assert is_gone(child.pid)
        assert len(list(Path("/proc/self/fd").iterdir())) == before

    def test_where_the_system_reaps_children_its_end_is_noticed_too(
        self, tmp_path: Path, started: list[Child]
    ) -> None:
        before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
        try:
            child = start(started, program(tmp_path, "sys.exit(4)"))
            until(child.exit_status)
        finally:
            signal.signal(signal.SIGCHLD, before)


class TestStart:
    def test_a_program_that_is_not_there_says_so_and_ends(self, started: list[Child]) -> None:
        child = start(started, "/nowhere/ros2", "bag")
        assert finished(child) == 127
        assert child.take_lines() == ["/nowhere/ros2: No such file or directory"]

    def test_another_thread_than_the_main_one_may_not_start_it(self, tmp_path: Path) -> None:
        caught: list[BaseException] = []
        path = program(tmp_path, "idle()")

        def attempt() -> None:
            try:
                Child.start([path], ENV)
            except RecorderError as error:
                caught.append(error)

        thread = threading.Thread(target=attempt)
        thread.start()
        thread.join()
        assert str(caught[0]).startswith("a child must be started from the main thread")


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


class TestRunBounded:
    def test_it_kills_what_takes_too_long_with_all_it_started(self, tmp_path: Path) -> None:
        body = (
            "p = subprocess.Popen([sys.executable, '-IS', '-c', 'import time; time.sleep(600)'])\n"
            f"open({str(tmp_path / 'pid')!r}, 'w').write(str(p.pid))\nidle()"
        )
        told = tmp_path / "pid"
        for bound_s in (1, 10, 100):
            with pytest.raises(RecorderError, match=f"did not come to an end within {bound_s} s"):
                run_bounded([program(tmp_path, body)], ENV, bound_s)
            if told.exists() and told.read_text():
                break
        pid = int(told.read_text())
        until(lambda: is_dead(pid))

    def test_it_does_not_wait_for_what_goes_on_in_the_background(self, tmp_path: Path) -> None:
        body = (
            "p = subprocess.Popen([sys.executable, '-IS', '-c', 'import time; time.sleep(600)'])\n"
            "print(p.pid)"
        )
        finished = run_bounded([program(tmp_path, body)], ENV, PATIENCE_S)
        assert finished.returncode == 0
        os.kill(int(finished.stdout), signal.SIGKILL)

    def test_a_program_that_is_not_there_is_named(self) -> None:
        with pytest.raises(RecorderError, match="/nowhere/x cannot be started: No such file"):
            run_bounded(["/nowhere/x"], ENV, PATIENCE_S)
