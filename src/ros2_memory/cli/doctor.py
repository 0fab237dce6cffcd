"""`ros2-memory doctor`: looks at everything that has to be right, and says what to do."""

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import typer
from rich.console import Console
from rich.text import Text

from ros2_memory.cli import findings
from ros2_memory.cli.extras import of_extras
from ros2_memory.cli.findings import Finding, Level
from ros2_memory.cli.opening import opened
from ros2_memory.cli.output import plain
from ros2_memory.cli.running import AsJson, BagDir, Overrides, Verbose, busy, output, reporting, say
from ros2_memory.cli.server_finding import of_server
from ros2_memory.cli.settling import settings_for
from ros2_memory.config import config_dir
from ros2_memory.core.errors import ConfigError

_STYLES = {Level.OK: "green", Level.WARNING: "yellow", Level.ERROR: "red"}


def doctor(
    overrides: Overrides = None,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    verbose: Verbose = False,
) -> None:
    """Check configuration, disk, clock, bags, recorder, ROS environment, topics and server.

    Each finding says what to do.
    """
    with reporting("doctor"):
        found = [*examined(bag_dir, overrides, verbose=verbose)]
    worst = max(each.level for each in found)
    if as_json:
        told = {"status": worst.name.lower(), "findings": [each.as_json() for each in found]}
        say(json.dumps(told))
    else:
        _show(output(), found)
    raise typer.Exit(int(worst))


def examined(
    bag_dir: Path | None, overrides: Sequence[str] | None, *, verbose: bool = False
) -> Iterator[Finding]:
    """All findings; of a configuration that is refused no other."""
    try:
        settings = settings_for(bag_dir, overrides)
        memory = opened(settings, verbose=verbose)
    except ConfigError as error:
        yield Finding(Level.ERROR, "config", str(error), "correct the key that it names")
        return
    yield Finding(Level.OK, "config", f"composed from {config_dir(os.environ)}")
    now, snapshot = memory.clock.now(), memory.index.snapshot()
    with busy("asking the disk, ros2, the recorder and the server"):
        foreign = memory.foreign(snapshot)
        yield from findings.of_bag_dir(settings, 0 if foreign is None else foreign.total_bytes)
        yield from findings.of_clock(snapshot, now)
        yield from findings.of_bags(settings, memory)
        yield from findings.of_what_lies_there(memory, snapshot)
        yield from findings.of_ros(settings, memory.reader)
        yield from findings.of_recorder(settings, now)
        yield from findings.of_topics(settings, snapshot, now)
        yield from of_extras(settings)
        yield from of_server(settings)


def _show(console: Console, found: Sequence[Finding]) -> None:
    for each in found:
        line = Text.assemble(
            (f"{each.level.name.lower():<8}", _STYLES[each.level]),
            (f"{each.about:<9}", "bold"),
            plain(each.seen),
        )
        console.print(line, soft_wrap=True)
        if each.do and each.level is not Level.OK:
            console.print(Text(f"{'':17}-> {plain(each.do)}"), soft_wrap=True)
