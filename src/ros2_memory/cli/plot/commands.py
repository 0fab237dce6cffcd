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
    BagDir,
    End,
    Last,
    Recording,
    Start,
    Verbose,
    Words,
    day_of,
    load_to_look,
    open_memory,
    parse_window,
    print_line,
    reported_errors,
    spinner,
    topic_and_words,
)
from ros2_memory.cli.output import with_local_times
from ros2_memory.cli.plot.scene import (
    MOST_TOPICS,
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
    from ros2_memory.cli.plot.drawing import Picture
    from ros2_memory.cli.plot.without_poses import DrawnPath
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
@reported_errors("plot path")
def plot_path(
    words: Words = None,
    *,
    out: Out,
    start: Start = None,
    end: End = None,
    last: Last = None,
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
    bag_dir: BagDir = None,
    recording: Recording = None,
    verbose: Verbose = False,
) -> None:
    """Draw the driven path in 2D, coloured by time, with named places and standstills."""
    _check(out)
    from ros2_memory.cli.plot import drawing  # noqa: PLC0415 - an extra that few install

    settings = load_to_look(bag_dir, words, recording)
    memory = open_memory(settings, verbose=verbose)
    asked = opened(memory, parse_window(memory, start, end, last))
    with spinner("looking for the path"):
        path, subtitle, notes = path_in(asked, topic, frame)
        stops = stops_along(recap_in(asked), path)
    picture = drawing.Picture(f"Path, {asked.title}", subtitle, (8.5, 7.0))
    drawing.draw_path(picture, path, places_in(memory, path.frame), stops)
    _finish(picture, out, notes, as_json=as_json)


@plot.command("signal", epilog=epilog("plot"))
@reported_errors("plot signal")
def plot_signal(
    topic: Annotated[
        str, typer.Argument(metavar="TOPIC", help="The name of the topic, such as /battery.")
    ],
    words: Words = None,
    *,
    out: Out,
    field: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATH", help="A numeric field; repeatable (default: all that change)."
        ),
    ] = None,
    start: Start = None,
    end: End = None,
    last: Last = None,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    recording: Recording = None,
    verbose: Verbose = False,
) -> None:
    """Draw numeric fields of a topic over time, one row for each field."""
    _check(out)
    topic, words = topic_and_words(topic, words, "plot signal")
    from ros2_memory.cli.plot import drawing  # noqa: PLC0415 - an extra that few install

    memory = open_memory(load_to_look(bag_dir, words, recording), verbose=verbose)
    asked = opened(memory, parse_window(memory, start, end, last))
    name = resolve_topic(asked.view, topic)
    with spinner(f"reading {name}"):
        total, signals, notes = signals_of(asked, name, field or ())
    shown = f"{counted(total, 'message')}"
    picture = drawing.Picture(f"{name}, {asked.title}", shown, (10.0, 1.2 + 1.9 * len(signals)))
    drawing.draw_signals(picture, signals, asked.span)
    _finish(picture, out, notes, as_json=as_json)


@plot.command("timeline", epilog=epilog("plot"))
@reported_errors("plot timeline")
def plot_timeline(
    words: Words = None,
    *,
    out: Out,
    start: Start = None,
    end: End = None,
    last: Last = None,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    recording: Recording = None,
    verbose: Verbose = False,
) -> None:
    """Draw what was recorded when: gaps, silences and events, and one row for each topic."""
    _check(out)
    from ros2_memory.cli.plot import drawing  # noqa: PLC0415 - an extra that few install

    settings = load_to_look(bag_dir, words, recording)
    memory = open_memory(settings, verbose=verbose)
    asked = opened(memory, parse_window(memory, start, end, last))
    with spinner("looking what was recorded when"):
        found = recap_in(asked)
        rows = [*event_rows(asked, found), *topic_rows(asked)]
    left_out = len(asked.view.snapshot.timeline.topics()) - MOST_TOPICS
    subtitle = f"without the {counted(left_out, 'rarest topic')}" if left_out > 0 else ""
    picture = drawing.Picture(f"Recorded, {asked.title}", subtitle, (11.0, 1.3 + 0.27 * len(rows)))
    drawing.draw_timeline(picture, rows, asked.span)
    _finish(picture, out, () if found is None else found.notes, as_json=as_json)


@plot.command("recap", epilog=epilog("plot"))
@reported_errors("plot recap")
def plot_recap(
    words: Words = None,
    *,
    out: Out,
    day: Annotated[
        str | None,
        typer.Option(
            metavar="TIME", help="today, yesterday or a date, 2026-11-20 (default: the newest day)."
        ),
    ] = None,
    start: Start = None,
    end: End = None,
    last: Last = None,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    recording: Recording = None,
    verbose: Verbose = False,
) -> None:
    """Draw a day in one picture: where the robot drove, what happened, what was recorded."""
    _check(out)
    from ros2_memory.cli.plot import drawing  # noqa: PLC0415 - an extra that few install

    settings = load_to_look(bag_dir, words, recording)
    memory = open_memory(settings, verbose=verbose)
    if all(each is None for each in (start, end, last)):
        window = day_of(memory, day)
    elif day is None:
        window = parse_window(memory, start, end, last)
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
    picture = drawing.Picture(f"Recap, {asked.title}", totals_line(found), (12.0, 8.0))
    drawing.draw_recap(picture, path, rows, asked.span, [*event_lines(found)])
    _finish(picture, out, () if found is None else found.notes, as_json=as_json)


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


def _finish(picture: "Picture", out: Path, notes: Sequence[str], *, as_json: bool) -> None:
    picture.save(out)
    print_line(json.dumps({"path": str(out), "notes": [*notes]}) if as_json else str(out))
    for note in () if as_json else notes:
        typer.echo(f"note: {with_local_times(note)}", err=True)
