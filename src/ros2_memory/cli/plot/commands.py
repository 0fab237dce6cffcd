"""The commands of `ros2-memory plot`: what a picture shows is asked as the tools ask it."""

import json
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from ros2_memory.cli.app import epilog
from ros2_memory.cli.options import (
    AsJson,
    Bags,
    Times,
    as_command,
    day_of,
    print_line,
    spinner,
)
from ros2_memory.cli.output import with_local_times
from ros2_memory.cli.plot.scene import (
    MOST_TOPICS,
    DrawnPath,
    Stop,
    event_lines,
    event_rows,
    opened,
    path_in,
    places_in,
    recap_in,
    signals_of,
    stops_along,
    topic_rows,
    totals_line,
)
from ros2_memory.core.errors import ConfigError, InvalidArgumentsError, NoDataError
from ros2_memory.core.text import counted
from ros2_memory.history.no_data import resolve_topic

if TYPE_CHECKING:
    from ros2_memory.core.regions import Place

FORMATS: Final = (".svg", ".png", ".pdf")

plot = typer.Typer(
    help="Draw the driven path, a signal, what was recorded when, or a day.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Out = Annotated[
    Path,
    typer.Option(
        "--out",
        "-o",
        metavar="FILE",
        help="Write the picture here: .svg, .png or .pdf; overwrites the file.",
    ),
]


@plot.command("path", epilog=epilog("plot"))
@as_command("plot path")
def plot_path(
    *,
    out: Out,
    times: Times,
    topic: Annotated[
        str | None,
        typer.Option(metavar="TOPIC", help="The topic of the poses (default: data.pose_topic)."),
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(
            metavar="FRAME",
            help="The frame to draw in (default: data.map_frame, or the frame of the poses).",
        ),
    ] = None,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Draw the driven path in 2D, coloured by time, with named places and standstills."""
    _check(out)
    from ros2_memory.cli.plot import drawing  # noqa: PLC0415 - an extra that few install

    memory = bags.memory()
    asked = opened(memory, times.window(memory))
    with spinner("looking for the path"):
        path, subtitle, notes = path_in(asked, topic, frame)
        stops = stops_along(recap_in(asked), path)
    with drawing.picture(out, f"Path, {asked.title}", subtitle, (8.5, 7.0)) as figure:
        drawing.draw_path(figure.add_subplot(), path, places_in(memory, path.frame), stops)
    _finish(out, notes, as_json=as_json)


@plot.command("signal", epilog=epilog("plot"))
@as_command("plot signal")
def plot_signal(
    topic: Annotated[
        str, typer.Argument(metavar="TOPIC", help="The name of the topic, such as /battery.")
    ],
    *,
    out: Out,
    field: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATH", help="A numeric field; repeatable (default: all that change)."
        ),
    ] = None,
    times: Times,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Draw numeric fields of a topic over time, one row for each field."""
    _check(out)
    topic, bags = bags.with_topic(topic, "plot signal")
    from ros2_memory.cli.plot import drawing  # noqa: PLC0415 - an extra that few install

    memory = bags.memory()
    asked = opened(memory, times.window(memory))
    name = resolve_topic(asked.view, topic)
    with spinner(f"reading {name}"):
        total, signals, notes = signals_of(asked, name, field or ())
    title, size = f"{name}, {asked.title}", (10.0, 1.2 + 1.9 * len(signals))
    with drawing.picture(out, title, counted(total, "message"), size) as figure:
        drawing.draw_signals(figure, signals, asked.span)
    _finish(out, notes, as_json=as_json)


@plot.command("timeline", epilog=epilog("plot"))
@as_command("plot timeline")
def plot_timeline(
    *,
    out: Out,
    times: Times,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Draw what was recorded when: gaps, silences and events, and one row for each topic."""
    _check(out)
    from ros2_memory.cli.plot import drawing  # noqa: PLC0415 - an extra that few install

    memory = bags.memory()
    asked = opened(memory, times.window(memory))
    with spinner("looking what was recorded when"):
        found = recap_in(asked)
        rows = [*event_rows(asked, found), *topic_rows(asked)]
    left_out = len(asked.view.snapshot.timeline.topics()) - MOST_TOPICS
    subtitle = f"without the {counted(left_out, 'rarest topic')}" if left_out > 0 else ""
    size = (11.0, 1.3 + 0.27 * len(rows))
    with drawing.picture(out, f"Recorded, {asked.title}", subtitle, size) as figure:
        drawing.draw_rows(figure.add_subplot(), rows, asked.span)
    _finish(out, () if found is None else found.notes, as_json=as_json)


@plot.command("recap", epilog=epilog("plot"))
@as_command("plot recap")
def plot_recap(
    *,
    out: Out,
    day: Annotated[
        str | None,
        typer.Option(
            metavar="TIME", help="today, yesterday or a date, 2026-11-20 (default: the newest day)."
        ),
    ] = None,
    times: Times,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Draw a day in one picture: where the robot drove, what happened, what was recorded."""
    _check(out)
    from ros2_memory.cli.plot import drawing  # noqa: PLC0415 - an extra that few install

    memory = bags.memory()
    if times == Times():
        window = day_of(memory, day)
    elif day is None:
        window = times.window(memory)
    else:
        raise InvalidArgumentsError("give --day, or --start, --end and --last, not both")
    asked = opened(memory, window)
    with spinner("recalling the day"):
        found = recap_in(asked)
        rows = event_rows(asked, found)
        path: tuple[DrawnPath, Sequence[Place], Sequence[Stop]] | str
        try:
            drawn, _, _ = path_in(asked, None, None)
            path = (drawn, places_in(memory, drawn.frame), stops_along(found, drawn))
        except (InvalidArgumentsError, NoDataError) as error:
            path = f"the path is unknown: {error}"
    with drawing.picture(out, f"Recap, {asked.title}", totals_line(found), (12.0, 8.0)) as figure:
        drawing.draw_recap(figure, path, rows, asked.span, event_lines(found))
    _finish(out, () if found is None else found.notes, as_json=as_json)


def _check(out: Path) -> None:
    """Checks that a picture of that name can be drawn.

    Raises:
        ConfigError: the optional dependency is missing.
        InvalidArgumentsError: the name has a suffix of no picture.
    """
    if find_spec("matplotlib") is None:
        raise ConfigError(
            "pictures need the optional part of this package (no matplotlib): pip install '.[plot]'"
        )
    if out.suffix.lower() not in FORMATS:
        kinds = ", ".join(FORMATS)
        raise InvalidArgumentsError(f"--out {out} is not a picture: its name must end in {kinds}")


def _finish(out: Path, notes: Sequence[str], *, as_json: bool) -> None:
    print_line(json.dumps({"path": str(out), "notes": [*notes]}) if as_json else str(out))
    for note in () if as_json else notes:
        typer.echo(f"note: {with_local_times(note)}", err=True)
