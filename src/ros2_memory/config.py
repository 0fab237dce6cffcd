"""The configuration: its models, and how it is loaded, once, at start.

Hydra composes it and Pydantic validates it. Later wins: `config.yaml`, a deployment preset
(`MEMORY_DEPLOYMENT`), the named environment variables, `MEMORY_CONFIG_OVERRIDES`, the overrides of
the command line. An empty variable counts as unset. `.env` is never read here: the shell, Docker
and systemd do that. Every fault becomes a line of one `ConfigError`: the key, the value, what is
allowed, and who set it.

The models are plain frozen data. Values are strict: `true` is not a number and `"10"` is not a
duration. Sizes in `_gb` are 10^9 bytes, in `_mb` 2^20 bytes. Defaults are in `config/config.yaml`
alone.
"""

from __future__ import annotations

import glob
import os
import re
import sys
from contextlib import contextmanager, suppress
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Final,
    Literal,
    TypeAlias,
    TypeVar,
    cast,
    dataclass_transform,
    get_args,
    get_type_hints,
)

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, ListConfig, OmegaConf
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, ValidationInfo
from pydantic.dataclasses import dataclass
from pydantic_core import to_jsonable_python

from ros2_memory.config_errors import (
    OpenSecretError,
    foreign_errors_as_config_error,
    line_of,
    validated,
)
from ros2_memory.config_sources import (
    GROUPS,
    INTERFACES_VARIABLE,
    Sources,
    expand_home,
    given_variables,
    parse_overrides,
)
from ros2_memory.core.errors import ConfigError
from ros2_memory.things.labels import singular

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.core.reply import JsonObject

_T = TypeVar("_T")

EXIT_CODE: Final = 2
_MOST: Final = 10**9
"""The largest number: in seconds a thread can wait so long, in GB a file system counts so far."""
_SECRET_WORDS: Final = ("secret", "password", "token", "credential", "access-key", "key-id", "auth")
"""Settings of pyiceberg with one of these in their name are not shown, so not given openly."""


def _home_expanded(path: Path) -> Path:
    if path == Path():
        raise ValueError("must name a path")
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise ValueError(f"must be a path that can be found: {error}") from error


def _in_config_dir(path: Path, info: ValidationInfo[Sequence[Path]]) -> Path:
    """Resolves `config/x` against the first of the given folders that has it, or the last one."""
    if path.parts[0] != "config":
        return path
    files = [folder.joinpath(*path.parts[1:]) for folder in info.context]
    return next((file for file in files if os.path.isfile(file)), files[-1])


def _existing_folder(path: Path) -> Path:
    if not os.path.isdir(path):
        raise ValueError("must be an existing folder")
    return path


def _written_as(pattern: str, what: str) -> AfterValidator:
    """Returns the check that a whole text matches a pattern; `what` says what it must be."""

    def checked(text: str) -> str:
        if not re.fullmatch(pattern, text, re.DOTALL):
            raise ValueError(f"must {what}")
        return text

    return AfterValidator(checked)


def is_robot_name(name: str) -> bool:
    """Returns whether a robot of a fleet may have a name: it could be no path."""
    return bool(re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", name)) and ".." not in name


def _robot_name(name: str) -> str:
    if not is_robot_name(name):
        raise ValueError(
            f"must name each robot by up to 64 letters, digits, '-', '_' and '.', not {name[:80]!r}"
        )
    return name


def _may_be_folder(path: str) -> bool:
    """Returns whether it is a folder, or the disk does not tell: a robot may be out of reach."""
    try:
        return Path(path).is_dir()
    except OSError:
        return True


def _robots_found(value: object) -> object:
    """Returns the robots of a pattern such as `/data/*/bags`, by what its `*` stands for."""
    if value is None:
        raise ValueError("must name robots: {r1: /data/r1/bags, ...}, or a pattern: /data/*/bags")
    if not isinstance(value, str):
        return value
    pattern = str(expand_home(value))
    before, star, after = pattern.partition("*")
    if not star or any(mark in after for mark in "*?[") or any(mark in before for mark in "?["):
        raise ValueError("must have one *, which stands for the robot's name, as /data/*/bags has")
    folders = [*filter(_may_be_folder, sorted(glob.glob(pattern)))]  # noqa: PTH207
    if not folders:
        raise ValueError("must match the folders of robots, and matches none")
    return {folder[len(before) : len(folder) - len(after)]: folder for folder in folders}


def _without_streamable(transport: object) -> object:
    """Returns `http` for what the specification, and the SDK of MCP, call it."""
    return "http" if transport in ("streamable_http", "streamable-http") else transport


def _without_password(uri: str) -> str:
    if "@" in uri.partition("://")[2].partition("/")[0]:
        raise OpenSecretError("must name no user or password, which belong into lake.secrets_file")
    return uri


def _without_secrets(properties: dict[str, str]) -> dict[str, str]:
    for name, value in properties.items():
        if any(word in name.lower() for word in _SECRET_WORDS):
            raise OpenSecretError(f"must not contain {name}: put it into lake.secrets_file")
        _without_password(value)
    return properties


def _one_star(pattern: str) -> str:
    if pattern.count("*") != 1:
        raise ValueError("must have one *, which stands for the robot's name")
    return str(expand_home(pattern))


def _each_spelling_once(labels: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """Checks that no spelling leads to two names; case, spacing and plurals do not count."""
    known: dict[str, tuple[str, str]] = {}
    for name, spellings in labels.items():
        for spelling in (name, *spellings):
            key = singular(spelling)
            if not key:
                raise ValueError(f"must not contain an empty spelling, as under {name!r}")
            first, other = known.setdefault(key, (spelling, name))
            if other != name:
                also = "" if first == spelling else f" (as {first!r})"
                raise ValueError(
                    f"must list each spelling under one label: {spelling!r} is under {other!r}"
                    f"{also} and {name!r}; case, spacing and plurals do not count"
                )
    return labels


def _engine_chosen(engine: object) -> object:
    if isinstance(engine, dict) and "_target_" not in engine:
        raise ValueError("must go with lake=duckdb: choose that, too, or leave this out")
    return engine


def _listed(value: object) -> object:
    """Takes one path for a list of one."""
    return [value] if isinstance(value, str) and value else value


Text: TypeAlias = Annotated[str, Field(strict=True, min_length=1)]
Flag: TypeAlias = Annotated[bool, Field(strict=True)]
Metres: TypeAlias = Annotated[float, Field(allow_inf_nan=False)]
Count: TypeAlias = Annotated[int, Field(strict=True, gt=0, le=_MOST)]
Mebibytes: TypeAlias = Annotated[int, Field(strict=True, gt=0, le=1024)]
Port: TypeAlias = Annotated[int, Field(strict=True, ge=0, le=65535)]
Positive: TypeAlias = Annotated[float, Field(strict=True, gt=0, le=_MOST, allow_inf_nan=False)]
Tolerance: TypeAlias = Annotated[float, Field(strict=True, ge=0, le=_MOST, allow_inf_nan=False)]
Span: TypeAlias = Annotated[float, Field(strict=True, ge=0, le=3600)]
AnyPath: TypeAlias = Annotated[Path, AfterValidator(_home_expanded)]
Folder: TypeAlias = Annotated[AnyPath, AfterValidator(_existing_folder)]
ConfigFile: TypeAlias = Annotated[AnyPath, AfterValidator(_in_config_dir)]
MessageType: TypeAlias = Annotated[
    Text, _written_as(r"\w+/msg/\w+", "be a message type such as nav_msgs/msg/Odometry")
]
BelowBagDir: TypeAlias = Annotated[
    Text,
    _written_as(
        r"(?!/|(.*/)?\.\.(/|$)).*[^/. ].*",
        "be a path below recording.bag_dir, such as rec_20261120T043000Z",
    ),
]
TopicGlob: TypeAlias = Annotated[
    Text, _written_as("[/*].*", "be a topic's name or a glob of such: it begins with / or *")
]
DotPath: TypeAlias = Annotated[
    Text, _written_as(r"\w+(\.\w+)*", "be a dot-path such as pose.pose.position")
]
RobotName: TypeAlias = Annotated[Text, AfterValidator(_robot_name)]


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(Field,))
def section(model: type[_T]) -> type[_T]:
    """Makes a class plain frozen data, whose values are checked; unknown keys are refused."""
    checked = dataclass(
        frozen=True, slots=True, kw_only=True, config=ConfigDict(extra="forbid", defer_build=True)
    )
    return cast("type[_T]", checked(model))


@section
class RequiredTopic:
    """A name or a glob of topics without which recording counts as failed, and the least rate."""

    topic: Text
    min_hz: Tolerance = 0.0


def _topic_alone(value: object) -> object:
    """Takes a name for an entry without a rate."""
    return {"topic": value} if isinstance(value, str) else value


RequiredTopics: TypeAlias = tuple[Annotated[RequiredTopic, BeforeValidator(_topic_alone)], ...]


@section
class RecordingSettings:
    """What is recorded, and where to.

    `split_duration_s` is an integer because `ros2 bag record` takes whole seconds. `keep_when` is
    the file of rules that keep what was recorded around an event, `exclude_when` that of rules by
    which nothing recorded stays.
    """

    bag_dir: AnyPath
    split_duration_s: Count
    session_duration_s: Positive
    queue_mb: Mebibytes
    use_sim_time: Flag
    clear_on_startup: Flag
    topics_file: ConfigFile
    keep_when: ConfigFile
    exclude_when: ConfigFile
    required: RequiredTopics


@section
class LatchedTopics:
    """Names or globs of topics that count as latched whatever QoS is offered, or never do."""

    include: tuple[TopicGlob, ...]
    exclude: tuple[TopicGlob, ...]


@section
class DataSettings:
    """How recorded data is interpreted.

    Positions are given in `map_frame` where transforms lead there. Detections whose score is below
    `min_score` count only where a call asks for them. "Ago" is relative to `now`: the wall clock,
    or the newest message. `tf_clock` is the time that orders transforms: header stamps,
    log time, or stamps where the two agree. Where `recording` is set, no other recording answers.
    """

    recording: BelowBagDir | None
    max_array_length: Count
    position_tolerance_m: Tolerance
    min_score: Tolerance
    labels_file: ConfigFile | None
    time_tolerance_s: Tolerance
    pose_topic: Text
    map_frame: Text | None
    tf_topics: tuple[Text, ...]
    tf_static_topics: tuple[Text, ...]
    now: Literal["wall", "latest"]
    tf_clock: Literal["auto", "stamp", "log"]
    max_plausible_speed_mps: Positive
    latched_topics: LatchedTopics
    places_file: ConfigFile


@section
class ReaderSettings:
    """How bags are found and decoded.

    `include_active`: complete chunks of the split that is being written are read, too.
    """

    index_refresh_s: Positive
    include_active: Flag
    custom_msg_paths: tuple[Folder, ...]
    chunk_cache_mb: Count
    max_chunk_mb: Mebibytes
    schemas_file: ConfigFile


@section
class StoreSettings:
    """How much of the bags is also stored as columns, which changes how long answers take alone.

    `max_share` is of the bags' bytes. `max_gb` is for a store in a cache folder; beside the bags
    retention bounds it.
    """

    enabled: Flag
    max_share: Annotated[float, Field(strict=True, ge=0, le=1)]
    max_gb: Positive
    cache_mb: Count


@section
class TopicLife:
    """How old the messages of some topics may become."""

    max_age_h: Positive


@section
class RetentionSettings:
    """How much history is kept.

    `max_moments_gb` is the part of the total that saved moments may take, at most half of it.
    `foreign`: whether bags of other programs are left alone, or counted and deleted as its own.
    `require_shipped`: whether age deletes no bag before `ros2-memory ship` has confirmed it.
    `topics` has, by a name or glob of topics, how old their messages may become; then they are cut
    out of bags that stay.
    """

    max_total_gb: Positive
    max_age_h: Positive
    min_free_gb: Tolerance
    max_moments_gb: Tolerance
    foreign: Literal["keep", "delete"]
    require_shipped: Flag
    topics: dict[TopicGlob, TopicLife]


@section
class MemorySettings:
    """What stays of bags that retention deletes: nothing, unless `keep` is true.

    `texts` are names or globs of topics of which texts stay, too; `labels` are the labels of people
    that stay, `people` are more words for people. `max_share` is of `retention.max_total_gb`.
    """

    keep: Flag
    texts: tuple[TopicGlob, ...]
    labels: tuple[Text, ...]
    people: tuple[Text, ...]
    max_share: Annotated[float, Field(strict=True, gt=0, le=0.5)]
    max_age_d: Positive


@section
class ServerSettings:
    """How the query server is reached, and what it offers. Port 0 is any free port.

    `tools`: all, or those of the specification; `write_tools`: also those that write. `metrics` and
    `traces` need the extra `observability`. `keep_questions`: how many of the latest calls are kept
    in memory, with their replies, for the page; 0 for none. `page`: whether that is served.
    """

    name: Text
    transport: Annotated[Literal["stdio", "sse", "http"], BeforeValidator(_without_streamable)]
    host: Text
    port: Port
    call_timeout_s: Positive
    max_reply_chars: Annotated[int, Field(strict=True, ge=1000)]
    tools: Literal["all", "spec"]
    write_tools: Flag
    page: Flag
    keep_questions: Annotated[int, Field(strict=True, ge=0, le=1000)]
    metrics: Flag
    traces: Flag


@section
class FleetSettings:
    """The robots that one server answers for; none where it answers for `recording.bag_dir`.

    `robots` has the bag directory of each by its name; it may be given as a pattern. `places` is
    the pattern of the robots' own files of named places. `shared_map`: whether coordinates mean the
    same place for all. `tokens` has, by the file of a token, the robots that it may ask about.
    """

    robots: Annotated[dict[RobotName, AnyPath], BeforeValidator(_robots_found)]
    places: Annotated[Text, AfterValidator(_one_star)] | None
    shared_map: Flag
    tokens: dict[AnyPath, tuple[RobotName, ...]]

    def __post_init__(self) -> None:
        """Refuses tokens for robots that there are not."""
        for file, names in self.tokens.items():
            if unknown := sorted({*names} - self.robots.keys()):
                raise ValueError(
                    f"must have in tokens, under {file}, robots of the fleet, not {unknown[0]}"
                )


@section
class LoggingSettings:
    """What is logged, and in which format."""

    level: Literal["debug", "info", "warning", "error"]
    format: Literal["json", "pretty"]
    arguments: bool


@section
class AdapterNode:
    """An adapter's class, and the values for its constructor that only this adapter takes.

    Each adapter that may be built has a subclass. They are the allow-list, since Hydra would build
    whatever a `_target_` names.
    """

    target: Text = Field(alias="_target_")

    @property
    def arguments(self) -> dict[str, object]:
        """Returns the constructor's keyword arguments."""
        return {name: value for name, value in asdict(self).items() if name != "target"}


@section
class McapNode(AdapterNode):
    """`storage=mcap`: single MCAP files."""

    target: Literal["ros2_memory.storage.mcap_reader.McapReader"] = Field(alias="_target_")


@section
class Rosbag2Node(AdapterNode):
    """`storage=rosbag2`: recordings of either plugin; `unpack_max_mb` bounds temporary files."""

    target: Literal["ros2_memory.storage.rosbag2_reader.Rosbag2Reader"] = Field(alias="_target_")
    unpack_max_mb: Count


@section
class Ros2BagNode(AdapterNode):
    """`recorder=ros2bag`: a supervised `ros2 bag record`."""

    target: Literal["ros2_memory.recorder.ros2bag.Ros2BagRecorder"] = Field(alias="_target_")
    setup_files: Annotated[tuple[AnyPath, ...], BeforeValidator(_listed)]
    repeat_latched: tuple[Text, ...]
    chunk_bytes: Annotated[int, Field(strict=True, ge=1024, le=_MOST)]


@section
class NullRecorderNode(AdapterNode):
    """`recorder=none`: nothing is recorded."""

    target: Literal["ros2_memory.recorder.null.NullRecorder"] = Field(alias="_target_")


@section
class DuckdbNode(AdapterNode):
    """`lake=duckdb`: DuckDB, in a process of its own for each statement."""

    target: Literal["ros2_memory.lake.engine.Lake"] = Field(alias="_target_")
    memory_mb: Count
    threads: Count | None


@section
class LakeSettings:
    """Where `ros2-memory ship` writes the bags of the fleet's robots; needs the extra `lake`.

    `engine` is what a fleet's server asks it with; None for a server that asks no lake.
    Secrets are in a file of their own, or where the store's own client looks for them (AWS_*).
    """

    engine: Annotated[DuckdbNode | None, BeforeValidator(_engine_chosen)]
    warehouse: Annotated[Text, AfterValidator(_without_password)] | None
    catalog: Literal["sql", "rest"]
    uri: Annotated[Text, AfterValidator(_without_password)] | None
    state_dir: AnyPath | None
    properties: Annotated[dict[Text, Text], AfterValidator(_without_secrets)]
    secrets_file: AnyPath | None
    messages: tuple[Text, ...]
    commit_interval_s: Tolerance
    grace_h: Tolerance

    def __post_init__(self) -> None:
        """Refuses a REST catalogue without an address."""
        if self.catalog == "rest" and self.uri is None:
            raise ValueError("must have in uri the address of the catalogue, with catalog=rest")


@section
class MessageSchemas:
    """The schema map: for each message type, field name to dot-path in the message."""

    schemas: dict[MessageType, dict[Text, DotPath]]


@section
class LabelsFile:
    """Other spellings of labels: for each name that is to be shown, what detectors write for it."""

    labels: Annotated[dict[Text, tuple[Text, ...]], AfterValidator(_each_spelling_once)]


@section
class PlaceShape:
    """A circle (x, y, radius_m), a rectangle (x and y as [from, to]) or a polygon, in metres.

    `frame` is the frame of its coordinates; without it, `data.map_frame`.
    """

    frame: Text | None = None
    x: Metres | tuple[Metres, Metres] | None = None
    y: Metres | tuple[Metres, Metres] | None = None
    radius_m: Positive | None = None
    polygon: tuple[tuple[Metres, Metres], ...] | None = None

    def __post_init__(self) -> None:
        """Refuses what is not exactly one of the three shapes."""
        x, y = self.x, self.y
        circle = isinstance(x, float) and isinstance(y, float) and self.radius_m is not None
        box = isinstance(x, tuple) and isinstance(y, tuple) and x[0] < x[1] and y[0] < y[1]
        alone = x is None and y is None
        if self.polygon is not None:
            is_shape = alone and self.radius_m is None and not _lie_in_a_line(self.polygon)
        else:
            is_shape = circle or (box and self.radius_m is None)
        if not is_shape:
            raise ValueError(
                "must be a circle (x, y, radius_m), a rectangle (x: [from, to], y: [from, to]) "
                "or a polygon of 3 corners or more ([[x, y], ...]) that do not lie in a line"
            )


def _lie_in_a_line(corners: Sequence[tuple[float, float]]) -> bool:
    (x, y), *others = corners or [(0.0, 0.0)]
    return all(
        (bx - x) * (cy - y) == (by - y) * (cx - x) for (bx, by), (cx, cy) in combinations(others, 2)
    )


@section
class PlacesFile:
    """The named places."""

    places: dict[Text, PlaceShape]


@section
class KeepRule:
    """When what was recorded is kept as a moment, and how much of it.

    `topic`, `condition_type`, `value`, `field` and `min_score` as in `find_matches`; `for_s` is how
    long the condition, or a silence, must hold. A moment has `before_s` before the match began and
    `after_s` after the rule fired. All moments of the rule together take `max_gb` at most.
    """

    kind: Literal["message", "silent", "recorder_restart"] = "message"
    topic: Text | None = None
    condition_type: Text | None = None
    value: bool | int | float | str | dict[str, float] | None = None
    field: Text | None = None
    min_score: Tolerance | None = None
    for_s: Tolerance = 0.0
    before_s: Span = 30.0
    after_s: Span = 30.0
    label: Text | None = None
    max_gb: Positive = 0.1
    max_per_hour: Count = 6

    def __post_init__(self) -> None:
        """Refuses a rule that lacks what its kind needs, or has what it does not know."""
        tests = self.condition_type is not None and self.value is not None
        has_test = tests or self.field is not None or self.min_score is not None
        if self.kind == "message":
            if self.topic is None or not tests:
                raise ValueError("must have topic, condition_type and value, as find_matches has")
        elif has_test:
            raise ValueError(f"must not have a condition: its kind is {self.kind}")
        elif self.kind == "silent":
            if self.topic is None or not self.for_s:
                raise ValueError("must have topic and for_s: its kind is silent")
        elif self.topic is not None or self.for_s:
            raise ValueError(f"must have neither topic nor for_s: its kind is {self.kind}")


@section
class TriggersFile:
    """The rules, by name."""

    rules: dict[Text, KeepRule]


@section
class ExcludeRule:
    """When nothing recorded stays, nor what was within `margin_s` of it.

    `topic`, `condition_type`, `value`, `field` and `min_score` as in `find_matches`, of one topic.
    A message of it holds until the next one, for `stale_s` at most where the topic is not latched.
    `on_unknown`: what becomes of a time in which it is not known whether the condition holds.
    """

    topic: Annotated[Text, _written_as(r"[^*?\[]*", "name one topic; make a rule for each")]
    condition_type: Text
    value: bool | int | float | str | dict[str, float]
    field: Text | None = None
    min_score: Tolerance | None = None
    margin_s: Span = 1.0
    stale_s: Annotated[float, Field(strict=True, gt=0, le=3600)] = 10.0
    on_unknown: Literal["exclude", "keep"] = "exclude"


@section
class ExclusionsFile:
    """The rules, by name."""

    rules: dict[Text, ExcludeRule]


@section
class Settings:
    """The whole configuration, validated."""

    recording: RecordingSettings
    data: DataSettings
    reader: ReaderSettings
    store: StoreSettings
    retention: RetentionSettings
    memory: MemorySettings
    server: ServerSettings
    fleet: FleetSettings
    lake: LakeSettings
    logging: LoggingSettings
    storage: Annotated[McapNode | Rosbag2Node, Field(discriminator="target")]
    recorder: Annotated[Ros2BagNode | NullRecorderNode, Field(discriminator="target")]


_NODES: Final = {
    get_args(get_type_hints(node)["target"])[0]: node
    for node in (McapNode, Rosbag2Node, Ros2BagNode, NullRecorderNode, DuckdbNode)
}
"""The class of an adapter's section by its `_target_`."""


def load_settings(overrides: Sequence[str] = (), env: Mapping[str, str] | None = None) -> Settings:
    """Returns the validated configuration.

    Args:
        overrides: assignments in Hydra's grammar (`server.port=9300`, `recorder=none`).
        env: the environment; the process's own where None.

    Raises:
        ConfigError: a file, a variable or an override is refused.
    """
    return load_explained(overrides, env)[0]


def load_explained(
    overrides: Sequence[str], env: Mapping[str, str] | None = None
) -> tuple[Settings, Sources]:
    """Returns the configuration as `load_settings` does, and the source of each of its keys.

    Raises:
        ConfigError: as `load_settings`.
    """
    given = given_variables(os.environ if env is None else env)
    folder = config_dir(given)
    appended = {"reader.custom_msg_paths": INTERFACES_VARIABLE}
    sources = Sources(
        folder,
        parse_overrides(overrides, given, folder),
        appended if INTERFACES_VARIABLE in given else {},
    )
    with foreign_errors_as_config_error(str(folder), sources):
        with initialize_config_dir(version_base="1.3", config_dir=str(folder)):
            composed = compose(
                "config", overrides=[override.text for override in sources.overrides]
            )
        _append_interface_folder(composed, given)
        data = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    # What users keep beside them wins over what is shipped, unless they chose a folder.
    folders = [folder] if "MEMORY_CONFIG_DIR" in given else [Path("config").absolute(), folder]
    settings = validated(Settings, data, config_dirs=folders, source=sources, adapters=_NODES)
    return settings, sources


def is_deployment_chosen(overrides: Sequence[str]) -> bool:
    """Returns whether someone chose a configuration directory, or an option of a group.

    It composes nothing.

    Raises:
        ConfigError: a variable or an override is refused.
    """
    given = given_variables(os.environ)
    parsed = parse_overrides(overrides, given, config_dir(given))
    return "MEMORY_CONFIG_DIR" in given or any(override.key in GROUPS for override in parsed)


def plain_values(settings: Settings) -> JsonObject:
    """Returns the configuration as JSON values, under the names that the files have."""
    values: JsonObject = to_jsonable_python(settings, by_alias=True)
    return values


def config_dir(env: Mapping[str, str]) -> Path:
    """Returns the absolute path of the folder that holds `config.yaml` and its groups.

    It is `MEMORY_CONFIG_DIR`, else the copy in an installed package, else the checkout's `config/`.

    Raises:
        ConfigError: there is no `config.yaml` in it.
    """
    package = Path(__file__).resolve().parent
    chosen = env.get("MEMORY_CONFIG_DIR")
    if chosen:
        folder = expand_home(chosen).absolute()
    elif (package / "_config").is_dir():
        folder = package / "_config"
    else:
        folder = package.parents[1] / "config"
    if not os.path.isfile(folder / "config.yaml"):
        raise ConfigError(
            f"MEMORY_CONFIG_DIR: {str(folder)!r} is not allowed; must be a folder with a "
            "config.yaml, laid out as the repository's config/"
        )
    return folder


def files_in_use(settings: Settings) -> list[str]:
    """Returns the paths of the configuration's files, with those that its keys name."""
    recording, data = settings.recording, settings.data
    named = (
        config_dir(os.environ) / "config.yaml",
        recording.topics_file,
        recording.keep_when,
        recording.exclude_when,
        data.labels_file,
        data.places_file,
        settings.reader.schemas_file,
    )
    return [str(path.absolute()) for path in named if path is not None]


def unused_config() -> str | None:
    """Returns that a `config/config.yaml` of the working directory is not used, if it is there.

    It may be another program's, and what it names is run (`recorder.setup_files`): one has to
    choose it.
    """
    used, beside = config_dir(os.environ) / "config.yaml", Path("config/config.yaml").absolute()
    if os.environ.get("MEMORY_CONFIG_DIR") or not beside.is_file():
        return None
    with suppress(OSError):
        if beside.read_bytes() == used.read_bytes():  # as in a clone
            return None
    return f"{beside} is not used, but {used}; MEMORY_CONFIG_DIR={beside.parent} chooses its folder"


def load_message_schemas(settings: Settings) -> Mapping[str, Mapping[str, str]]:
    """Returns the schema map of `reader.schemas_file`: message type to {field name: dot-path}.

    Raises:
        ConfigError: the file is missing, is not YAML, or its content is refused.
    """
    return _load_file(MessageSchemas, "reader.schemas_file", settings.reader.schemas_file).schemas


def load_labels(settings: Settings) -> Mapping[str, Sequence[str]]:
    """Returns the spellings of `data.labels_file` by the name to show; none where it is null.

    Raises:
        ConfigError: the file is missing, is not YAML, or its content is refused.
    """
    path = settings.data.labels_file
    return {} if path is None else _load_file(LabelsFile, "data.labels_file", path).labels


def load_places(settings: Settings) -> Mapping[str, PlaceShape]:
    """Returns the named places of `data.places_file`.

    Raises:
        ConfigError: the file is missing, is not YAML, or its content is refused.
    """
    return _load_file(PlacesFile, "data.places_file", settings.data.places_file).places


def load_rules(settings: Settings) -> Mapping[str, KeepRule]:
    """Returns the rules of `recording.keep_when`, by name.

    Raises:
        ConfigError: the file is missing, is not YAML, or its content is refused.
    """
    return _load_file(TriggersFile, "recording.keep_when", settings.recording.keep_when).rules


_FAILS_CLOSED: Final = (
    "Neither the recorder nor the server starts while these rules cannot be read: what they "
    "exclude could be recorded or served. Correct the file; to exclude nothing, let it contain "
    "only `rules: {}`"
)


def load_exclusions(settings: Settings) -> Mapping[str, ExcludeRule]:
    """Returns the rules of `recording.exclude_when`, by name.

    Raises:
        ConfigError: the file is missing, is not YAML, or its content is refused.
    """
    path = settings.recording.exclude_when
    try:
        return _load_file(ExclusionsFile, "recording.exclude_when", path).rules
    except ConfigError as error:
        raise ConfigError(f"{error}\n{_FAILS_CLOSED}") from error


def _load_file(model: type[_T], key: str, path: Path) -> _T:
    """Returns the content of a YAML file that a key names, as an instance of a model."""

    def source(fault: str) -> str:
        line = line_of(path, fault)
        return f"in {path}{f', line {line}' if line else ''}, which {key} names"

    with foreign_errors_as_config_error(f"{key}: {path}", source):
        data = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    return validated(model, data, config_dirs=[path.parent], source=source)


@contextmanager
def exit_on_config_error(program: str) -> Iterator[None]:
    """Ends the program with exit code 2 and an explanation on stderr on a `ConfigError`."""
    try:
        yield
    except ConfigError as error:
        sys.stderr.write(f"{program} cannot start, its configuration is refused:\n{error}\n")
        raise SystemExit(EXIT_CODE) from None


def _append_interface_folder(composed: DictConfig, given: Mapping[str, str]) -> None:
    """Appends `ROS_VISION_INTERFACES_PATH` to the folders of message definitions.

    Where the key does not hold a list, validation refuses it afterwards.
    """
    folder = given.get(INTERFACES_VARIABLE)
    if not folder:
        return
    if not os.path.isdir(expand_home(folder)):
        raise ConfigError(
            f"{INTERFACES_VARIABLE}: {folder!r} is not allowed; must be an existing folder "
            "of message packages (or one package, with msg/*.msg)"
        )
    paths = OmegaConf.select(composed, "reader.custom_msg_paths")
    if isinstance(paths, ListConfig):
        paths.append(folder)
