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
import math
import os
import re
import sys
from contextlib import contextmanager, suppress
from dataclasses import asdict
from itertools import combinations
from operator import attrgetter
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
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic.dataclasses import dataclass
from pydantic_core import to_jsonable_python

from ros2_memory.config_errors import (
    OpenSecretError,
    foreign_errors_as_config_error,
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
from ros2_memory.triggers import RuleKind

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.core.reply import JsonObject

_T = TypeVar("_T")

EXIT_CODE: Final = 2
_MOST: Final = 10**9
"""The largest number: a thread can wait so many seconds, a file system can have so many GB."""
_SECRET_WORDS: Final = ("secret", "password", "token", "credential", "access-key", "key-id", "auth")
"""A setting of pyiceberg whose name has one of these words is a secret."""


def _expand_home(path: Path) -> Path:
    if path == Path():
        raise ValueError("must name a path")
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise ValueError(f"must be a path that can be found: {error}") from error


def _in_config_dir(path: Path, info: ValidationInfo[Sequence[Path]]) -> Path:
    """Resolves `config/x` against the first given folder that has x, or the last one."""
    top, *rest = path.parts
    if top != "config":
        return path
    files = [folder.joinpath(*rest) for folder in info.context]
    return next((file for file in files if os.path.isfile(file)), files[-1])


def _require_folder(path: Path) -> Path:
    if not os.path.isdir(path):
        raise ValueError("must be an existing folder")
    return path


def _matching(pattern: str, rule: str) -> AfterValidator:
    """Returns the check that a whole text matches a pattern: else it "must RULE"."""

    def check(text: str) -> str:
        if not re.fullmatch(pattern, text, re.DOTALL):
            raise ValueError(f"must {rule}")
        return text

    return AfterValidator(check)


def _one_of_several(rule: str) -> WrapValidator:
    """Returns the check of a value of several types: others are refused, in one line."""

    def check(value: object, validate: ValidatorFunctionWrapHandler) -> object:
        try:
            return validate(value)
        except ValidationError:
            raise ValueError(f"must {rule}") from None

    return WrapValidator(check)


def is_robot_name(name: str) -> bool:
    """Returns whether a name is one for a robot of a fleet: no name can be a path."""
    return bool(re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", name)) and ".." not in name


def _require_robot_name(name: str) -> str:
    if not is_robot_name(name):
        raise ValueError(
            f"must name each robot by up to 64 letters, digits, '-', '_' and '.', not {name[:80]!r}"
        )
    return name


def _may_be_folder(path: str) -> bool:
    """Returns False if a path is no folder; True also if the disk fails: a robot may be away."""
    try:
        return Path(path).is_dir()
    except OSError:
        return True


def _expand_robots(value: object) -> object:
    """Replaces a pattern such as `/data/*/bags` by the folders it matches; `*` is the name."""
    if value is None:
        raise ValueError("must name robots: {r1: /data/r1/bags, ...}, or a pattern: /data/*/bags")
    if not isinstance(value, str):
        return value
    pattern = str(expand_home(value))
    before, star, after = pattern.partition("*")
    if not star or re.search(r"[*?[]", after) or re.search(r"[?[]", before):
        raise ValueError("must have one *, which stands for the robot's name, as /data/*/bags has")
    folders = [*filter(_may_be_folder, sorted(glob.glob(pattern)))]  # noqa: PTH207
    if not folders:
        raise ValueError("must match the folders of robots, and matches none")
    return {folder[len(before) : len(folder) - len(after)]: folder for folder in folders}


def _transport_name(transport: object) -> object:
    """Returns `http` for the names that the specification and MCP's SDK have for it."""
    return "http" if transport in ("streamable_http", "streamable-http") else transport


def _require_no_password(uri: str) -> str:
    if "@" in uri.partition("://")[2].partition("/")[0]:
        raise OpenSecretError("must name no user or password, which belong into lake.secrets_file")
    return uri


def _require_no_secrets(properties: dict[str, str]) -> dict[str, str]:
    for name, value in properties.items():
        if any(word in name.lower() for word in _SECRET_WORDS):
            raise OpenSecretError(f"must not contain {name}: put it into lake.secrets_file")
        _require_no_password(value)
    return properties


def _require_one_star(pattern: str) -> str:
    if pattern.count("*") != 1:
        raise ValueError("must have one *, which stands for the robot's name")
    return str(expand_home(pattern))


def _require_distinct_spellings(
    labels: dict[str, tuple[str, ...]],
) -> dict[str, tuple[str, ...]]:
    """Checks that no spelling is under two labels; case, spacing and plurals do not count."""
    known: dict[str, tuple[str, str]] = {}  # spelling and label, by the singular
    for label, spellings in labels.items():
        for spelling in (label, *spellings):
            key = singular(spelling)
            if not key:
                raise ValueError(f"must not contain an empty spelling, as under {label!r}")
            known_spelling, known_label = known.setdefault(key, (spelling, label))
            if known_label != label:
                also = "" if known_spelling == spelling else f" (as {known_spelling!r})"
                raise ValueError(
                    f"must list each spelling under one label: {spelling!r} is under "
                    f"{known_label!r}{also} and {label!r}; case, spacing and plurals do not count"
                )
    return labels


def _require_chosen_engine(engine: object) -> object:
    if isinstance(engine, dict) and "_target_" not in engine:
        raise ValueError("must go with lake=duckdb: choose that, too, or leave this out")
    return engine


def _as_list(value: object) -> object:
    """Takes one path for a list of one."""
    return [value] if isinstance(value, str) and value else value


Text: TypeAlias = Annotated[str, Field(strict=True, min_length=1)]
Flag: TypeAlias = Annotated[bool, Field(strict=True)]
Metres: TypeAlias = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Count: TypeAlias = Annotated[int, Field(strict=True, gt=0, le=_MOST)]
Mebibytes: TypeAlias = Annotated[int, Field(strict=True, gt=0, le=1024)]
Port: TypeAlias = Annotated[int, Field(strict=True, ge=0, le=65535)]
Positive: TypeAlias = Annotated[float, Field(strict=True, gt=0, le=_MOST, allow_inf_nan=False)]
Tolerance: TypeAlias = Annotated[float, Field(strict=True, ge=0, le=_MOST, allow_inf_nan=False)]
Span: TypeAlias = Annotated[float, Field(strict=True, ge=0, le=3600)]
AnyPath: TypeAlias = Annotated[Path, AfterValidator(_expand_home)]
Folder: TypeAlias = Annotated[AnyPath, AfterValidator(_require_folder)]
ConfigFile: TypeAlias = Annotated[AnyPath, AfterValidator(_in_config_dir)]
MessageType: TypeAlias = Annotated[
    Text, _matching(r"\w+/msg/\w+", "be a message type such as nav_msgs/msg/Odometry")
]
BelowBagDir: TypeAlias = Annotated[
    Text,
    _matching(
        r"\.|(?!/|(.*/)?\.\.(/|$)).*[^/. ].*",
        "be a path below recording.bag_dir, such as rec_20261120T043000Z",
    ),
]
TopicGlob: TypeAlias = Annotated[
    Text, _matching("[/*].*", "be a topic's name or a glob of such: it begins with / or *")
]
DotPath: TypeAlias = Annotated[
    Text, _matching(r"\w+(\.\w+)*", "be a dot-path such as pose.pose.position")
]
RobotName: TypeAlias = Annotated[Text, AfterValidator(_require_robot_name)]
Extent: TypeAlias = Annotated[
    Metres | tuple[Metres, Metres], _one_of_several("be a number of metres, or two: [from, to]")
]
ConditionValue: TypeAlias = Annotated[
    bool | int | float | str | dict[str, Metres],
    _one_of_several("be a text, a number, true or false, or {x: metres, y: metres}"),
]


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(Field,))
def section(model: type[_T]) -> type[_T]:
    """Makes a class a frozen dataclass with checked values; unknown keys are refused."""
    checked = dataclass(
        frozen=True, slots=True, kw_only=True, config=ConfigDict(extra="forbid", defer_build=True)
    )
    return cast("type[_T]", checked(model))


@section
class RequiredTopic:
    """A name or a glob of topics that must be recorded, and their least rate."""

    topic: Text
    min_hz: Tolerance = 0.0


def _as_required_topic(value: object) -> object:
    """Takes a name for an entry without a rate."""
    return {"topic": value} if isinstance(value, str) else value


RequiredTopics: TypeAlias = tuple[
    Annotated[RequiredTopic, BeforeValidator(_as_required_topic)], ...
]


@section
class RecordingSettings:
    """What is recorded, and where to.

    `split_duration_s` is an integer because `ros2 bag record` takes whole seconds. The file
    `keep_when` has rules that keep recordings around events; the file `exclude_when` has rules
    that remove recordings.
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
    """Names or globs of topics that count as latched, or do not, whatever QoS is offered."""

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
    """How much of the bags is also stored as columns, which changes only the time of answers.

    `max_share` is a part of the bags' bytes. `max_gb` bounds a store in a cache folder; retention
    bounds one beside the bags.
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
    `foreign`: whether bags of other programs stay, or count and are deleted like the recorder's.
    `require_shipped`: whether age deletes only bags that `ros2-memory ship` has confirmed. `topics`
    limits the age of messages, by name or glob of their topic: older ones are cut out of bags.
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
    """What stays after retention has deleted bags: nothing, unless `keep` is true.

    `texts` are names or globs of topics whose texts stay, too; `labels` are the labels of people
    that stay; `people` are more words for people. `max_share` is a part of
    `retention.max_total_gb`.
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

    `tools`: all tools, or those of the specification; `write_tools`: also tools that write.
    `metrics` and `traces` need the extra `observability`. `page`: whether the page is served;
    `keep_questions`: how many of the latest calls, with their replies, are kept for it in memory.
    """

    name: Text
    transport: Annotated[Literal["stdio", "sse", "http"], BeforeValidator(_transport_name)]
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

    `robots` has the bag directories by name; a pattern stands for them, too. `places` is the
    pattern of the robots' own files of named places. `pose_topics` has the `data.pose_topic` of
    some. `shared_map`: whether coordinates mean the same place for all robots. `tokens` has, by the
    file of a token, the robots that it is for.
    """

    robots: Annotated[dict[RobotName, AnyPath], BeforeValidator(_expand_robots)]
    places: Annotated[Text, AfterValidator(_require_one_star)] | None
    pose_topics: dict[RobotName, Text]
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
    arguments: Flag


@section
class AdapterNode:
    """An adapter's class, and the arguments of its constructor that only this adapter has.

    Each adapter has a subclass. The subclasses are the allow-list: Hydra would build whatever a
    `_target_` names.
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
    setup_files: Annotated[tuple[AnyPath, ...], BeforeValidator(_as_list)]
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


@section
class LakeSettings:
    """Where `ros2-memory ship` writes the bags of the fleet's robots; needs the extra `lake`.

    `engine` answers a fleet's server; None for a server that asks no lake. Secrets are in a file of
    their own, or where the store's own client looks for them (AWS_*).
    """

    engine: Annotated[DuckdbNode | None, BeforeValidator(_require_chosen_engine)]
    warehouse: Annotated[Text, AfterValidator(_require_no_password)] | None
    catalog: Literal["sql", "rest"]
    uri: Annotated[Text, AfterValidator(_require_no_password)] | None
    state_dir: AnyPath | None
    properties: Annotated[dict[Text, Text], AfterValidator(_require_no_secrets)]
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

    labels: Annotated[dict[Text, tuple[Text, ...]], AfterValidator(_require_distinct_spellings)]


@section
class PlaceShape:
    """A circle (x, y, radius_m), a rectangle (x and y as [from, to]) or a polygon, in metres.

    `z` has its heights, [from, to], either of which may be null; without it, all count. `frame` is
    the frame of its coordinates; without it, `data.map_frame`.
    """

    frame: Text | None = None
    x: Extent | None = None
    y: Extent | None = None
    radius_m: Positive | None = None
    polygon: tuple[tuple[Metres, Metres], ...] | None = None
    z: tuple[Metres | None, Metres | None] | None = None

    @property
    def heights(self) -> tuple[float, float]:
        """The least and the greatest z, which may be infinite."""
        low, high = self.z or (None, None)
        return -math.inf if low is None else low, math.inf if high is None else high

    def __post_init__(self) -> None:
        """Refuses what is not exactly one of the three shapes, and heights out of order."""
        low, high = self.heights
        if low >= high:
            raise ValueError("must have z: [from, to] with from below to; either may be null")
        x, y, radius_m = self.x, self.y, self.radius_m
        if self.polygon is not None:
            is_shape = (x, y, radius_m) == (None, None, None) and not _lie_in_a_line(self.polygon)
        elif isinstance(x, tuple) and isinstance(y, tuple):
            is_shape = radius_m is None and x[0] < x[1] and y[0] < y[1]
        else:
            is_shape = isinstance(x, float) and isinstance(y, float) and radius_m is not None
        if not is_shape:
            raise ValueError(
                "must be a circle (x, y, radius_m), a rectangle (x: [from, to], y: [from, to]) "
                "or a polygon of 3 corners or more ([[x, y], ...]) that do not lie in a line"
            )


def _lie_in_a_line(corners: Sequence[tuple[float, float]]) -> bool:
    """Returns whether all corners lie in a line, as none, one or two do."""
    if not corners:
        return True
    (x, y), *others = corners
    return all(
        (bx - x) * (cy - y) == (by - y) * (cx - x) for (bx, by), (cx, cy) in combinations(others, 2)
    )


@section
class PlacesFile:
    """The named places."""

    places: dict[Text, PlaceShape]


@section
class KeepRule:
    """When recordings are kept as a moment, and how much of them.

    `topic`, `condition_type`, `value`, `field` and `min_score` as in `find_matches`; `for_s` is how
    long the condition, or a silence, must hold. A moment has `before_s` before the match began and
    `after_s` after the rule fired. All moments of the rule together take `max_gb` at most.
    """

    kind: RuleKind = "message"
    topic: Text | None = None
    condition_type: Text | None = None
    value: ConditionValue | None = None
    field: Text | None = None
    min_score: Tolerance | None = None
    for_s: Tolerance = 0.0
    before_s: Span = 30.0
    after_s: Span = 30.0
    label: Text | None = None
    max_gb: Positive = 0.1
    max_per_hour: Count = 6

    def __post_init__(self) -> None:
        """Refuses a rule that lacks a key that its kind needs, or has one that it does not know."""
        has_condition = self.condition_type is not None and self.value is not None
        if self.kind == "message":
            if self.topic is None or not has_condition:
                raise ValueError("must have topic, condition_type and value, as find_matches has")
            return
        if has_condition or self.field is not None or self.min_score is not None:
            raise ValueError(f"must not have a condition: its kind is {self.kind}")
        if self.kind == "silent":
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
    """When recordings are removed, and `margin_s` before and after.

    `topic`, `condition_type`, `value`, `field` and `min_score` as in `find_matches`, of one topic.
    A message counts until the next one; but only for `stale_s`, unless the topic is latched.
    `on_unknown`: what becomes of times at which it is unknown whether the condition holds.
    """

    topic: Annotated[Text, _matching(r"[^*?\[]*", "name one topic; make a rule for each")]
    condition_type: Text
    value: ConditionValue
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
        env: the environment; by default `os.environ`.

    Raises:
        ConfigError: a file, a variable or an override is refused.
    """
    settings, _ = load_explained(overrides, env)
    return settings


def load_explained(
    overrides: Sequence[str], env: Mapping[str, str] | None = None
) -> tuple[Settings, Sources]:
    """Returns the configuration as `load_settings` does, and the source of each of its keys.

    Raises:
        ConfigError: as `load_settings`.
    """
    given = given_variables(os.environ if env is None else env)
    folder, beside = config_dir(given), _working_dir() / "config"
    sources = Sources(folder, parse_overrides(overrides, given, folder))
    with foreign_errors_as_config_error(str(folder), sources):
        with initialize_config_dir(version_base="1.3", config_dir=str(folder)):
            composed = compose(
                "config", overrides=[override.text for override in sources.overrides]
            )
        _append_interface_folder(composed, given)
        data = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    # The user's own files win over the shipped ones, unless the user chose a folder.
    folders = [folder] if "MEMORY_CONFIG_DIR" in given else [beside, folder]
    settings = validated(Settings, data, config_dirs=folders, source=sources, adapters=_NODES)
    return settings, sources


def _working_dir() -> Path:
    """Returns the working directory.

    Raises:
        ConfigError: it has been deleted.
    """
    try:
        return Path.cwd()
    except FileNotFoundError:
        raise ConfigError("the working directory has been deleted; change to another") from None


def is_deployment_chosen(overrides: Sequence[str]) -> bool:
    """Returns whether a configuration directory, or an option of a group, was chosen.

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
    """Returns the absolute path of the folder with `config.yaml` and its groups.

    It is `MEMORY_CONFIG_DIR`, else the copy in an installed package, else the checkout's `config/`.

    Raises:
        ConfigError: the folder has no `config.yaml`.
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
    """Returns the paths of `config.yaml` and of the files that its keys name."""
    recording, data = settings.recording, settings.data
    files = (
        config_dir(os.environ) / "config.yaml",
        recording.topics_file,
        recording.keep_when,
        recording.exclude_when,
        data.labels_file,
        data.places_file,
        settings.reader.schemas_file,
    )
    return [str(path.absolute()) for path in files if path is not None]


def unused_config() -> str | None:
    """Returns a sentence on a `config/config.yaml` of the working directory that is not used.

    It may be another program's, and its `recorder.setup_files` are run: so it has to be chosen.
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
    return _load_file(MessageSchemas, settings, "reader.schemas_file").schemas


def load_labels(settings: Settings) -> Mapping[str, Sequence[str]]:
    """Returns the spellings of `data.labels_file` by the name to show; empty if the key is null.

    Raises:
        ConfigError: the file is missing, is not YAML, or its content is refused.
    """
    if settings.data.labels_file is None:
        return {}
    return _load_file(LabelsFile, settings, "data.labels_file").labels


def load_places(settings: Settings) -> Mapping[str, PlaceShape]:
    """Returns the named places of `data.places_file`.

    Raises:
        ConfigError: the file is missing, is not YAML, or its content is refused.
    """
    return _load_file(PlacesFile, settings, "data.places_file").places


def load_rules(settings: Settings) -> Mapping[str, KeepRule]:
    """Returns the rules of `recording.keep_when`, by name.

    Raises:
        ConfigError: the file is missing, is not YAML, or its content is refused.
    """
    return _load_file(TriggersFile, settings, "recording.keep_when").rules


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
    try:
        return _load_file(ExclusionsFile, settings, "recording.exclude_when").rules
    except ConfigError as error:
        raise ConfigError(f"{error}\n{_FAILS_CLOSED}") from error


def _load_file(model: type[_T], settings: Settings, key: str) -> _T:
    """Returns the content of the YAML file that a key of the settings names, as a model."""
    path: Path = attrgetter(key)(settings)

    def source(_: str) -> str:
        return f"in {path}, which {key} names"

    with foreign_errors_as_config_error(f"{key}: {path}", source):
        data = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    return validated(model, data, config_dirs=[path.parent], source=source)


@contextmanager
def exit_on_config_error(program: str) -> Iterator[None]:
    """Turns a `ConfigError` of the block into exit code 2, with an explanation on stderr."""
    try:
        yield
    except ConfigError as error:
        sys.stderr.write(f"{program} cannot start, its configuration is refused:\n{error}\n")
        raise SystemExit(EXIT_CODE) from None


def _append_interface_folder(composed: DictConfig, given: Mapping[str, str]) -> None:
    """Appends `ROS_VISION_INTERFACES_PATH` to the folders of message definitions.

    Raises:
        ConfigError: it is not an existing folder.
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
    if isinstance(paths, ListConfig):  # anything else is refused by the validation
        paths.append(folder)
