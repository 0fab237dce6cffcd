"""`ros2-memory demo`: a simulated robot, its bags, a server and a client, for people to look at."""

from pathlib import Path
from typing import Annotated

import typer

from ros2_memory.cli.running import reporting, say
from ros2_memory.demo.run import DemoOptions, run_demo


def demo(
    once: Annotated[
        bool, typer.Option("--once", help="Leave after the answers; exit code 1: one was wrong.")
    ] = False,
    port: Annotated[int, typer.Option(help="On 127.0.0.1; 0: any that is free.")] = 9203,
    bag_dir: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="A new or empty folder, kept (a temporary one, removed at the end)."
        ),
    ] = None,
    duration: Annotated[
        float,
        typer.Option(metavar="S", help="Seconds of history when the questions are asked."),
    ] = 120.0,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Show the server's log on stderr.")
    ] = False,
) -> None:
    """A simulated robot, its bags, the query server and a client that asks it questions.

    Every answer is held against what the robot did. Needs no ROS and no configuration.
    """
    options = DemoOptions(
        once=once, port=port, bag_dir=bag_dir, duration_s=duration, verbose=verbose
    )
    with reporting("demo"):
        code = run_demo(options, say)
    raise typer.Exit(code)
