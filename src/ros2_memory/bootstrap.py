"""The composition root of both programs: builds their parts from the configuration.

Each function imports what it builds: the recorder must not load what answers questions, the query
server not what repairs and deletes, and a program that asks in process not the libraries of a
server (`tests/project/test_imports.py`).
"""
# ruff: noqa: PLC0415 - as the docstring says

from __future__ import annotations

import gc
import hashlib
import json
import math
import os
from contextlib import suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, cast

from hydra.utils import get_class

from ros2_memory import PACKAGE, package_version
from ros2_memory.config import (
    AdapterNode,
    ExcludeRule,
    KeepRule,
    NullRecorderNode,
    PlaceShape,
    Settings,
    load_exclusions,
    load_labels,
    load_message_schemas,
    load_places,
    load_rules,
)
from ros2_memory.core import directories
from ros2_memory.core.errors import ConfigError, InvalidArgumentsError
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.telemetry import SILENT, Observer, Telemetry
from ros2_memory.core.timebase import WallClock, ns_from_unix
from ros2_memory.retention.policy import GB, RetentionLimits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.columns.fill import Progress
    from ros2_memory.columns.scanner import Caches
    from ros2_memory.columns.store import ColumnStore
    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.regions import Place, Region
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.fleet.robots import Fleet
    from ros2_memory.history.context import Memory, QuerySettings
    from ros2_memory.recorder.background import Background
    from ros2_memory.recorder.base import Recorder
    from ros2_memory.recorder.days import MemoryDays
    from ros2_memory.recorder.housekeeping import Housekeeping
    from ros2_memory.retention.repair import Repairer
    from ros2_memory.retention.saved_moments import MomentKeeper
    from ros2_memory.retention.topic_ages import TopicCutter
    from ros2_memory.serving.backfill import Backfill
    from ros2_memory.serving.dispatch import Dispatcher
    from ros2_memory.serving.mcp_server import EpisodicServer
    from ros2_memory.storage.base import BagReader, BagWriter
    from ros2_memory.triggers.exclusion import ExclusionRule
    from ros2_memory.triggers.rules import Rule
    from ros2_memory.triggers.screening import Screening
    from ros2_memory.triggers.watch import Triggers

log = get_logger(__name__)

NEW_OBJECTS: Final = 50_000
"""After so many new objects the server looks for garbage among them."""
_READ_ALIKE = (
    "ros2_memory.storage.mcap_reader.McapReader",
    "ros2_memory.storage.rosbag2_reader.Rosbag2Reader",
)
"""Readers that read the same from a file that both can read."""
_MOST_SPLITS = 5000
"""The splits of one recording that `bag_dir.state_files` takes."""


def require_extra(what: str, extra: str, *modules: str) -> None:
    """Checks that the modules of an extra can be imported.

    Raises:
        ConfigError: one cannot; the sentence says which, and how to install the extra.
    """
    for module in modules:
        if find_spec(module) is None:
            raise ConfigError(
                f"{what} needs the optional part of this package (no {module}): "
                f"pip install '.[{extra}]'"
            )


def build_reader(
    settings: Settings, *, cache_mb: int | None = None, large: LargeReads | None = None
) -> BagReader:
    """Returns the bag reader that the configuration chooses.

    Args:
        settings: the configuration.
        cache_mb: the size of its cache, in place of the configured one.
        large: the turn to hold much of a bag, if several threads read.

    Raises:
        ConfigError: it is refused.
    """
    given = settings.reader
    reader = instantiated(
        settings.storage,
        custom_msg_paths=given.custom_msg_paths,
        cache_mb=given.chunk_cache_mb if cache_mb is None else cache_mb,
        max_chunk_mb=given.max_chunk_mb,
        large=large,
    )
    return cast("BagReader", reader)


def build_recorder(settings: Settings, **collaborators: object) -> Recorder:
    """Returns the recorder that the configuration chooses, which must not be `recorder=none`.

    `collaborators` are the arguments of its constructor that are no settings.

    Raises:
        ConfigError: it is refused.
    """
    from ros2_memory.recorder.sessions import Required

    recording = settings.recording
    recorder = instantiated(
        settings.recorder,
        bag_dir=recording.bag_dir,
        topics_file=recording.topics_file,
        split_duration_s=recording.split_duration_s,
        session_duration_s=recording.session_duration_s,
        use_sim_time=recording.use_sim_time,
        queue_mb=recording.queue_mb,
        required=[Required(rule.topic, rule.min_hz) for rule in recording.required],
        min_free_gb=settings.retention.min_free_gb,
        latched_topics=settings.data.tf_static_topics,
        **collaborators,
    )
    return cast("Recorder", recorder)


def instantiated(node: AdapterNode, **arguments: object) -> object:
    """Makes the adapter that a section of the configuration chooses."""
    return get_class(node.target)(**node.arguments, **arguments)


def retention_limits(settings: Settings) -> RetentionLimits:
    """Returns the limits by which the recorder deletes bags."""
    retention = settings.retention
    return RetentionLimits(
        max_total_bytes=round(retention.max_total_gb * GB),
        max_age_ns=ns_from_unix(retention.max_age_h * 3600),
        min_free_bytes=round(retention.min_free_gb * GB),
        keeps_foreign=retention.foreign == "keep",
        require_shipped=retention.require_shipped,
    )


def build_housekeeper(
    settings: Settings,
    bag_dir: Path,
    reader: BagReader,
    own: OwnRecordings,
    background: Background,
) -> Housekeeping:
    """Returns the part of the recorder that repairs and deletes bags; nothing else may delete.

    Args:
        settings: the configuration.
        bag_dir: the bag directory.
        reader: reads bag files.
        own: the recordings that were made in the bag directory.
        background: runs long work.
    """
    from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
    from ros2_memory.recorder.housekeeping import Housekeeping
    from ros2_memory.recorder.time_sync import is_synchronised
    from ros2_memory.retention.collect import GarbageCollector
    from ros2_memory.retention.saved_moments import MomentKeeper
    from ros2_memory.storage.mcap.writer import McapWriter

    retention = settings.retention
    # At most half the budget, so that saved moments leave room for new recordings.
    moments_bytes = round(min(retention.max_moments_gb, retention.max_total_gb / 2) * GB)
    rules, clock = rules_of(settings, moments_bytes), WallClock()
    rule_bytes = {rule.name: rule.max_bytes for rule in rules}
    bags, writer = BagDirReader(reader), McapWriter(settings.reader.max_chunk_mb)
    moments = MomentKeeper(bag_dir, moments_bytes, clock, own, rule_bytes)
    collector = GarbageCollector(
        bag_dir,
        bags,
        writer,
        retention_limits(settings),
        own,
        is_synchronised=is_synchronised,
        static_topics=settings.data.tf_static_topics,
        grace_s=settings.reader.index_refresh_s + settings.server.call_timeout_s,
        memory=_build_memory_days(settings, bag_dir, bags, own, writer),
        cutter=_build_topic_cutter(settings, bag_dir, reader, writer),
    )
    return Housekeeping(
        bag_dir,
        bags,
        writer,
        clock,
        collector,
        moments,
        own=own,
        split_duration_s=settings.recording.split_duration_s,
        triggers=_build_triggers(settings, bags, moments, rules) if rules else None,
        screening=_build_screening(settings, bag_dir, reader, writer),
        background=background,
    )


def _build_topic_cutter(
    settings: Settings, bag_dir: Path, reader: BagReader, writer: BagWriter
) -> TopicCutter | None:
    """Returns the part that cuts topics with a shorter life out of bags; None without any."""
    from ros2_memory.retention.topic_ages import TopicAge, TopicCutter, is_quiet

    topic_ages = [
        TopicAge(topics, ns_from_unix(life.max_age_h * 3600))
        for topics, life in settings.retention.topics.items()
    ]
    if not topic_ages:
        return None
    return TopicCutter(
        bag_dir,
        topic_ages,
        reader,
        writer,
        static_topics=settings.data.tf_static_topics,
        is_quiet=is_quiet,
    )


def _build_memory_days(
    settings: Settings, bag_dir: Path, bags: BagReader, own: OwnRecordings, writer: BagWriter
) -> MemoryDays | None:
    """Returns the part that writes thinned days, or deletes them if none shall stay.

    None if nothing is thinned and there are no thinned days.
    """
    from ros2_memory.bag_dir.layout import MEMORY_FOLDER

    memory = settings.memory
    if not memory.keep and not (bag_dir / MEMORY_FOLDER).is_dir():
        return None
    from ros2_memory.recorder.days import MemoryDays, MemoryLimits

    limits = MemoryLimits(
        memory.texts,
        memory.labels,
        memory.people,
        tuple(settings.retention.topics),
        round(memory.max_share * settings.retention.max_total_gb * GB),
        ns_from_unix(memory.max_age_d * 86_400),
    )
    return MemoryDays(
        bag_dir,
        bags,
        writer,
        own,
        _extractor_of(settings),
        limits=limits if memory.keep else None,
        static_topics=settings.data.tf_static_topics,
    )


def _extractor_of(settings: Settings) -> SchemaExtractor:
    """Returns the extractor for the schema map of the configuration."""
    from ros2_memory.extract import SchemaExtractor

    return SchemaExtractor(load_message_schemas(settings), settings.data.max_array_length)


def _build_triggers(
    settings: Settings, reader: BagReader, moments: MomentKeeper, rules: Sequence[Rule]
) -> Triggers:
    """Returns the part that saves moments as `rules` say."""
    from ros2_memory.recorder.process.topics import TopicsFile
    from ros2_memory.triggers.rules import SplitSearch
    from ros2_memory.triggers.watch import Triggers

    topics = TopicsFile(settings.recording.topics_file)
    with suppress(ConfigError):  # the recorder refuses it
        topics.load()

    def is_recorded(topic: str) -> bool:
        """Whether the list of topics that is in use now has a topic."""
        topics.look()
        return topics.selection.matches(topic)

    return Triggers(
        moments.bag_dir,
        rules,
        SplitSearch(reader, _extractor_of(settings), rules),
        moments.own,
        moments,
        clock=moments.clock,
        split_duration_s=settings.recording.split_duration_s,
        is_recorded=is_recorded,
    )


def rules_of(settings: Settings, moments_bytes: int) -> tuple[Rule, ...]:
    """Returns the rules of `recording.keep_when`.

    `moments_bytes` is what all saved moments may take.

    Raises:
        ConfigError: their file is missing, a rule is refused, or together they may save more than
            all moments may take.
    """
    from ros2_memory.bag_dir.moment_file import fault_of_label
    from ros2_memory.triggers.rules import Rule

    path = settings.recording.keep_when
    rules: list[Rule] = []
    for name, given in load_rules(settings).items():
        label = given.label or name
        if fault := fault_of_label(label):
            raise ConfigError(f"{path}: the rule {name!r}: its label {fault}")
        condition = None
        if given.condition_type is not None:
            condition = _condition_of(settings, given, f"{path}: the rule {name!r}")
        rules.append(
            Rule(
                name=name,
                kind=given.kind,
                topic=given.topic,
                condition=condition,
                hold=ns_from_unix(given.for_s),
                before=ns_from_unix(given.before_s),
                after=ns_from_unix(given.after_s),
                label=label,
                max_bytes=round(given.max_gb * GB),
                max_per_hour=given.max_per_hour,
            )
        )
    wanted = sum(rule.max_bytes for rule in rules)
    if wanted > moments_bytes:
        raise ConfigError(
            f"{path}: max_gb of all rules together is {wanted / GB:g}, and all moments may take "
            f"{moments_bytes / GB:g} GB (retention.max_moments_gb, at most half of "
            "retention.max_total_gb): lower one, or raise the other"
        )
    return tuple(rules)


def _build_screening(
    settings: Settings, bag_dir: Path, reader: BagReader, writer: BagWriter
) -> Screening | None:
    """Returns the part that excludes what `recording.exclude_when` names; None without rules."""
    from ros2_memory.triggers.screening import Screening

    rules = exclusions_of(settings)
    if not rules:
        return None
    return Screening(
        bag_dir,
        rules,
        reader,
        _extractor_of(settings),
        writer,
        split_duration_s=settings.recording.split_duration_s,
    )


def exclusions_of(settings: Settings) -> tuple[ExclusionRule, ...]:
    """Returns the rules of `recording.exclude_when`.

    Raises:
        ConfigError: their file is missing, a rule is refused, its topic is not recorded, or
            recordings have too many splits for it.
    """
    from ros2_memory.recorder.process.topics import load_topics
    from ros2_memory.triggers.exclusion import ExclusionRule

    recording = settings.recording
    path, given = recording.exclude_when, load_exclusions(settings)
    if given and recording.session_duration_s > _MOST_SPLITS * recording.split_duration_s:
        raise ConfigError(
            f"{path}: a recording may have {_MOST_SPLITS} splits at most where a rule excludes "
            "something: lower recording.session_duration_s"
        )
    rules: list[ExclusionRule] = []
    for name, value in given.items():
        if not load_topics(recording.topics_file).matches(value.topic):
            raise ConfigError(
                f"{path}: the rule {name!r}: {value.topic} is not recorded, so its value would be "
                f"unknown at all times: list it in {recording.topics_file}"
            )
        rules.append(
            ExclusionRule(
                name=name,
                topic=value.topic,
                condition=_condition_of(settings, value, f"{path}: the rule {name!r}"),
                margin=ns_from_unix(value.margin_s),
                stale=ns_from_unix(value.stale_s),
                excludes_unknown=value.on_unknown == "exclude",
            )
        )
    return tuple(rules)


def _condition_of(settings: Settings, given: KeepRule | ExcludeRule, where: str) -> Condition:
    """Returns the condition of a rule that has one.

    Raises:
        ConfigError: it is refused.
    """
    from ros2_memory.analysis.conditions import parse_condition

    value: JsonValue = dict(given.value) if isinstance(given.value, dict) else given.value
    data = settings.data
    min_score = data.min_score if given.min_score is None else given.min_score
    try:
        return parse_condition(
            given.condition_type or "", value, data.position_tolerance_m, given.field, min_score
        )
    except InvalidArgumentsError as error:
        raise ConfigError(f"{where}: {error}") from error


def build_repairer() -> Repairer:
    """Returns a repairer of single MCAP files."""
    from ros2_memory.retention.repair import Repairer
    from ros2_memory.storage.mcap.writer import McapWriter
    from ros2_memory.storage.mcap_reader import McapReader

    return Repairer(McapReader(), McapWriter())


class SharedParts(NamedTuple):
    """The parts that memories of the same settings can share.

    Attributes:
        reader: reads bag files, and caches chunks.
        large: the reader's turn to hold much of a bag.
        extractor: reads the fields of messages that the schema map names.
        caches: of columns.
    """

    reader: BagReader
    large: LargeReads
    extractor: SchemaExtractor
    caches: Caches


def shared_parts(settings: Settings) -> SharedParts:
    """Returns the parts that read and decode the bags of one memory, or of several.

    Raises:
        ConfigError: the reader cannot be built, or the schema map is refused.
    """
    from ros2_memory.columns.scanner import Caches

    extractor = _extractor_of(settings)
    large = LargeReads()
    reader = build_reader(settings, large=large)
    caches = Caches.of(settings.store.cache_mb)
    return SharedParts(reader, large, extractor, caches)


def build_memory(
    settings: Settings,
    shared: SharedParts | None = None,
    *,
    setting: str | None = None,
    hidden: tuple[str, ...] = (),
) -> Memory:
    """Returns the memory over `recording.bag_dir`, which need not exist yet. Reads no bag.

    Args:
        settings: the configuration.
        shared: the parts that it shares with other memories; None for parts of its own.
        setting: the setting in which the user named the bags; None for `recording.bag_dir`.
        hidden: prefixes of the topics that are left out, as those of another robot.

    Raises:
        ConfigError: the reader cannot be built, or the schema map or the labels are refused.
    """
    from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
    from ros2_memory.columns.scanner import Scanner
    from ros2_memory.history.context import Memory
    from ros2_memory.index.scan import BAG_DIR_SETTING
    from ros2_memory.recorder.index_manager import IndexManager

    clock = WallClock()
    shared = shared or shared_parts(settings)
    bag_dir = settings.recording.bag_dir
    reader = BagDirReader(shared.reader, bag_dir, hidden=hidden)
    apart = (str(bag_dir.absolute()), str(hidden)) if hidden else ()
    columns = build_columns(settings, reader, apart)
    index = IndexManager(
        bag_dir,
        reader,
        clock,
        refresh_s=settings.reader.index_refresh_s,
        split_duration_s=settings.recording.split_duration_s,
        known=list if columns is None else partial(columns.known_bags, bag_dir),
        include_active=settings.reader.include_active,
        trusts_mtime=not isinstance(settings.recorder, NullRecorderNode),
        only=settings.data.recording,
        setting=setting or BAG_DIR_SETTING,
        large=shared.large,
    )
    reading = reading_of(settings, shared.extractor.schemas)
    scanner = Scanner(columns, bag_dir, reading, shared.large, shared.caches)
    limits = query_settings_of(settings)
    return Memory(
        index,
        reader,
        shared.extractor,
        clock,
        limits,
        scanner,
        large=shared.large,
        hides_topics=bool(hidden),
    )


def build_columns(
    settings: Settings, reader: BagReader, apart: Sequence[str] = ()
) -> ColumnStore | None:
    """Returns the store of columns; None if the configuration wants none.

    Args:
        settings: the configuration.
        reader: leaves out what the bag directory hides: overlaps, and what `forget` deletes.
        apart: names of a store in the cache folder: of a robot in a lake, or of one of several in a
            bag directory, which is the first name. Empty for the store of the bag directory.
    """
    from ros2_memory.bag_dir.layout import OWN_FOLDER
    from ros2_memory.columns.store import FILE, ColumnStore

    if not settings.store.enabled:
        return None
    definitions = _hash_of(_definitions_of(settings))
    if apart:
        cached = _cached(*map(os.fsencode, apart))
        return ColumnStore(cached, reader.definition, definitions=definitions)
    bag_dir = settings.recording.bag_dir
    return ColumnStore(
        partial(column_paths, settings),
        reader.definition,
        definitions=definitions,
        # A program that only looks reads what the recorder's server has stored.
        sources=(bag_dir / OWN_FOLDER / FILE,),
        waits_for=bag_dir,
    )


def column_paths(settings: Settings) -> tuple[Path, ...]:
    """Returns the paths that the store of columns may have now, best first.

    It is beside the bags only where the configured recorder has recorded. Nothing is written to a
    folder of other programs' bags. Columns do not depend on the configuration, so one file serves
    all of a bag directory.
    """
    from ros2_memory.bag_dir.layout import OWN_FOLDER, has_recorded
    from ros2_memory.columns.store import FILE

    bag_dir = settings.recording.bag_dir
    records = not isinstance(settings.recorder, NullRecorderNode) and has_recorded(bag_dir)
    beside = (bag_dir / OWN_FOLDER / FILE,) if records else ()
    return (*beside, *_cached(os.fsencode(bag_dir.absolute())))


def _cached(*names: bytes) -> tuple[Path, ...]:
    """Returns the path of a store in the cache folder; nothing if there is no such folder.

    `names` identify the bags of the store: there is a folder for each, inside the one before.
    """
    from ros2_memory.columns.store import FILE

    given = os.environ.get("XDG_CACHE_HOME")
    try:
        cache = Path(given) if given else Path.home() / ".cache"
    except RuntimeError:  # a user without a home
        return ()
    folder = cache.joinpath(PACKAGE, *(hashlib.sha256(name).hexdigest()[:16] for name in names))
    return (folder / FILE,) if cache.is_absolute() else ()


def _definitions_of(settings: Settings) -> list[tuple[str, int, int]]:
    """Returns paths, sizes and mtimes of the configured definitions: any change shows in these."""
    return [
        (str(path.relative_to(folder)), path.stat().st_size, path.stat().st_mtime_ns)
        for folder in settings.reader.custom_msg_paths
        for path in sorted(directories.files_below(Path(folder), ".msg"))
    ]


def reading_of(settings: Settings, schemas: Mapping[str, Mapping[str, str]]) -> str:
    """Returns a hash of all that decides how bags are read: settings, definitions, this version.

    Stored fragments of another hash are made again. `schemas` is the schema map of the settings.
    """
    storage = settings.storage
    return _hash_of(
        (
            package_version(),
            None if storage.target in _READ_ALIKE else storage.target,
            settings.reader.max_chunk_mb,
            _definitions_of(settings),
            settings.data.max_array_length,
            settings.data.pose_topic,
            settings.data.map_frame,
            settings.data.tf_topics,
            settings.data.tf_clock,
            {name: dict(fields) for name, fields in sorted(schemas.items())},
        )
    )


def _hash_of(value: object) -> str:
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()[:16]


def build_backfill(settings: Settings, memory: Memory) -> Backfill:
    """Returns the backfill of a memory, which fills its store of columns if it has one."""
    from ros2_memory.columns.fill import Filling, StoreLimits
    from ros2_memory.serving.backfill import Backfill

    scanner, store = memory.scanner, settings.store
    if scanner.store is None:
        return Backfill(memory, None)
    return Backfill(
        memory,
        Filling(
            scanner,
            memory.reader,
            memory.bag_dir,
            memory.clock,
            StoreLimits(store.max_share, round(store.max_gb * GB)),
            large=memory.large,
        ),
    )


def query_settings_of(settings: Settings) -> QuerySettings:
    """Returns the settings that queries need.

    Raises:
        ConfigError: the labels are refused.
    """
    from ros2_memory.history.context import Latching, QuerySettings

    data = settings.data
    records = not isinstance(settings.recorder, NullRecorderNode)
    return QuerySettings(
        position_tolerance_m=data.position_tolerance_m,
        time_tolerance_s=data.time_tolerance_s,
        pose_topic=data.pose_topic,
        map_frame=data.map_frame,
        tf_topics=data.tf_topics,
        tf_static_topics=data.tf_static_topics,
        now=data.now,
        tf_clock=data.tf_clock,
        max_plausible_speed_mps=data.max_plausible_speed_mps,
        split_duration_s=settings.recording.split_duration_s,
        screened=records and bool(load_exclusions(settings)),
        recording=settings.data.recording or "",
        include_active=settings.reader.include_active,
        kept=retention_limits(settings) if records else None,
        latching=Latching(
            data.tf_static_topics, data.latched_topics.include, data.latched_topics.exclude
        ),
        min_score=data.min_score,
        labels=load_labels(settings),
        places=places_of(settings),
        places_file=str(data.places_file),
    )


def places_of(settings: Settings) -> tuple[Place, ...]:
    """Returns the named places as regions.

    Raises:
        ConfigError: their file is missing or refused.
    """
    from ros2_memory.core.regions import Circle, Place, Polygon, Rectangle, Storey

    def plan(shape: PlaceShape) -> Region:
        if shape.polygon is not None:
            return Polygon(shape.polygon)
        if isinstance(shape.x, tuple) and isinstance(shape.y, tuple):
            return Rectangle(*shape.x, *shape.y)
        # The model allows no other shape.
        circle = cast("tuple[float, float, float]", (shape.x, shape.y, shape.radius_m))
        return Circle(*circle)

    def region(shape: PlaceShape) -> Region:
        return plan(shape) if shape.z is None else Storey(plan(shape), *shape.heights)

    default = settings.data.map_frame or ""
    return tuple(
        Place(name, shape.frame or default, region(shape))
        for name, shape in load_places(settings).items()
    )


def build_dispatcher(
    settings: Settings,
    memory: Memory,
    telemetry: Telemetry = SILENT,
    fleet: Fleet | None = None,
    *,
    is_patient: bool = False,
) -> Dispatcher:
    """Returns the dispatcher of tool calls to a memory, or to the robots of a fleet.

    With `is_patient` a call takes as long as it needs, and answers from all that it should read.
    """
    from ros2_memory.serving.dispatch import Dispatcher
    from ros2_memory.tools.build import build_tools, readable_tools
    from ros2_memory.tools.replies import Replies

    server = settings.server
    additions = server.tools == "all"
    tools = build_tools(
        memory.limits,
        additions=additions,
        # Where nothing records nothing is deleted, and nobody would save a moment.
        writing=server.write_tools and not isinstance(settings.recorder, NullRecorderNode),
    )
    if fleet is not None:
        from ros2_memory.fleet.select import select_tools
        from ros2_memory.fleet.tools import fleet_tools

        tools = fleet_tools(tools, fleet, server.max_reply_chars)
        if additions:
            tools = (*tools, *select_tools(fleet, server.max_reply_chars))
    return Dispatcher(
        memory,
        tools,
        Replies(settings.recording.bag_dir, server.max_reply_chars),
        call_timeout_s=math.inf if is_patient else server.call_timeout_s,
        readable=readable_tools() if additions and fleet is None else (),
        telemetry=telemetry,
        log_arguments=settings.logging.arguments,
        most_questions=server.keep_questions,
    )


def build_server(
    settings: Settings,
    memory: Memory,
    telemetry: Telemetry = SILENT,
    progress: Callable[[], Progress] | None = None,
    fleet: Fleet | None = None,
) -> EpisodicServer:
    """Returns the MCP server that answers from a memory, or from the robots of a fleet.

    `progress` tells how far the store of columns is filled.
    """
    from ros2_memory.serving.mcp_server import EpisodicServer
    from ros2_memory.tools.instructions import instructions

    server = settings.server
    # Answers make many objects that stay in memory, and hardly any garbage. To look for garbage
    # after each 700 new objects, as Python does, takes up to a sixth of the first answers.
    gc.set_threshold(NEW_OBJECTS)
    return EpisodicServer(
        build_dispatcher(settings, memory, telemetry, fleet),
        name=server.name,
        version=package_version(),
        instructions=instructions(
            memory.limits, additions=server.tools == "all", several=fleet is not None
        ),
        progress=progress,
    )


def build_telemetry(settings: Settings, memory: Memory) -> Telemetry:
    """Returns the observers of tool calls that the configuration chooses; none by default.

    Raises:
        ConfigError: the extra is not installed, metrics have no HTTP to be served by, or the
            environment describes no exporter.
    """
    observers: list[Observer] = []
    exposition = None
    if settings.server.metrics:
        if settings.server.transport == "stdio":
            raise ConfigError(
                "server.metrics: true is not allowed with server.transport=stdio, which has no "
                "/metrics; choose server.transport=sse or leave it out"
            )
        require_extra("server.metrics: true", "observability", "prometheus_client")
        from prometheus_client import disable_created_metrics

        from ros2_memory.observability.prometheus import MemoryGauges, Metrics

        # Series of when each counter began, which this format has no use for, in all registries.
        disable_created_metrics()  # type: ignore[no-untyped-call]  # has no types
        metrics = Metrics(MemoryGauges(memory))
        observers.append(metrics)
        exposition = metrics.exposition
    if settings.server.traces:
        modules = ("opentelemetry", "opentelemetry.sdk", "opentelemetry.exporter")
        require_extra("server.traces: true", "observability", *modules)
        from ros2_memory.observability import opentelemetry

        observers.append(
            opentelemetry.traces_from_environment(arguments=settings.logging.arguments)
        )
    return Telemetry(tuple(observers), exposition)
