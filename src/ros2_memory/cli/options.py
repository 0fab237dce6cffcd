"""What the commands share: their options, how they open a memory, and how they print and fail.

Typer reads annotations at run time, so modules with commands do without `annotations` of
`__future__`.
"""

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from datetime import datetime, time, timedelta
from functools import wraps
from inspect import Parameter, Signature, signature
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias, get_args

import typer

from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import METADATA_FILE, bag_kind, has_recorded
from ros2_memory.bag_dir.own_recordings import folders_with_bags
from ros2_memory.cli.output import print_json, spinner, with_local_times
from ros2_memory.config import NullRecorderNode, Settings, is_deployment_chosen, load_explained
from ros2_memory.config_sources import GROUPS, Sources, quoted
from ros2_memory.core.errors import ConfigError, EpisodicError, InvalidArgumentsError
from ros2_memory.core.logging_setup import configure_logging, withheld_warnings, withhold_warnings
from ros2_memory.core.model import BAG_KINDS, TimeWindow
from ros2_memory.core.text import counted, listed, similar
from ros2_memory.core.timebase import (
    MAX_NS,
    MIN_NS,
    Ns,
    WallClock,
    ns_from_unix,
    require_no_date,
    unix_from_ns,
    unix_from_text,
    window_end_s,
)

if TYPE_CHECKING:
    from ros2_memory.history.context import Memory

EXIT_NEGATIVE: Final = 1
"""Exit code: it ran, and the answer is no: an error reply, or something left undone."""
EXIT_CANNOT_RUN: Final = 2
"""Exit code: it could not run, and stderr says why."""
MB: Final = 1_000_000
BOUNDED: Final = "--start and --end, or --last"
"""Options of a window with two ends."""
STAYS: Final = "stays: "
"""Begins a line on what a command left as it is."""

TIMES: Final = (
    "Unix seconds (1795163910.5), ISO 8601 (2026-11-20T08:30), a time of day (14:05), "
    "yesterday 14:05, now, or how long ago (90s, 10m, 2h, 3d)"
)
_AGO: Final = re.compile(
    r"(\d+(?:\.\d+)?) ?([smhd]|sec|seconds?|min|minutes?|hours?|days?)(?: ago)?"
)
_SECONDS_OF: Final = {"s": 1, "m": 60, "h": 3600, "d": 86_400}
_LARGEST_UNIX_S: Final = 1e11
"""A larger number is in milliseconds or nanoseconds."""
_TIME_OF_DAY: Final = re.compile(
    r"(?=.)(today|yesterday)?(?:(?:^| )(\d\d:\d\d(?::\d\d(?:\.\d{1,6})?)?))?"
)

BagDir = Annotated[Path | None, "DIR", "Use the bags in this folder instead of recording.bag_dir."]
Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="key=value", help="Settings, the same as for ros2-memory-server."),
]
Words = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="PATH|key=value",
        help="A bag or a folder of bags to use instead of recording.bag_dir; and settings, the "
        "same as for ros2-memory-server.",
    ),
]
Recording = Annotated[
    str | None, "NAME", "Use this recording only, by a name that `ros2-memory recordings` lists."
]
Sets = Annotated[
    list[str] | None, "--set", "key=value", "A setting, the same as for ros2-memory-server."
]
Verbose = Annotated[bool, "--verbose", "-v", "Show the log on stderr, at logging.level."]
Command: TypeAlias = Callable[..., int | None]  # type: ignore[explicit-any]  # each its own options
LOOKING: Final = ("recorder=none", "storage=rosbag2", "data.now=latest")
"""Settings for bags of others: any kind is read, "ago" counts from the newest data."""

AsJson = Annotated[bool, "--json", "Print JSON."]


def _seconds(text: str) -> float:
    """Returns the seconds of a number or a duration; an error of usage where it is neither."""
    try:
        return float(text)
    except ValueError:
        length = parse_duration(text)
    if length is None:
        raise typer.BadParameter(f"{text!r} is neither seconds nor a duration such as 90s, 10m, 2h")
    return length


Last = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        parser=_seconds,
        help="The last S seconds, or 10m, 2h, 3d; instead of --start and --end.",
    ),
]


def load_for(bag_dir: Path | None, overrides: Sequence[str] | None) -> tuple[Settings, Sources]:
    """Loads the configuration as the server does, and who set each key; `--bag-dir` wins.

    It is about one robot, so there is no fleet then.

    Raises:
        ConfigError: the configuration is refused.
    """
    chosen = [] if bag_dir is None else [f"recording.bag_dir={quoted(str(bag_dir.absolute()))}"]
    settings, sources = load_explained([*(overrides or ()), *chosen])
    if bag_dir is not None:
        settings = replace(settings, fleet=replace(settings.fleet, robots={}, tokens={}))
    return settings, sources


def load_given(bag_dir: Path | None, words: Sequence[str] | None) -> tuple[Settings, Sources]:
    """Loads the configuration as the server does, or where a PATH is given as `load_to_look`."""
    load = load_to_look if any(map(_is_path, words or ())) else load_for
    return load(bag_dir, words)


def load_to_look(
    bag_dir: Path | None, words: Sequence[str] | None, recording: str | None = None
) -> tuple[Settings, Sources]:
    """Loads the configuration for a command that only looks; a PATH among its words wins.

    Bags that this deployment does not record are read whatever kind they are, and no recorder is
    expected there, unless the words choose a recorder, a storage or a deployment.

    Raises:
        ConfigError: the configuration is refused.
        InvalidArgumentsError: there is no such file or folder, or more than one is named.
    """
    named, given = settings_to_look(bag_dir, words, recording)
    loaded = load_for(named, given)
    folder = loaded[0].recording.bag_dir
    if named is not None or is_deployment_chosen(given) or has_recorded(folder):
        return loaded
    has_bags = folder.is_dir() and next(folders_with_bags(folder), None) is not None
    return load_for(None, [*LOOKING, *given]) if has_bags else loaded


def settings_to_look(
    bag_dir: Path | None, words: Sequence[str] | None, recording: str | None = None
) -> tuple[Path | None, list[str]]:
    """Returns the folder that the words or an option name, and the settings for it.

    They are those for bags of others, unless a recorder is at work there, or somebody chose a
    recorder, a storage or a deployment: among the words, or elsewhere for this folder.

    Raises:
        ConfigError: a variable or a setting is refused.
        InvalidArgumentsError: there is no such file or folder, or more than one is named.
    """
    paths = [word for word in words or () if _is_path(word)]
    given = [word for word in words or () if word not in paths]
    if len(paths) > 1:
        raise InvalidArgumentsError(f"one file or folder at a time: {' and '.join(paths)}")
    for path in map(Path, paths):
        if not path.exists():
            raise InvalidArgumentsError(
                f"{path}: there is no such file or folder; name a bag or a folder of bags, or "
                "write a setting as key=value"
            )
        if bag_dir is not None:
            raise InvalidArgumentsError(f"give {path} or --bag-dir {bag_dir}, not both")
        bag_dir = path
        if path.is_file():
            bag_dir, recording = _folder_of(path, recording)
    heartbeat = None if bag_dir is None else read_heartbeat(bag_dir.absolute()).heartbeat
    is_recorded_now = heartbeat is not None and heartbeat.is_live(WallClock().now())
    if bag_dir is not None and not is_recorded_now:
        is_chosen = is_deployment_chosen(given)
        if is_chosen and paths and not any(word.partition("=")[0] in GROUPS for word in given):
            deployed, _ = load_for(None, given)
            is_chosen = bag_dir.absolute() == deployed.recording.bag_dir.absolute()
        if not is_chosen:
            given = [*LOOKING, *given]
    if recording is not None:
        given.append(f"data.recording={quoted(recording)}")
    return bag_dir, given


def _is_path(word: str) -> bool:
    """Returns whether a word is a path: no setting has a slash in its name."""
    key, equals, _ = word.partition("=")
    return not equals or "/" in key or _exists(word)


def is_folder(word: str) -> bool:
    """Returns whether a word is a bag or a folder: a path that is there, and no JSON."""
    return "=" not in word and _exists(word)


def _exists(word: str) -> bool:
    try:
        return Path(word).exists()
    except (OSError, ValueError):  # a long setting
        return False


def _folder_of(file: Path, recording: str | None) -> tuple[Path, str | None]:
    """Returns the folder of a file, and the recording to look at there: the file itself."""
    if file.name == METADATA_FILE:
        return file.parent, recording
    if bag_kind(file.name) is None:
        kinds = ", ".join(BAG_KINDS)
        raise InvalidArgumentsError(f"{file} is not a bag: their names end in {kinds}")
    if recording is not None:
        raise InvalidArgumentsError(f"--recording is for a folder, and {file} is one bag")
    real = file.resolve()
    return real.parent, real.name


def require_recorder(settings: Settings) -> None:
    """Checks that this deployment records: only then may a command have bags deleted.

    Raises:
        ConfigError: it does not, or `data.recording` limits it to one recording, and others may
            contain the same messages.
    """
    if settings.data.recording is not None:
        raise ConfigError(
            f"data.recording={settings.data.recording}: deleting commands use all recordings; give "
            "data.recording=null, and --start and --end for a part of them"
        )
    if isinstance(settings.recorder, NullRecorderNode):
        raise ConfigError(
            "recorder=none: bags that another program records are not deleted here; choose the "
            "deployment that records them, such as deployment=robot"
        )


def open_memory(
    settings: Settings,
    *,
    verbose: bool,
    scans: bool = True,
    setting: str | None = None,
    cache_mb: int | None = None,
) -> "Memory":
    """Returns the memory of the configured bags, with an index of the directory as it is now.

    Without an index where it `scans` not, because the robots of a fleet are asked.
    `setting` is the one that names the bags, where it is another than `recording.bag_dir`,
    `cache_mb` as in `shared_parts`.
    `verbose` shows log events on stderr. Without it warnings are counted, and `reported_errors`
    prints the count when the command ends.

    Raises:
        ConfigError: an adapter cannot be built.
        InvalidArgumentsError: the configuration is that of a fleet, or lacks `data.recording`.
    """
    robots = settings.fleet.robots
    if robots and scans:
        name, folder = next(iter(robots.items()))
        raise InvalidArgumentsError(
            f"this looks at the bags of one robot: name them, e.g. --bag-dir {folder} for {name}; "
            f"the robots are {listed([*robots])} (fleet.robots); `ros2-memory ask` asks all of them"
        )
    # Imported here: `adopt`, `recover` and `config show` do without the libraries that answer.
    from ros2_memory.bootstrap import build_memory, shared_parts  # noqa: PLC0415

    configure_logging(settings.logging.level if verbose else "warning", settings.logging.format)
    if not verbose:
        withhold_warnings()
    memory = build_memory(settings, shared_parts(settings, cache_mb=cache_mb), setting=setting)
    if not scans:
        return memory
    with spinner(f"looking through {settings.recording.bag_dir}"):
        snapshot = memory.index.refresh()
    if settings.data.recording is not None and snapshot.problem:
        bag_dir = memory.index.bag_dir
        names = [str(folder.relative_to(bag_dir)) for folder in folders_with_bags(bag_dir)]
        near = similar(settings.data.recording, names)
        which = f"similar: {', '.join(near)}" if near else "`ros2-memory recordings` lists them"
        raise InvalidArgumentsError(f"{snapshot.problem}; {which}")
    return memory


def open_robot(
    settings: Settings, name: str, *, verbose: bool, cache_mb: int | None = None
) -> "tuple[Settings, Memory]":
    """Opens the memory of a robot of a fleet, or of the only one, which has no name.

    Returns its own settings, too.
    """
    from ros2_memory.bootstrap_fleet import ROBOTS_SETTING, robot_settings  # noqa: PLC0415 - as above

    own, setting = (robot_settings(settings, name), ROBOTS_SETTING) if name else (settings, None)
    return own, open_memory(own, verbose=verbose, setting=setting, cache_mb=cache_mb)


def present_time(memory: "Memory") -> Ns:
    """Returns the time that ages count from: the wall clock, or the newest data (`data.now`)."""
    now = memory.clock.now()
    if memory.limits.now == "wall":  # A fleet has no bags of its own, which a scan would report.
        return now
    return memory.now(now, memory.index.snapshot().dating.latest)


def parse_duration(text: str) -> float | None:
    """Returns the seconds of a duration as people write it (`90s`, `10m`, `2h`, `3d`) or None."""
    match = _AGO.fullmatch(text.strip().lower())
    return None if match is None else float(match[1]) * _SECONDS_OF[match[2][0]]


def parse_time(text: str, now: float) -> float:
    """Returns the Unix seconds of a time as people write it; see `TIMES`.

    `now` is what "ago", "today" and a time of day count from, in Unix seconds.

    Raises:
        InvalidArgumentsError: the text is no time.
    """
    words = text.strip().lower()
    if words == "now":
        return now
    with suppress(ValueError):
        number = float(words)
        try:
            require_no_date(number)
        except ValueError as error:
            raise InvalidArgumentsError(f"{text} {error}") from None
        if abs(number) > _LARGEST_UNIX_S:
            seconds = number / (1e9 if abs(number) > _LARGEST_UNIX_S * 1e4 else 1e3)
            raise InvalidArgumentsError(
                f"{text} is too large for Unix seconds; in seconds it is {seconds:.3f}"
            )
        return number
    ago = parse_duration(words)
    if ago is not None:
        return now - ago
    with suppress(ValueError, OverflowError, OSError):
        return unix_from_text(with_date(text, now))
    raise InvalidArgumentsError(f"{text!r} is not a time; write {TIMES}")


def parse_end(text: str, now: float, start: float) -> float:
    """Returns the Unix seconds at which a window ends that starts at a time; see `window_end_s`.

    Raises:
        InvalidArgumentsError: the text is no time.
    """
    return window_end_s(with_date(text, now), parse_time(text, now), start)


def with_date(text: str, now: float) -> str:
    """Returns `today`, `yesterday`, or a time of day, as ISO 8601; any other text as it is.

    `now`, in Unix seconds, is what they count from.
    """
    clock = _TIME_OF_DAY.fullmatch(text.strip().lower())
    if clock is None:
        return text
    today = datetime.fromtimestamp(now).astimezone().date()
    date = today - timedelta(days=clock[1] == "yesterday")
    return f"{date}T{clock[2]}" if clock[2] else date.isoformat()


def newest_day(memory: "Memory") -> TimeWindow:
    """Returns the newest day of data in this machine's calendar, from midnight to midnight."""
    newest = memory.index.snapshot().dating.latest
    at = unix_from_ns(memory.clock.now() if newest is None else newest)
    date = datetime.fromtimestamp(at).astimezone().date()
    days = (date, date + timedelta(days=1))
    begin, end = (datetime.combine(day, time.min).timestamp() for day in days)
    return TimeWindow(ns_from_unix(begin), ns_from_unix(end))


@dataclass(frozen=True, kw_only=True)
class Bags:
    """The options of a command that looks at bags."""

    words: Words = None
    bag_dir: BagDir = None
    recording: Recording = None
    verbose: Verbose = False

    def settings(self, *more: str) -> Settings:
        """Loads the configuration as `load_to_look` does; `more` are further settings."""
        return load_to_look(self.bag_dir, [*(self.words or ()), *more], self.recording)[0]

    def memory(self, *more: str) -> "Memory":
        """Opens the memory of these bags as `open_memory` does; `more` are further settings."""
        return open_memory(self.settings(*more), verbose=self.verbose)


@dataclass(frozen=True, kw_only=True)
class Times:
    """The options of a command that takes a time window."""

    start: Annotated[str | None, "TIME", f"Start time: {TIMES}; local time."] = None
    end: Annotated[str | None, "TIME", "End time, inclusive, in the same formats."] = None
    last: Last = None

    @property
    def are_bounded(self) -> bool:
        """Whether the window has two ends."""
        return self.last is not None or None not in (self.start, self.end)

    def window(self, memory: "Memory") -> TimeWindow:
        """Returns the window; a side that is not given is open.

        Raises:
            InvalidArgumentsError: the options contradict each other, or one is not a time.
        """
        return self.window_at(unix_from_ns(present_time(memory)))

    def window_at(self, now: float) -> TimeWindow:
        """Returns the window where "ago" counts from `now` (Unix s); raises likewise."""
        if self.last is None:
            first = unix_from_ns(MIN_NS) if self.start is None else parse_time(self.start, now)
            until = unix_from_ns(MAX_NS)
            if self.end is not None:
                until = parse_end(self.end, now, first)
            return TimeWindow.from_unix(first, until)
        if self.start is not None or self.end is not None:
            raise InvalidArgumentsError("give --last, or --start and --end, not both")
        if not self.last > 0:
            raise InvalidArgumentsError(f"--last is {self.last:g}; it must be more than 0 seconds")
        return TimeWindow.from_unix(now - self.last, now)


def as_command(name: str) -> Callable[[Command], Command]:
    """Returns what makes a function a command that reports its errors under a name.

    A parameter whose type is a dataclass, as `Bags` and `Times` are, becomes the options of that,
    in its place. It returns its exit code, or whether something was left undone (`EXIT_NEGATIVE`).

    An annotation such as `Annotated[float, "S", "Seconds between updates."]` declares an option, by
    the names that it has besides that of the parameter, what its value is, and the line of help.
    """

    def made(command: Command) -> Command:
        parameters = signature(command).parameters
        groups = {
            parameter.name: parameter.annotation
            for parameter in parameters.values()
            if hasattr(parameter.annotation, "__dataclass_fields__")
        }

        @wraps(command)
        def run(**given: object) -> None:
            for group, kind in groups.items():
                own = {option: given.pop(option) for option in signature(kind).parameters}
                given[group] = kind(**own)
            with reported_errors(name):
                raise typer.Exit(int(command(**given) or 0))

        options = [
            option.replace(kind=option.KEYWORD_ONLY, annotation=_declared(option))
            for parameter in parameters.values()
            for option in (
                signature(groups[parameter.name]).parameters.values()
                if parameter.name in groups
                else [parameter]
            )
        ]
        run.__signature__ = Signature(options)  # type: ignore[attr-defined]  # typer reads it
        return run

    return made


def _declared(option: Parameter) -> object:
    """Returns the annotation of an option as Typer takes it; others as they are."""
    kind, *more, line = get_args(option.annotation) or (None, None)
    if not isinstance(line, str):
        return option.annotation
    names = [text for text in more if text.startswith("-")]
    if kind is bool and not names:
        names = [f"--{option.name.replace('_', '-')}"]
    metavar = next((text for text in more if text not in names), None)
    return Annotated[kind, typer.Option(*names, metavar=metavar, help=line)]


def reason_of(error: Exception) -> str:
    """Returns an error as a sentence; one of the system as its file and its reason."""
    if not isinstance(error, OSError) or error.strerror is None:
        return str(error)
    return ": ".join(str(part) for part in (error.filename, error.strerror) if part)


@contextmanager
def reported_errors(command: str) -> Iterator[None]:
    """Prints an error of the block as one line on stderr, and exits with code 2.

    Also prints how many warnings were logged and not shown.
    """
    try:
        yield
    except BrokenPipeError:
        # Or Python would write to the closed pipe once more when it exits, and complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(EXIT_NEGATIVE) from None
    except (EpisodicError, OSError) as error:
        lines = "\n".join(map(with_local_times, reason_of(error).split("\n")))
        print(f"ros2-memory {command}: {lines}", file=sys.stderr)
        raise typer.Exit(EXIT_CANNOT_RUN) from None
    finally:
        if events := withheld_warnings():
            names = listed([event if n == 1 else f"{n} x {event}" for event, n in events.items()])
            advice = "" if command == "doctor" else ", `ros2-memory doctor` says what to do"
            logged = counted(events.total(), "warning")
            print(
                f"ros2-memory: {logged} logged ({names}); -v shows the log{advice}", file=sys.stderr
            )


@contextmanager
def lines_as_json(as_json: bool, *, is_answered: bool) -> Iterator[None]:
    """Has a command with --json print its lines at its end, as one JSON object.

    `stays` are those on what it left as it is, `lines` all others.

    Raises:
        InvalidArgumentsError: the command would have to ask.
    """
    if not as_json:
        yield
        return
    if not is_answered:
        raise InvalidArgumentsError("--json asks nothing: give --yes or --dry-run, too")
    try:
        with redirect_stdout(StringIO()) as printed:
            yield
    finally:
        lines = printed.getvalue().splitlines()
        stays = [line.removeprefix(STAYS) for line in lines if line.startswith(STAYS)]
        others = [line for line in lines if not line.startswith(STAYS)]
        print_json({"lines": others, "stays": stays})
