"""Runs the recorder and the server as children of `ros2-memory up`, and shows what comes in."""

import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from rich.live import Live

from ros2_memory.bag_dir.heartbeat import Heartbeat, read_heartbeat
from ros2_memory.cli.options import EXIT_NEGATIVE, MB, print_line, stdout_console
from ros2_memory.cli.output import escape, format_duration
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import WallClock, unix_from_ns
from ros2_memory.recorder.process.child import Child, Patience, end_all

EVERY_S: Final = 10.0
"""Without a terminal, a line is printed so often, and when the state changes."""
_TICK_S: Final = 0.2
_PATIENCE: Final = Patience(interrupt_s=40.0, terminate_s=5.0)
"""The recorder waits for children of its own."""
_LOGGING: Final = ("logging.level=warning", "logging.format=pretty")


def run_programs(words: Sequence[str], bag_dir: Path) -> int:
    """Records and serves until Ctrl-C, and returns the exit code: 1 where a program ended itself.

    Whatever happens, both are ended, and waited for.
    """
    # A shell that starts this in the background has it ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    programs: dict[str, Child] = {}
    died = ""
    modules = {"recorder": ["recorder"], "server": ["server", "--page", "print"]}
    try:
        for name, (module, *options) in modules.items():
            argv = ["-m", f"ros2_memory.{module}", *options, *words, *_LOGGING]
            programs[name] = Child.start([sys.executable, *argv], os.environ, patience=_PATIENCE)
        died = _watch(programs, bag_dir)
    except KeyboardInterrupt:
        pass
    finally:
        # A second Ctrl-C would leave them behind; how long they may take is bounded.
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        left = end_all(programs.values())
    if died:
        print(f"ros2-memory up: {died}", file=sys.stderr)
    elif not left:
        print_line(f"recorder and server have ended; the bags are in {bag_dir}")
    return EXIT_NEGATIVE if left or died else 0


def _watch(programs: Mapping[str, Child], bag_dir: Path) -> str:
    """Shows what comes in, until a program ends; returns which one, and its last words."""
    console = stdout_console()
    before, due_s = "", 0.0
    last = dict.fromkeys(programs, "it gave no reason")
    with Live(console=console, auto_refresh=False) as live:
        while True:
            for name, child in programs.items():
                status = child.exit_status()
                for line in filter(None, map(escape, child.take_lines())):
                    if "http://" not in line:  # the address of the page is no reason
                        last[name] = line
                    console.print(f"{name}: {line}", soft_wrap=True)
                if status is not None:
                    return f"the {name} ended with status {status}: {last[name]}"
            beat = read_heartbeat(bag_dir).heartbeat
            state, line = "starting", "recorder: starting"
            if beat is not None and beat.pid == programs["recorder"].pid:
                state, line = _line_of(beat)
            if console.is_terminal:
                live.update(escape(line), refresh=True)
            elif state != before or time.monotonic() >= due_s:
                before, due_s = state, time.monotonic() + EVERY_S
                print_line(escape(line))
            time.sleep(_TICK_S)


def _line_of(beat: Heartbeat) -> tuple[str, str]:
    """Returns the recorder's state, and a line on it with what comes in."""
    heard = len({*beat.subscribed} - {*beat.silent})
    for_s = unix_from_ns(WallClock().now() - beat.since)
    line = f"recorder: {beat.state} for {format_duration(for_s)}, {counted(heard, 'topic')}"
    why = beat.waiting_for or (None if beat.recovered else beat.last_error)
    if beat.silent:
        line += f", silent: {listed(beat.silent)}"
    line += f", {beat.bytes_written / MB:.1f} MB{f'; {why}' if why else ''}"
    return f"{beat.state} {heard}", line
