"""The progress bar of commands that take long; apart, since rich takes a while to import it."""

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn


def progress_bar(console: Console | None = None) -> Progress:
    """Returns a progress bar that is shown on a terminal only, and removed when it ends.

    Args:
        console: where it is shown; stderr unless given.
    """
    console = console or Console(stderr=True)
    return Progress(
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TextColumn("{task.description}", markup=False),
        console=console,
        transient=True,
        disable=not console.is_terminal,
        # Otherwise what the command prints on stdout would go to the console, which is stderr.
        redirect_stdout=False,
        redirect_stderr=False,
    )
