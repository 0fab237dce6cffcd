"""The configuration's shape: every key, its unit and what it may hold.

Plain frozen data; values are strict, so that `true` is no number and `"10"` no duration. Sizes in
`_gb` are 10^9 bytes, in `_mb` 2^20 bytes. The defaults stand in `config/config.yaml` alone.
"""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Final, Literal, TypeAlias

from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo
from pydantic.dataclasses import dataclass


def _at_home(path: Path) -> Path:
    if path == Path():
        raise ValueError("must name a path")
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise ValueError(f"must be a path that can be found: {error}") from error


def _existing_folder(path: Path) -> Path:
    if not path.is_dir():
        raise ValueError("must be an existing folder")
    return path


def _of_config_dir(path: Path, info: ValidationInfo[Path]) -> Path:
    """`config/x` is the file x of the configuration directory in use, wherever that lies."""
    if path.parts[0] != "config":
        return path
    return info.context.joinpath(*path.parts[1:])


def _message_type(name: str) -> str:
    if not re.fullmatch(r"\w+/msg/\w+", name):
        raise ValueError("must be a message type such as nav_msgs/msg/Odometry")
    return name


def _dot_path(path: str) -> str:
    if not re.fullmatch(r"\w+(\.\w+)*", path):
        raise ValueError("must be a dot-path such as pose.pose.position")
    return path


Text: TypeAlias = Annotated[str, Field(strict=True, min_length=1)]
Switch: TypeAlias = Annotated[bool, Field(strict=True)]
Count: TypeAlias = Annotated[int, Field(strict=True, gt=0)]
Megabytes: TypeAlias = Annotated[int, Field(strict=True, gt=0, le=1024)]
Port: TypeAlias = Annotated[int, Field(strict=True, ge=0, le=65535)]
Positive: TypeAlias = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
Tolerance: TypeAlias = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
AnyPath: TypeAlias = Annotated[Path, AfterValidator(_at_home)]
Folder: TypeAlias = Annotated[AnyPath, AfterValidator(_existing_folder)]
ConfigFile: TypeAlias = Annotated[AnyPath, AfterValidator(_of_config_dir)]
MessageType: TypeAlias = Annotated[Text, AfterValidator(_message_type)]
DotPath: TypeAlias = Annotated[Text, AfterValidator(_dot_path)]

_REFUSE_UNKNOWN: Final = ConfigDict(extra="forbid")


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class RecordingSettings:
    """What is recorded, and where it lies.

    `split_duration_s` is whole because `ros2 bag record` takes whole seconds.
    """

    bag_dir: AnyPath
    split_duration_s: Count
    session_duration_s: Positive
    use_sim_time: Switch
    clear_on_startup: Switch
    topics_file: ConfigFile


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class LatchedTopics:
    """Names or globs of topics that are latched whatever is offered, and of those that are not."""

    include: tuple[Text, ...]
    exclude: tuple[Text, ...]


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class DataSettings:
    """How recorded data is read and judged.

    `map_frame` is the frame in which places are told where transforms lead there. `now` is what
    "ago" counts from: the wall clock, or the newest recorded moment. `tf_clock` is the time that
    orders transforms: header stamps, log time, or stamps where the two agree.
    """

    max_array_length: Count
    position_tolerance_m: Tolerance
    time_tolerance_s: Tolerance
    pose_topic: Text
    map_frame: Text | None
    tf_topics: tuple[Text, ...]
    tf_static_topics: tuple[Text, ...]
    now: Literal["wall", "latest"]
    tf_clock: Literal["auto", "stamp", "log"]
    max_plausible_speed_mps: Positive
    latched_topics: LatchedTopics


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class ReaderSettings:
    """How bags are found and decoded.

    `include_active`: what is whole of the split being written answers, too.
    """

    index_refresh_s: Positive
    include_active: Switch
    custom_msg_paths: tuple[Folder, ...]
    chunk_cache_mb: Count
    max_chunk_mb: Megabytes
    schemas_file: ConfigFile


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class RetentionSettings:
    """How much history is kept.

    `max_moments_gb`: of the total, for what was asked to be kept; at most half of it. `foreign`:
    whether bags that the recorder did not make are left alone, or deleted and counted with its own.
    """

    max_total_gb: Positive
    max_age_h: Positive
    min_free_gb: Tolerance
    max_moments_gb: Tolerance
    foreign: Literal["keep", "delete"]


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class ServerSettings:
    """How the query server is reached, and what it offers. Port 0 is any that is free.

    `tools`: all, or the specification's alone; `write_tools`: those that write, too. `metrics` and
    `traces` need the optional part of the package.
    """

    name: Text
    transport: Literal["stdio", "sse"]
    host: Text
    port: Port
    call_timeout_s: Positive
    max_reply_chars: Annotated[int, Field(strict=True, ge=1000)]
    tools: Literal["all", "spec"]
    write_tools: Switch
    metrics: Switch
    traces: Switch


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class LoggingSettings:
    """What is logged, and in which shape."""

    level: Literal["debug", "info", "warning", "error"]
    format: Literal["json", "pretty"]
    arguments: bool


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class AdapterNode:
    """What an adapter is built from: its class and the plain values for its constructor.

    Each adapter that may be built has a subclass, which is the allow-list: Hydra builds whatever a
    `_target_` names.
    """

    target: Text = Field(alias="_target_")

    @property
    def arguments(self) -> dict[str, object]:
        """The constructor's keyword arguments."""
        names = (field.name for field in fields(self) if field.name != "target")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class McapNode(AdapterNode):
    """`storage=mcap`: single MCAP files."""

    target: Literal["ros2_memory.storage.mcap_reader.McapReader"] = Field(alias="_target_")
    custom_msg_paths: tuple[Folder, ...]
    cache_mb: Count
    max_chunk_mb: Megabytes


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class Rosbag2Node(AdapterNode):
    """`storage=rosbag2`: recordings of either plugin; `unpack_max_mb` bounds temporary files."""

    target: Literal["ros2_memory.storage.rosbag2_reader.Rosbag2Reader"] = Field(alias="_target_")
    custom_msg_paths: tuple[Folder, ...]
    cache_mb: Count
    max_chunk_mb: Megabytes
    unpack_max_mb: Count


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class Ros2BagNode(AdapterNode):
    """`recorder=ros2bag`: a supervised `ros2 bag record`."""

    target: Literal["ros2_memory.recorder.ros2bag.Ros2BagRecorder"] = Field(alias="_target_")
    bag_dir: AnyPath
    topics_file: ConfigFile
    split_duration_s: Count
    session_duration_s: Positive
    use_sim_time: Switch
    min_free_gb: Tolerance
    setup_files: tuple[AnyPath, ...]
    latched_topics: tuple[Text, ...]
    repeat_latched: tuple[Text, ...]
    chunk_bytes: Annotated[int, Field(strict=True, ge=1024)]


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class NullRecorderNode(AdapterNode):
    """`recorder=none`: nothing is recorded."""

    target: Literal["ros2_memory.recorder.null.NullRecorder"] = Field(alias="_target_")


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class MessageSchemas:
    """The schema map: for each message type, field name to dot-path in the message."""

    schemas: dict[MessageType, dict[Text, DotPath]]


@dataclass(frozen=True, slots=True, kw_only=True, config=_REFUSE_UNKNOWN)
class Settings:
    """The whole configuration, validated."""

    recording: RecordingSettings
    data: DataSettings
    reader: ReaderSettings
    retention: RetentionSettings
    server: ServerSettings
    logging: LoggingSettings
    storage: Annotated[McapNode | Rosbag2Node, Field(discriminator="target")]
    recorder: Annotated[Ros2BagNode | NullRecorderNode, Field(discriminator="target")]
