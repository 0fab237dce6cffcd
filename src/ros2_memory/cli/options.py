"""What the commands share: their options, how they open a memory, and how they print and fail.

Typer reads annotations at run time, so modules with commands do without `annotations` of
`__future__`.
"""

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, is_dataclass, replace
from datetime import datetime, timedelta
from functools import wraps
from inspect import Parameter, Signature, signature
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias, get_args

import typer

from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import METADATA_FILE, bag_kind, has_recorded
from ros2_memory.bag_dir.own_recordings import folders_with_bags
from ros2_memory.cli.output import escape, print_json, spinner
from ros2_memory.config import NullRecorderNode, Settings, is_deployment_chosen, load_settings
from ros2_memory.config_sources import GROUPS, quoted
from ros2_memory.core.errors import ConfigError, EpisodicError, InvalidArgumentsError
from ros2_memory.core.logging_setup import configure_logging
from ros2_memory.core.model import BAG_KINDS, TimeWindow
from ros2_memory.core.text import listed, similar
from ros2_memory.core.timebase import (
    MAX_NS,
    MIN_NS,
    Ns,
    WallClock,
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
    r"(\d+(?:\.\d+)?) ?([smhd]|sec|seconds?|min|minutes?|hours?|days?)?(?: ago)?"
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
"""Settings to read bags of other programs: of any kind, and "ago" counts from the newest data."""

AsJson = Annotated[bool, "--json", "Print JSON."]


def load_for(bag_dir: Path | None, overrides: Sequence[str] | None) -> Settings:
    """Loads the configuration as the server does.

    `bag_dir` wins over `recording.bag_dir`. It is the directory of one robot, so no fleet is
    configured then.

    Raises:
        ConfigError: the configuration is refused.
    """
    words = [*(overrides or ())]
    if bag_dir is None:
        return load_settings(words)
    words.append(f"recording.bag_dir={quoted(str(bag_dir.absolute()))}")
    settings = load_settings(words)
    return replace(settings, fleet=replace(settings.fleet, robots={}, tokens={}))


def load_given(bag_dir: Path | None, words: Sequence[str] | None) -> Settings:
    """Loads the configuration by `load_to_look` if a word is a path, else by `load_for`."""
    if any(map(_is_path, words or ())):
        return load_to_look(bag_dir, words)
    return load_for(bag_dir, words)


def load_to_look(
    bag_dir: Path | None, words: Sequence[str] | None, recording: str | None = None
) -> Settings:
    """Loads the configuration for a command that only reads bags; a PATH among its words wins.

    Bags that this deployment does not record are read with the settings `LOOKING`, unless the words
    choose a recorder, a storage or a deployment.

    Raises:
        ConfigError: the configuration is refused.
        InvalidArgumentsError: a PATH does not exist, or two are given.
    """
    named, settings_words = settings_to_look(bag_dir, words, recording)
    settings = load_for(named, settings_words)
    folder = settings.recording.bag_dir
    if named is None and not _is_chosen(settings_words) and not has_recorded(folder):
        has_bags = folder.is_dir() and next(folders_with_bags(folder), None) is not None
        if has_bags:
            return load_for(None, [*LOOKING, *settings_words])
    return settings


def settings_to_look(
    bag_dir: Path | None, words: Sequence[str] | None, recording: str | None = None
) -> tuple[Path | None, list[str]]:
    """Returns the folder of bags that the words or --bag-dir name, and the settings to read it.

    `LOOKING` is among the settings, unless a recorder is at work in the folder, or a recorder, a
    storage or a deployment was chosen: by the words, or by the environment for this very folder.

    Raises:
        ConfigError: a variable or a setting is refused.
        InvalidArgumentsError: a PATH does not exist, or two are given.
    """
    paths = [word for word in words or () if _is_path(word)]
    settings = [word for word in words or () if word not in paths]
    if len(paths) > 1:
        raise InvalidArgumentsError(f"one file or folder at a time: {' and '.join(paths)}")
    if paths:
        path = Path(paths[0])
        folder, recording = _folder_of(path, recording)
        if bag_dir is not None:
            raise InvalidArgumentsError(f"give {path} or --bag-dir {bag_dir}, not both")
        bag_dir = folder
    if bag_dir is not None and not _is_recorded_now(bag_dir):
        is_chosen = _is_chosen(settings)
        if is_chosen and paths and not any(word.partition("=")[0] in GROUPS for word in settings):
            deployed = load_for(None, settings)
            is_chosen = bag_dir.absolute() == deployed.recording.bag_dir.absolute()
        if not is_chosen:
            settings = [*LOOKING, *settings]
    if recording is not None:
        settings.append(f"data.recording={quoted(recording)}")
    return bag_dir, settings


def _is_chosen(words: Sequence[str]) -> bool:
    """Returns whether a deployment is chosen otherwise than by what `LOOKING` has anyway."""
    return is_deployment_chosen([word for word in words if word not in LOOKING])


def _is_recorded_now(bag_dir: Path) -> bool:
    heartbeat = read_heartbeat(bag_dir.absolute()).heartbeat
    return heartbeat is not None and heartbeat.is_live(WallClock().now())


def _is_path(word: str) -> bool:
    """Returns whether a word is a path, not a setting: `key=value` without a slash in the key."""
    key, equals, _ = word.partition("=")
    return not equals or "/" in key or _exists(word)


def is_folder(word: str) -> bool:
    """Returns whether a word is the path of a bag or a folder that exists, and not JSON."""
    key, equals, _ = word.partition("=")
    return (not equals or "/" in key) and _exists(word)


def _exists(word: str) -> bool:
    try:
        return Path(word).exists()
    except (OSError, ValueError):  # a setting that is too long for a path
        return False


def _folder_of(path: Path, recording: str | None) -> tuple[Path, str | None]:
    """Returns the folder that a path names, and which recording to read: of a bag itself alone.

    Raises:
        InvalidArgumentsError: it does not exist, or is a file and no bag.
    """
    if not path.exists():
        raise InvalidArgumentsError(
            f"{path}: there is no such file or folder; name a bag or a folder of bags, or "
            "write a setting as key=value"
        )
    if not path.is_file():
        return path, recording
    if path.name == METADATA_FILE:
        return path.parent, recording
    if bag_kind(path.name) is None:
        kinds = ", ".join(BAG_KINDS)
        raise InvalidArgumentsError(f"{path} is not a bag: their names end in {kinds}")
    if recording is not None:
        raise InvalidArgumentsError(f"--recording is for a folder, and {path} is one bag")
    real = path.resolve()
    return real.parent, real.name


def require_recorder(settings: Settings) -> None:
    """Checks that this deployment records: only then may a command delete bags.

    Raises:
        ConfigError: it does not record; or `data.recording` limits it to one recording, though
            others may contain the same messages.
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
    allows_fleet: bool = False,
    setting: str | None = None,
    hidden: tuple[str, ...] = (),
) -> "Memory":
    """Opens the memory of the configured bags, and indexes the directory as it is now.

    Args:
        settings: the configuration.
        verbose: whether log events are shown on stderr; otherwise errors alone.
        allows_fleet: whether the command also asks the robots of a fleet, whose memory has no bags
            of its own, and no index.
        setting: the setting that names the bags, if it is not `recording.bag_dir`.
        hidden: prefixes of the topics that are left out.

    Raises:
        ConfigError: an adapter cannot be built.
        InvalidArgumentsError: a fleet is not allowed, or `data.recording` does not exist.
    """
    robots = settings.fleet.robots
    if robots and not allows_fleet:
        name, folder = next(iter(robots.items()))
        raise InvalidArgumentsError(
            f"this looks at the bags of one robot: name them, e.g. --bag-dir {folder} for {name}; "
            f"the robots are {listed([*robots])} (fleet.robots); `ros2-memory ask` asks all of them"
        )
    # Imported here: `adopt`, `recover` and `config show` do without the libraries that answer.
    from ros2_memory.bootstrap import build_memory, shared_parts  # noqa: PLC0415

    configure_logging(settings.logging.level if verbose else "error", settings.logging.format)
    memory = build_memory(settings, shared_parts(settings), setting=setting, hidden=hidden)
    if robots:
        return memory
    with spinner(f"looking through {settings.recording.bag_dir}"):
        snapshot = memory.index.refresh()
    if settings.data.recording is not None and snapshot.problem:
        bag_dir = memory.bag_dir
        names = [str(folder.relative_to(bag_dir)) for folder in folders_with_bags(bag_dir)]
        near = similar(settings.data.recording, names)
        which = f"similar: {', '.join(near)}" if near else "`ros2-memory recordings` lists them"
        raise InvalidArgumentsError(f"{snapshot.problem}; {which}")
    return memory


def open_robot(settings: Settings, name: str, *, verbose: bool) -> "tuple[Settings, Memory]":
    """Opens the memory of a robot of the fleet; without a fleet the name is empty.

    Returns the settings of that robot, and its memory.
    """
    if not name:
        return settings, open_memory(settings, verbose=verbose)
    from ros2_memory import bootstrap_fleet as fleet  # noqa: PLC0415 - as above

    own, hidden = fleet.robot_settings(settings, name), fleet.hidden_topics(settings, name)
    return own, open_memory(own, verbose=verbose, setting=fleet.ROBOTS_SETTING, hidden=hidden)


def present_time(memory: "Memory") -> Ns:
    """Returns the time that ages count from: the wall clock, or the newest data (`data.now`)."""
    if memory.limits.now == "wall":  # A fleet has no bags of its own, which a scan would report.
        return memory.clock.now()
    return memory.now(memory.snapshot().dating.latest)


def parse_duration(text: str) -> float | None:
    """Returns the seconds of a text such as `90`, `90s`, `10m`, `2h` or `3d`; None of any other."""
    match = _AGO.fullmatch(text.strip().lower())
    if match is None:
        return None
    number, unit = match.groups()
    return float(number) * _SECONDS_OF[unit[0] if unit else "s"]


def parse_time(text: str, now: float) -> float:
    """Returns the Unix seconds of a time in one of the forms `TIMES`.

    `now` (Unix s) is what "ago", "today" and a time of day count from.

    Raises:
        InvalidArgumentsError: the text is no time.
    """
    words = text.strip().lower()
    if words == "now":
        return now
    try:
        number = float(words)
    except ValueError:
        ago_s = parse_duration(words)
        if ago_s is not None:
            return now - ago_s
        with suppress(ValueError, OverflowError, OSError):
            return unix_from_text(with_date(text, now))
        raise InvalidArgumentsError(f"{text!r} is not a time; write {TIMES}") from None
    try:
        require_no_date(number)
    except ValueError as error:
        raise InvalidArgumentsError(f"{text} {error}") from None
    if abs(number) > _LARGEST_UNIX_S:
        raise InvalidArgumentsError(f"{text} is too large for Unix seconds")
    return number


def with_date(text: str, now: float) -> str:
    """Returns `today`, `yesterday` or a time of day as ISO 8601, and any other text unchanged.

    `now` (Unix s) says which day is today.
    """
    match = _TIME_OF_DAY.fullmatch(text.strip().lower())
    if match is None:
        return text
    day, time_of_day = match.groups()
    date = datetime.fromtimestamp(now).astimezone().date()
    if day == "yesterday":
        date -= timedelta(days=1)
    return f"{date}T{time_of_day}" if time_of_day else date.isoformat()


@dataclass(frozen=True, kw_only=True)
class Bags:
    """The options of a command that looks at bags."""

    words: Words = None
    bag_dir: BagDir = None
    recording: Recording = None
    verbose: Verbose = False

    def settings(self, *more: str) -> Settings:
        """Loads the configuration as `load_to_look` does; `more` are further settings."""
        return load_to_look(self.bag_dir, [*(self.words or ()), *more], self.recording)

    def memory(self, *more: str) -> "Memory":
        """Opens the memory of these bags as `open_memory` does; `more` are further settings."""
        return open_memory(self.settings(*more), verbose=self.verbose)


@dataclass(frozen=True, kw_only=True)
class Times:
    """The options of a command that takes a time window."""

    start: Annotated[str | None, "TIME", f"Start time: {TIMES}; local time."] = None
    end: Annotated[str | None, "TIME", "End time, inclusive, in the same formats."] = None
    last: Annotated[
        str | None, "S", "The last S seconds, or 10m, 2h, 3d; instead of --start and --end."
    ] = None

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
        """Returns the window if "ago" counts from `now` (Unix s).

        Raises:
            InvalidArgumentsError: as `window`.
        """
        if self.last is not None:
            if self.start is not None or self.end is not None:
                raise InvalidArgumentsError("give --last, or --start and --end, not both")
            last_s = parse_duration(self.last)
            if last_s is None or not last_s > 0:
                raise InvalidArgumentsError(
                    f"--last is {self.last}; it must be more than 0 seconds, or 90s, 10m, 2h, 3d"
                )
            return TimeWindow.from_unix(now - last_s, now)
        start_s, end_s = unix_from_ns(MIN_NS), unix_from_ns(MAX_NS)
        if self.start is not None:
            start_s = parse_time(self.start, now)
        if self.end is not None:
            end_s = window_end_s(with_date(self.end, now), parse_time(self.end, now), start_s)
        return TimeWindow.from_unix(start_s, end_s)


def as_command(name: str) -> Callable[[Command], Command]:
    """Returns a decorator that makes a function a command, which reports errors under `name`.

    The function returns its exit code, or whether something was left undone (`EXIT_NEGATIVE`).

    A parameter whose type is a dataclass (`Bags`, `Times`) stands for all options of that class. A
    parameter such as `every: Annotated[float, "S", "Seconds between updates."]` is an option:
    after the type stand its names, if they are not `--every`, the metavar, and the line of help.
    """

    def decorate(command: Command) -> Command:
        groups: dict[str, type] = {}
        options: list[Parameter] = []
        for parameter in signature(command).parameters.values():
            group = parameter.annotation
            if is_dataclass(group) and isinstance(group, type):
                groups[parameter.name] = group
                options += signature(group).parameters.values()
            else:
                options.append(parameter)

        @wraps(command)
        def run(**given: object) -> None:
            for parameter_name, group in groups.items():
                own = {option: given.pop(option) for option in signature(group).parameters}
                given[parameter_name] = group(**own)
            with reported_errors(name):
                raise typer.Exit(int(command(**given) or 0))

        declared = [
            option.replace(kind=option.KEYWORD_ONLY, annotation=_typer_annotation(option))
            for option in options
        ]
        run.__signature__ = Signature(declared)  # type: ignore[attr-defined]  # typer reads it
        return run

    return decorate


def _typer_annotation(option: Parameter) -> object:
    """Returns the annotation of an option in Typer's form; leaves one in that form as it is."""
    kind, *more, help_line = get_args(option.annotation) or (None, None)
    if not isinstance(help_line, str):
        return option.annotation
    names = [text for text in more if text.startswith("-")]
    metavar = next((text for text in more if text not in names), None)
    if kind is bool and not names:  # else Typer adds a --no-... for each flag
        names = [f"--{option.name.replace('_', '-')}"]
    return Annotated[kind, typer.Option(*names, metavar=metavar, help=help_line)]


def reason_of(error: Exception) -> str:
    """Returns the text of an error; of an error of the system `FILE: REASON`."""
    if not isinstance(error, OSError) or error.strerror is None:
        return str(error)
    return ": ".join(str(part) for part in (error.filename, error.strerror) if part)


@contextmanager
def reported_errors(command: str) -> Iterator[None]:
    """Prints an error of the block on stderr, and exits with code 2."""
    try:
        yield
    except BrokenPipeError:
        # Or Python would write to the closed pipe once more when it exits, and complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(EXIT_NEGATIVE) from None
    except (EpisodicError, OSError) as error:
        lines = "\n".join(map(escape, reason_of(error).split("\n")))
        print(f"ros2-memory {command}: {lines}", file=sys.stderr)
        raise typer.Exit(EXIT_CANNOT_RUN) from None


@contextmanager
def lines_as_json(as_json: bool, *, is_answered: bool) -> Iterator[None]:
    """With --json: collects the lines that the block prints, and prints them as one JSON object.

    The lines on what the command left as it is are under `stays`, all others under `lines`.

    Raises:
        InvalidArgumentsError: the command would have to ask for confirmation (not `is_answered`).
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
