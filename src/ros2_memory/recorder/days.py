"""The folder `memory/`: the messages that stay of deleted bags, in one file for each day (UTC).

Before a bag is deleted, the messages of it that stay (see `thinning`) are written to the file of
its day, `memory/20261120.thinned.mcap`. That file is a bag: the index finds it, every tool answers
from it, `forget` rewrites it. It is never changed in place: a new file takes its name.
"""

from __future__ import annotations

import heapq
import json
import re
import time
from collections import Counter, defaultdict
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, is_dataclass, replace
from itertools import chain, count, groupby
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np

from ros2_memory.analysis.clock_steps import STAMPS_BESIDE_NS
from ros2_memory.bag_dir.durable_write import flush
from ros2_memory.bag_dir.layout import (
    ERASING_FILE,
    LEAVING_FILE,
    MEMORY_FOLDER,
    THINNED_FILE,
    memory_file,
    utc_day,
)
from ros2_memory.bag_dir.state_files import (
    LEAVING,
    SUPERSEDED,
    THINNED,
    Leaving,
    Superseded,
    Thinned,
)
from ros2_memory.columns.decode import undecoded
from ros2_memory.columns.detections import DetectionColumns
from ros2_memory.core.errors import BagError, UndecodableError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import MCAP, BagFile, TimeWindow
from ros2_memory.core.text import (
    LABELS,
    LISTS_OF_LABELS,
    NAMED_IN_TYPES,
    caseless,
    looks_like_json,
    match_topics,
)
from ros2_memory.core.timebase import NS_PER_DAY, NS_PER_HOUR, Ns, ms_since
from ros2_memory.messages.detections import detections_of
from ros2_memory.recorder.thinning import (
    MINUTE_NS,
    TopicThinning,
    fields_in,
    has_numbers,
    has_samples,
    has_speech,
    rounded,
    times_near,
    with_shown_by,
)
from ros2_memory.retention.delete import new_file_beside
from ros2_memory.retention.disk import FailingFiles
from ros2_memory.storage.base import errors_as_items

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.columns.table import Table
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.storage.base import BagReader, BagWriter, Record

_WORDS_FOR_PEOPLE: Final = """
adult adults baby babies boy boys child children cyclist face faces family father girl girls
grandfather grandmother guest guests guy human humans kid kids lady man men mother nurse patient
pedestrian pedestrians people person persons resident skeleton skeletons visitor visitors woman
women
frau frauen gesicht gesichter junge kind kinder leute mädchen maedchen mann männer maenner
mensch
menschen personen
enfant enfants femme femmes fille garçon gens homme hommes humain personne personnes
visage
bambina bambino donna donne faccia persone ragazza ragazzo umano uomini uomo viso volto
cara chica chico gente hombre hombres humano mujer mujeres niña niño niños
persona
personas rostro
criança homem homens menina menino mulher mulheres pessoa pessoas rosto
gezicht jongen kinderen mannen meisje mens mensen vrouw vrouwen
ansigt ansikte ansikt barn flicka jente kvinde kvinna kvinne människa menneske pige
pojke
człowiek czlowiek dziecko kobieta ludzie mężczyzna osoba osoby twarz
adam çocuk insan kadın kadin kişi yüz
девочка женщина лицо люди мальчик мужчина ребёнок человек
人 人物 人脸 人类 行人 男人 女人 男 女 孩子 小孩 儿童 男性 女性 子供 子ども 顔 歩行者
사람 남자 여자 아이 어린이 얼굴 보행자
"""  # noqa: RUF001 (Turkish)
_PEOPLE: Final = frozenset(caseless(_WORDS_FOR_PEOPLE).split())
_WORD: Final = re.compile(r"[A-Z]*[^\W\d_A-Z]+|[A-Z]+")
"""Words also begin at capitals: `TrackedPersons`."""
_WORD_OR_NUMBER: Final = re.compile(r"[^\W\d_]+|\d+")
_OF_DETECTIONS: Final = LISTS_OF_LABELS.union(LABELS)
_NAMES: Final = _OF_DETECTIONS.union(
    NAMED_IN_TYPES.values(), ("child_frame_id", "frame_id", "name", "names")
)
"""Fields that may name people."""
_FIRST_DAY: Final = "2014"
"""Earlier days have a wrong date: there was no ROS 2."""
_QOS: Final = "offered_qos_profiles"
MONTH_NS: Final[Ns] = 31 * NS_PER_DAY
"""The numbers of older days have one message a minute."""
_BY_MINUTE: Final = ("ros2_memory_numbers_s", "60")
"""In the metadata of each channel of a day that was thinned to minutes: it is not thinned again."""
GRACE_S: Final = 86_400.0
"""How long the recorder runs with `memory.keep=false` before it deletes the days: the setting may
be an accident."""
COUNTED_S: Final = 600.0
"""How often the rest of that time is written."""
_EVERYTHING: Final = TimeWindow.everything()
T = TypeVar("T")
_TopicType: TypeAlias = tuple[str, str]
"""A topic and its type."""

_log = get_logger(__name__)


class MemoryLimits(NamedTuple):
    """Which messages of deleted bags may stay, and how many bytes of them for how long.

    Attributes:
        texts: names or globs of topics whose texts may stay: speech, descriptions, logs.
        labels: labels of people that may stay.
        people: more words for people: names, roles.
        short_lived: names or globs of topics of which nothing stays, unless they are latched.
    """

    texts: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()
    people: tuple[str, ...] = ()
    short_lived: tuple[str, ...] = ()
    max_bytes: int = 10**9
    max_age_ns: Ns = 400 * NS_PER_DAY


@dataclass(eq=False, repr=False)
class MemoryDays:
    """Writes and deletes the days of one bag directory. The caller holds the directory's lock.

    Args:
        reader: leaves out messages that count in another recording.
        own: lists the days as the recorder's own.
        extractor: finds detections by the schema map.
        limits: which messages stay; None keeps none, and `clear` deletes the days.
    """

    bag_dir: Path
    reader: BagReader
    writer: BagWriter
    own: OwnRecordings
    extractor: SchemaExtractor
    _: KW_ONLY
    limits: MemoryLimits | None
    static_topics: Collection[str]
    monotonic: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._folder = self.bag_dir / MEMORY_FOLDER
        self.keeps = self.limits is not None
        self._limits = self.limits or MemoryLimits()
        words = [_words_in(name) for name in self._limits.people]
        self._people = [name for name in words if name.strip()]
        self._checked_for_minutes: set[Path] = set()
        self._left_unthinned: set[Path] = set()
        self._failing = FailingFiles(self.monotonic)
        self._counted_at_s: float | None = None

    def keep(self, snapshot: Snapshot, paths: Collection[str]) -> None:
        """Writes the messages that stay of the bags at `paths`, which may then be deleted.

        Messages that a day has already are not written twice. Damaged messages do not stay.

        Raises:
            BagError: a day cannot be written, or the disk fails while a bag is read.
            OSError: a day cannot be written, or the list of own recordings cannot be read.
        """
        if (self.bag_dir / ERASING_FILE).exists():
            raise BagError(str(self._folder), "messages are being forgotten: they must not stay")
        begun = time.perf_counter_ns()
        bags = [bag for bag in snapshot.bags if bag.file in paths]
        if not bags:
            return
        known = self._read_thinned()
        thinned = with_shown_by(known, snapshot, bags)
        selection = self._select(snapshot, bags, thinned)
        if thinned != known:
            THINNED.write(self.bag_dir, thinned)
        # A bag that crosses midnight goes to the day of its start as a whole.
        days: dict[str, list[BagFile]] = defaultdict(list)
        for bag in bags:
            days[utc_day(bag.start)].append(bag)
        messages = 0
        for day, day_bags in days.items():
            records = sorted(self._staying_records(day_bags, selection), key=attrgetter("log_time"))
            messages += len(records)
            if records:
                self._write_day(day, records, day_bags)
        for topic, unwritten in selection.unwritten.items():
            reason = selection.reasons[topic]
            _log.warning("memory_not_written", topic=topic, messages=unwritten, reason=reason)
        _log.info(
            "memory_kept",
            days=[*days],
            bags=len(bags),
            messages=messages,
            left_out=selection.left_out,
            duration_ms=ms_since(begun),
        )

    def limit(self, now: Ns | None) -> None:
        """Deletes days by age and then by size, and thins one old day to a message a minute.

        If `memory.keep` is false, all days go in time, see `clear`.

        Args:
            now: the wall time that ages count from; None if the clock may be wrong: no day ages.

        Raises:
            BagError: a day cannot be read or written.
            OSError: the folder cannot be read, or a day cannot be deleted.
        """
        self._delete_unfinished()
        self.clear()
        if not self.keeps:
            return
        today = ""
        if now is not None:
            today = utc_day(now)
            oldest = utc_day(now - self._limits.max_age_ns)
            for path in self._days():
                if _FIRST_DAY <= _day_of(path) < oldest:
                    self._delete_day(path)
        # Days after today come from a clock that was ahead. They go first: they would push out all
        # others, and never age.
        days = sorted(self._days(), key=lambda path: "" < today < _day_of(path), reverse=True)
        size = sum(path.stat().st_size for path in days)
        for path in days:
            if size <= self._limits.max_bytes:
                break
            size -= path.stat().st_size
            self._delete_day(path)
        self._forget_deleted()
        if now is not None:
            self._thin_one_before(utc_day(now - MONTH_NS))

    def _thin_one_before(self, newest: str) -> None:
        """Thins the oldest day before another one (`20261120`) that is not thinned to minutes."""
        for path in self._days():
            if _day_of(path) < newest and path not in self._checked_for_minutes:
                self._checked_for_minutes.add(path)
                channels = self.reader.channels(path)
                is_thinned = all(_BY_MINUTE in channel.metadata for channel in channels)
                # A damaged day that is rewritten would not show any more that messages are missing.
                if not is_thinned and self._is_whole(path):
                    self._left_unthinned.add(path)
                    self._thin_to_minutes(path)
                    self._left_unthinned.remove(path)
                    return
        # Nothing else is left to thin: where the disk was full, there may be room now.
        self._checked_for_minutes -= self._left_unthinned

    def _forget_deleted(self) -> None:
        """Drops from `thinned.json` what is older than all days; deletes it with the last day."""
        thinned, days = self._read_thinned(), self._days()
        if thinned.since is None:
            return
        if not days:
            THINNED.remove(self.bag_dir)
            return
        left = thinned.from_day(_day_of(days[0]))
        if left != thinned:
            THINNED.write(self.bag_dir, left)

    def _delete_unfinished(self) -> None:
        """Deletes the new files of days that a kill left; nothing else writes there now."""
        if not self._folder.is_symlink():
            for path in self._folder.glob(".*.thinned.mcap.*"):
                path.unlink(missing_ok=True)

    def _delete_day(self, path: Path) -> None:
        path.unlink()
        _log.warning("memory_day_deleted", path=str(path))

    def _thin_to_minutes(self, path: Path) -> None:
        """Rewrites a day with one message a minute of each topic of numbers, and their extremes."""
        detections = DetectionColumns(self.extractor)
        thinnings: dict[_TopicType, TopicThinning] = {}
        for table in self._tables(path):
            if has_numbers(table) and not table.channel.latched:
                key = (table.channel.topic, table.channel.type)
                thinnings.setdefault(key, TopicThinning(detections, MINUTE_NS)).add(table)
        times = {key: {*thinning.times().tolist()} for key, thinning in thinnings.items()}
        self._replace_day(path, self._minute_records(path, times), ())

    def _minute_records(
        self, path: Path, times: Mapping[_TopicType, Collection[Ns]]
    ) -> Iterator[Record]:
        """Yields the messages of a day: of the topics in `times` those of these log times (ns)."""
        for record in self._merged_by_hour(path, ()):
            channel = record.channel
            key = channel.topic, channel.type
            if key not in times or record.log_time in times[key]:
                metadata = dict.fromkeys([*channel.metadata, _BY_MINUTE])
                yield record._replace(channel=replace(channel, metadata=tuple(metadata)))

    def clear(self) -> None:
        """Deletes all days if `memory.keep` is false, `GRACE_S` after a warning.

        The recorder's own running time counts, since the wall clock may be wrong.

        Raises:
            OSError: a day cannot be deleted, or the rest of the time cannot be written.
        """
        days = self._days()
        if self.keeps or not days:
            if (self.bag_dir / LEAVING_FILE).exists():
                LEAVING.remove(self.bag_dir)
            return
        if self._count_down(len(days)):
            return
        for path in [*days, self.bag_dir / THINNED_FILE]:
            path.unlink(missing_ok=True)
        _log.warning("memory_deleted", days=len(days), reason="memory.keep is false")
        with suppress(OSError):
            self._folder.rmdir()
        LEAVING.remove(self.bag_dir)

    def _count_down(self, days: int) -> float:
        """Writes for how long the recorder must still run until it deletes the days; returns it."""
        now_s, counted_at_s = self.monotonic(), self._counted_at_s
        left_s = GRACE_S
        with suppress(ValueError):
            left_s = (LEAVING.read(self.bag_dir) or Leaving(GRACE_S)).left_s
        if counted_at_s is not None:
            left_s = max(left_s - (now_s - counted_at_s), 0.0)
        if counted_at_s is None or now_s - counted_at_s >= COUNTED_S or not left_s:
            LEAVING.write(self.bag_dir, Leaving(left_s))
            self._counted_at_s = now_s
        if counted_at_s is None:
            _log.warning("memory_leaves", days=days, left_s=left_s)
        return left_s

    def _days(self) -> list[Path]:
        """Returns the files of days that the recorder wrote, oldest first. Follows no link."""
        if self._folder.is_symlink() or not self._folder.is_dir():
            return []
        paths = [path for path in self._folder.glob(f"*{MCAP}") if not path.is_symlink()]
        own = (path for path in paths if self.own.owns_bag(path))
        # The numbered files of a day, whose names are longer, are newer than its first one.
        return sorted(own, key=lambda path: (_day_of(path), len(path.name), path))

    def _read_thinned(self) -> Thinned:
        """Returns the content of `thinned.json`; an empty one if the file is missing or damaged."""
        try:
            return THINNED.read(self.bag_dir) or Thinned()
        except ValueError as error:
            _log.warning("memory_not_read", path=THINNED_FILE, reason=str(error))
            return Thinned()

    def _select(
        self, snapshot: Snapshot, bags: Sequence[BagFile], thinned: Thinned
    ) -> _StayingMessages:
        """Returns which messages of bags stay; messages near a pause in `thinned` do, too."""
        selection = _StayingMessages()
        thinnings: dict[_TopicType, TopicThinning] = {}
        detections = DetectionColumns(self.extractor)
        window = TimeWindow(min(bag.start for bag in bags), max(bag.end for bag in bags) + 1)
        near = window.widened(STAMPS_BESIDE_NS)
        # `thinned` has the pauses of a year.
        pauses = [pause for pause in thinned.pauses if near.overlaps(*pause)]
        for table in chain.from_iterable(self._tables(bag.path) for bag in bags):
            key = topic, _ = table.channel.topic, table.channel.type
            reason = self._why_left_out(table, snapshot)
            if reason is not None:
                selection.left_out[topic] = reason
            elif self._is_latched(snapshot, topic):
                selection.latched.add(topic)
                selection.times[key].update(table.log_times.tolist())
            else:
                thinnings.setdefault(key, TopicThinning(detections)).add(table)
                selection.times[key].update(times_near(pauses, table.log_times).tolist())
        for key, thinning in thinnings.items():
            selection.times[key].update(thinning.times().tolist())
        return selection

    def _why_left_out(self, table: Table, snapshot: Snapshot) -> str | None:
        """Returns why no message of a topic stays; None if some stay."""
        topic = table.channel.topic
        lasts = topic in self.static_topics or snapshot.timeline.is_transient_state(topic)
        if not lasts and any(match_topics((topic,), glob) for glob in self._limits.short_lived):
            return "retention.topics gives it a shorter life"
        if "" in table.left_out:  # the whole message
            return table.left_out[""]
        if has_samples(table):
            return "it has long arrays of numbers"
        if self._is_of_people(f"{topic}/{table.channel.type}") and not self._limits.labels:
            return "it is of people, and memory.labels names none"
        if has_speech(table) and not any(
            match_topics((topic,), glob) for glob in self._limits.texts
        ):
            return "it has texts, and memory.texts does not name it"
        return None

    def _is_latched(self, snapshot: Snapshot, topic: str) -> bool:
        """Whether all messages of a topic stay, since each is valid until the next one."""
        timeline = snapshot.timeline
        return topic in self.static_topics or (
            timeline.is_transient_state(topic)
            and all(timeline.pace(topic, path).is_rare for path in timeline.recordings(topic))
        )

    def _staying_records(
        self, bags: Sequence[BagFile], selection: _StayingMessages
    ) -> Iterator[Record]:
        """Yields the messages that stay, without people whose label may not stay."""
        topics = [topic for (topic, _), times in selection.times.items() if times]
        for bag in bags:
            records = self.reader.records(bag.path, topics, _EVERYTHING)
            for record in self._readable(bag.path, records):
                channel = record.channel
                if record.log_time not in selection.times.get((channel.topic, channel.type), ()):
                    continue
                is_latched = channel.topic in selection.latched
                if channel.latched and not is_latched:
                    # A thinned message must not look as if it were valid until the next.
                    metadata = tuple((key, value) for key, value in channel.metadata if key != _QOS)
                    channel = replace(channel, latched=False, metadata=metadata)
                thinned = record._replace(channel=channel)
                try:
                    staying = self._without_people(thinned, rounds=not is_latched)
                except UndecodableError as error:
                    selection.unwritten[channel.topic] += 1
                    selection.reasons.setdefault(channel.topic, error.reason)
                    continue
                if staying is not None:
                    yield staying

    def _tables(self, path: Path) -> Iterator[Table]:
        """Yields the messages of a bag as tables, as `_readable` does."""
        for group in self._readable(path, undecoded(self.reader, path, skip_undecodable=True)):
            yield from group.tables()

    def _readable(self, path: Path, items: Iterator[T]) -> Iterator[T]:
        """Yields what can be read of a bag; what cannot is logged, and does not stay.

        Raises:
            BagUnreachableError: the disk fails to read the bag, and may recover.
        """
        for item in errors_as_items(items):
            if not isinstance(item, BagError):
                yield item
            elif self._failing.may_recover(path, item):
                raise item
            else:
                _log.warning("memory_not_read", path=str(path), reason=item.reason)

    def _without_people(self, record: Record, *, rounds: bool) -> Record | None:
        """Returns a message without people whose label may not stay.

        None if the people cannot be removed from it, or if it has no transform left.

        Args:
            record: the message.
            rounds: whether its numbers are rounded, too.

        Raises:
            UndecodableError: it cannot be decoded, or not be encoded again.
        """
        channel = record.channel
        whole = self.reader.decode(record)
        message = _without_hidden(whole, self._is_hidden)
        if message is not whole and getattr(message, "transforms", None) == []:
            return None
        if message is None or self._names_people(message, channel.type):
            return None
        if rounds:
            message = rounded(message, self.reader.definition(channel))
        if message is whole:
            return record
        return record._replace(payload=self.reader.encode(channel, message))

    def _names_people(self, message: object, type_name: str) -> bool:
        """Whether a detection, a name or a JSON text in a message has a label that may not stay."""
        detections = [*detections_of(self.extractor.exact(message, type_name))]
        labels = [*_labels(message)]
        for _, value in fields_in(message):
            if isinstance(value, str):
                detections += detections_of(value)
                labels += _labels_in_json(value)
        labels += [(LABELS[0], detection.label) for detection in detections]
        return any(self._is_hidden(field, text) for field, text in labels)

    def _is_hidden(self, field: str, text: str) -> bool:
        """Whether the text of a field is a label of people that may not stay.

        A number may be a label of a detection: 0 is a person in COCO. Numbers of joints and frames
        are no labels.
        """
        if text in self._limits.labels:
            return False
        is_number = field in _OF_DETECTIONS and text.strip().isdecimal()
        return is_number or self._is_of_people(text)

    def _is_of_people(self, name: str) -> bool:
        """Whether a label, a frame or a topic has a word for people in it: `person_1`."""
        # The whole name as well: no word begins at a capital in `MÄDCHEN` and `McDonald`.
        words = _words_in(" ".join(_WORD.findall(name))) + _words_in(name)
        return not _PEOPLE.isdisjoint(words.split()) or any(one in words for one in self._people)

    def _write_day(self, day: str, records: Sequence[Record], bags: Sequence[BagFile]) -> None:
        """Adds messages to a day.

        Args:
            day: the day (UTC), as `20261120`.
            records: the messages that stay.
            bags: the bags that these messages come from.

        Raises:
            BagError: the day cannot be written.
            OSError: the day cannot be written.
        """
        if self._folder.is_symlink():
            raise BagError(str(self._folder), "a symbolic link, which is not followed: remove it")
        self._folder.mkdir(exist_ok=True)
        path = self._writable_file(day)
        self.own.add_bags(self._folder, [path.name])
        self._replace_day(path, self._merged_by_hour(path, records), bags)
        self._checked_for_minutes.discard(path)

    def _replace_day(self, path: Path, records: Iterator[Record], bags: Sequence[BagFile]) -> None:
        """Replaces the file of a day, and lists the bags that the day now stands for.

        From then on these bags, and those listed for the day before, no longer count.
        """
        name = f"{MEMORY_FOLDER}/{path.name}"
        with new_file_beside(path) as new:
            self.writer.write(new, records, dense=True)
            status, known = new.stat(), Superseded()
            with suppress(ValueError):  # a damaged list is replaced
                known = SUPERSEDED.read(self.bag_dir) or known
            # A bag that could not be deleted yet stays listed.
            listed = {bag: day for bag, day in known.bags.items() if (self.bag_dir / bag).exists()}
            days = {day: known.days[day] for day in {*listed.values()} - {name}}
            days[name] = status.st_size, status.st_mtime_ns
            listed |= {str(bag.path.relative_to(self.bag_dir)): name for bag in bags}
            SUPERSEDED.write(self.bag_dir, Superseded(days, listed))
            new.replace(path)
        flush(self._folder)
        flush(self.bag_dir)

    def _writable_file(self, day: str) -> Path:
        """Returns a new file for a day, or its own whole one; never a damaged or a foreign one."""
        for number in count():
            path = self._folder / memory_file(day, number)
            with suppress(BagError):
                if not path.exists() or (self._is_whole(path) and self.own.owns_bag(path)):
                    break
        return path

    def _is_whole(self, path: Path) -> bool:
        summary = self.reader.summarize(path)
        return summary.complete and not summary.notes

    def _merged_by_hour(self, path: Path, added: Sequence[Record]) -> Iterator[Record]:
        """Yields the messages of a day and `added` ones by hour and topic, each once.

        The `added` ones are in order of log time.
        Similar messages lie together, and compress well.
        """
        before: Iterator[Record] = iter(())
        if path.exists():
            topics = [channel.topic for channel in self.reader.channels(path)]
            before = self.reader.records(path, topics, _EVERYTHING)
        records = heapq.merge(before, added, key=attrgetter("log_time"))
        for _, of_hour in groupby(records, key=lambda record: record.log_time // NS_PER_HOUR):
            identities: set[tuple[str, Ns, Ns, bytes]] = set()
            for record in sorted(of_hour, key=attrgetter("channel.topic", "log_time")):
                channel, logged, published, payload = record
                identity = (channel.topic, logged, published, payload)
                if identity not in identities:
                    identities.add(identity)
                    yield record


@dataclass(slots=True)
class _StayingMessages:
    """Which messages of bags stay.

    Attributes:
        times: log times (ns) of the messages that stay, by topic and type.
        latched: topics whose messages all stay.
        left_out: topics whose messages all go, each with the reason.
        unwritten: how many messages that were to stay could not be written, by topic.
        reasons: why the first of these could not.
    """

    times: dict[_TopicType, set[Ns]] = field(default_factory=lambda: defaultdict(set))
    latched: set[str] = field(default_factory=set)
    left_out: dict[str, str] = field(default_factory=dict)
    unwritten: Counter[str] = field(default_factory=Counter)
    reasons: dict[str, str] = field(default_factory=dict)


def _day_of(path: Path) -> str:
    """Returns the day of a file, as `utc_day`."""
    return path.name[:8]


def _words_in(name: str) -> str:
    """Returns the words and numbers in a name, each between blanks: ` user 1 ` of `user_1`."""
    return f" {' '.join(_WORD_OR_NUMBER.findall(caseless(name)))} "


def _labels(node: object, field: str = "") -> Iterator[tuple[str, str]]:
    """Yields each name in an entry of a list, with the field that has it.

    A `name`, for example, or the `class_id` of `results[0].hypothesis`.
    """
    if isinstance(node, str):
        yield field, node
    for name, value in fields_in(node):
        for item in value if isinstance(value, list) else [value]:
            if name in _NAMES or not isinstance(item, str):
                yield from _labels(item, name)


def _labels_in_json(text: str) -> Iterator[tuple[str, str]]:
    """Yields each label in a JSON text, with the key that has it."""
    fields: list[tuple[str, object]] = []
    if looks_like_json(text):
        with suppress(ValueError, RecursionError):
            json.loads(text, object_pairs_hook=fields.extend)
    for name, value in fields:
        if name in _OF_DETECTIONS:
            items = value if isinstance(value, list) else [value]
            yield from ((name, str(item)) for item in items if isinstance(item, str | int))


def _without_hidden(message: object, is_hidden: Callable[[str, str], bool]) -> object:
    """Returns a decoded message without the entries of its lists that have a hidden label.

    A list of texts names the entries of lists of the same length: `name` and `position`. None if it
    has hidden ones, and the message a list of another length, such as four numbers for each name.
    """
    if not is_dataclass(message) or isinstance(message, type):
        return message
    lists = {
        name: value for name, value in fields_in(message) if isinstance(value, list | np.ndarray)
    }
    hidden = {name: _hidden_rows(name, items, is_hidden) for name, items in lists.items()}
    changed: dict[str, object] = {}
    for name, items in lists.items():
        rows = set(hidden[name])
        for other, texts in lists.items():
            if len(items) and hidden[other] and all(isinstance(text, str) for text in texts):
                if len(items) != len(texts):
                    return None
                rows |= hidden[other]
        if rows and isinstance(items, np.ndarray):
            changed[name] = np.delete(items, [*rows], axis=0)
        elif rows:
            changed[name] = [item for row, item in enumerate(items) if row not in rows]
    return replace(message, **changed) if changed else message


def _hidden_rows(
    name: str, items: Iterable[object], is_hidden: Callable[[str, str], bool]
) -> set[int]:
    """Returns the rows of the list `name` that have a hidden label."""
    rows: set[int] = set()
    for row, item in enumerate(items):
        if any(is_hidden(field, text) for field, text in _labels(item, name)):
            rows.add(row)
    return rows
