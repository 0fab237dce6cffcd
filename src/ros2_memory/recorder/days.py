"""The folder `memory/`: what stays of bags that are deleted, a file for each day (UTC).

Before bags go, the messages of them that stay (see `thinning`) are on the disk in the file of their
day, `memory/20261120.mcap`. It is a bag like any other: the index finds it, every tool answers from
it, `forget` rewrites it. It is never changed in place: a new file takes its name.
"""

from __future__ import annotations

import json
import re
import time
from collections import defaultdict
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, is_dataclass, replace
from itertools import chain, repeat, starmap
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

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
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.text import (
    LABELS,
    LISTS_OF_LABELS,
    NAMED_IN_TYPES,
    caseless,
    looks_like_json,
    match_topics,
)
from ros2_memory.core.timebase import NS_PER_S, Ns, ms_since
from ros2_memory.messages.detections import detections_of
from ros2_memory.recorder.thinning import (
    MINUTE_NS,
    TopicThinning,
    beside_pauses,
    fields_in,
    has_numbers,
    is_said,
    is_sampled,
    rounded,
    shown_by,
)
from ros2_memory.retention.delete import beside
from ros2_memory.retention.disk import FailingFiles
from ros2_memory.storage.base import or_errors

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence
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
enfant enfants femme femmes fille garçon garcon gens homme hommes humain personne personnes
visage
bambina bambino donna donne faccia persone ragazza ragazzo umano uomini uomo viso volto
cara chica chico gente hombre hombres humano mujer mujeres niña niño niños nina nino ninos
persona
personas rostro
criança crianca homem homens menina menino mulher mulheres pessoa pessoas rosto
gezicht jongen kinderen mannen meisje mens mensen vrouw vrouwen
ansigt ansikte ansikt barn flicka jente kvinde kvinna kvinne människa manniska menneske pige
pojke
człowiek czlowiek dziecko kobieta ludzie mężczyzna mezczyzna osoba osoby twarz
adam çocuk cocuk insan kadın kadin kişi kisi yüz
девочка женщина лицо люди мальчик мужчина ребёнок ребенок человек
人 人物 人脸 人类 行人 男人 女人 男 女 孩子 小孩 儿童 男性 女性 子供 子ども 顔 歩行者
사람 남자 여자 아이 어린이 얼굴 보행자
"""  # noqa: RUF001 (Turkish)
_PEOPLE: Final = frozenset(_WORDS_FOR_PEOPLE.split())
_WORD: Final = re.compile(r"[A-Z]*[^\W\d_A-Z]+|[A-Z]+")
"""Words also begin at capitals: `TrackedPersons`."""
_WORD_OR_NUMBER: Final = re.compile(r"[^\W\d_]+|\d+")
_OF_DETECTIONS: Final = LISTS_OF_LABELS.union(LABELS)
_NAMES: Final = _OF_DETECTIONS.union(
    NAMED_IN_TYPES.values(), ("child_frame_id", "frame_id", "name", "names")
)
"""Fields that may name people."""
_FIRST_DAY: Final = "2014"
"""Days before it have a wrong date: there was no ROS 2."""
_QOS: Final = "offered_qos_profiles"
MONTH_NS: Final[Ns] = 31 * 86_400 * NS_PER_S
"""The numbers of older days have one message a minute."""
_BY_MINUTE: Final = ("ros2_memory_numbers_s", "60")
"""In the metadata of each channel of such a day: it is not read again to thin it."""
GRACE_S: Final = 86_400.0
"""So long the recorder runs before days are deleted that nobody wants: `memory.keep` may have been
lost by accident."""
COUNTED_S: Final = 600.0
HOUR_NS: Final[Ns] = 3600 * NS_PER_S
_EVERYTHING: Final = TimeWindow.everything()

_log = get_logger(__name__)


class MemoryLimits(NamedTuple):
    """What may stay of deleted bags, and how much.

    Attributes:
        texts: names or globs of the topics of which texts may stay: speech, descriptions, logs.
        people: words for people besides those that are known: names, roles.
    """

    texts: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()
    people: tuple[str, ...] = ()
    max_bytes: int = 10**9
    max_age_ns: Ns = 400 * 86_400 * NS_PER_S


@dataclass(eq=False, repr=False)
class MemoryDays:
    """Writes and deletes the days of one bag directory, whose lock its caller holds.

    Args:
        reader: reads bags, without what counts in another recording.
        own: lists the days as the recorder's own.
        extractor: has the schema map, by which detections are found.
        limits: which messages stay; None: none, and the days that exist are deleted.
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
        """Sets what is known at the beginning."""
        self._folder = self.bag_dir / MEMORY_FOLDER
        self.keeps = self.limits is not None
        self._limits = self.limits or MemoryLimits()
        named = map(_words_in, self._limits.people)
        self._people = [words for words in named if words.strip()]
        self._static_topics = frozenset(self.static_topics)
        self._minutes: set[Path] = set()
        self._failing = FailingFiles(self.monotonic)
        self._leaving_since: float | None = None

    def keep(self, snapshot: Snapshot, paths: Collection[str]) -> None:
        """Makes durable what stays of some bags, which may be deleted then.

        What stays already is not written twice. What is damaged in a bag does not stay.

        Raises:
            BagError: a day cannot be written, or the disk fails while a bag is read.
            OSError: likewise, or the list of the recorder's own bags cannot be read.
        """
        if (self._folder.parent / ERASING_FILE).exists():
            raise BagError(str(self._folder), "messages are being forgotten: they must not stay")
        begun = time.perf_counter_ns()
        bags = [bag for bag in snapshot.bags if bag.file in paths]
        if not bags:
            return
        thinned = self._read_thinned()
        shown = shown_by(thinned, snapshot, bags)
        chosen = self._choose(snapshot, bags, shown)
        if shown != thinned:
            THINNED.write(self._folder.parent, shown)
        # Whole bags, also across midnight: a bag is in one day, or in none.
        days: dict[str, list[BagFile]] = defaultdict(list)
        for bag in bags:
            days[utc_day(bag.start)].append(bag)
        messages = 0
        for day, of_day in days.items():
            records = sorted(self._staying_records(of_day, chosen), key=attrgetter("log_time"))
            messages += len(records)
            if records:
                self._write_day(day, records, of_day)
        _log.info(
            "memory_kept",
            days=[*days],
            bags=len(bags),
            messages=messages,
            left_out=chosen.left_out,
            duration_ms=ms_since(begun),
        )

    def limit(self, now: Ns | None) -> None:
        """Deletes the days that are too old, then the oldest above the size; thins one further.

        Age counts from `now`; without it nothing ages. Days before there was ROS 2 have a wrong
        date, and do not age either.

        Raises:
            BagError: a day cannot be read or written anew.
            OSError: the folder cannot be read, or a day not be deleted.
        """
        oldest = "" if now is None else memory_file(utc_day(now - self._limits.max_age_ns))
        today = "" if now is None else memory_file(utc_day(now))
        for path in self._days():
            if _FIRST_DAY <= path.name < oldest:
                self._delete_day(path)
        # Those of a clock that was ahead first: they would push out all others, and never age.
        days = sorted(self._days(), key=lambda path: "" < today < path.name, reverse=True)
        size = sum(path.stat().st_size for path in days)
        for path in days:
            if size <= self._limits.max_bytes:
                break
            size -= path.stat().st_size
            self._delete_day(path)
        self._forget_deleted()
        if now is not None:
            self._thin_one_before(memory_file(utc_day(now - MONTH_NS)))

    def _thin_one_before(self, month_ago: str) -> None:
        """Thins the oldest day before one, given by the names of files, that has still to be."""
        for path in self._days():
            if path.name < month_ago and path not in self._minutes:
                self._minutes.add(path)
                channels = self.reader.channels(path)
                is_thinned = all(_BY_MINUTE in channel.metadata for channel in channels)
                # A damaged day written anew would not tell that something is missing.
                if not is_thinned and self._is_whole(path):
                    self._thin_to_minutes(path)
                    break

    def _forget_deleted(self) -> None:
        """Takes out of `thinned.json` what is older than all days; it goes with the last."""
        thinned, days = self._read_thinned(), self._days()
        if thinned.since is None:
            return
        if not days:
            THINNED.remove(self._folder.parent)
            return
        left = thinned.from_day(days[0].name[: len(utc_day(0))])
        if left != thinned:
            THINNED.write(self._folder.parent, left)

    def _delete_day(self, path: Path) -> None:
        path.unlink()
        _log.warning("memory_day_deleted", path=str(path))

    def _thin_to_minutes(self, path: Path) -> None:
        """Writes a day anew in which numbers have one message a minute, and their extremes."""
        detections = DetectionColumns(self.extractor)
        numbers: dict[tuple[str, str], TopicThinning] = {}
        for table in self._tables(path):
            if has_numbers(table) and not table.channel.latched:
                key = (table.channel.topic, table.channel.type)
                numbers.setdefault(key, TopicThinning(detections, MINUTE_NS)).add(table)
        stays = {key: {*thinning.times().tolist()} for key, thinning in numbers.items()}

        def thinned() -> Iterator[Record]:
            for record in self._merged_by_hour(path, ()):
                channel = record.channel
                if record.log_time in stays.get((channel.topic, channel.type), [record.log_time]):
                    metadata = dict.fromkeys([*channel.metadata, _BY_MINUTE])
                    yield record._replace(channel=replace(channel, metadata=(*metadata,)))

        self._replace_day(path, thinned(), ())

    def clear(self) -> None:
        """Deletes all days where nothing is to stay (`memory.keep`), a day after saying so.

        A day in which the recorder runs, since the wall clock may be wrong.

        Raises:
            OSError: one cannot be deleted, or how long it is until then not be written.
        """
        bag_dir, days = self._folder.parent, self._days()
        if self.keeps or not days:
            if (bag_dir / LEAVING_FILE).exists():
                LEAVING.remove(bag_dir)
            return
        now, since = self.monotonic(), self._leaving_since
        left_s = GRACE_S
        with suppress(ValueError):
            left_s = (LEAVING.read(bag_dir) or Leaving(GRACE_S)).left_s
        left_s = max(left_s - (0.0 if since is None else now - since), 0.0)
        if since is None or now - since >= COUNTED_S or not left_s:
            self._leaving_since = now
            LEAVING.write(bag_dir, Leaving(left_s))
        if since is None:
            _log.warning("memory_leaves", days=len(days), left_s=left_s)
        if left_s:
            return
        for path in [*self._folder.glob(".*.thinned.mcap.*"), *days, bag_dir / THINNED_FILE]:
            path.unlink(missing_ok=True)
        _log.warning("memory_deleted", days=len(days), reason="memory.keep is false")
        with suppress(OSError):
            self._folder.rmdir()
        LEAVING.remove(bag_dir)

    def _days(self) -> list[Path]:
        """Returns the files that the recorder wrote, the oldest first; no link is followed."""
        if self._folder.is_symlink() or not self._folder.is_dir():
            return []
        paths = [path for path in self._folder.glob("*.mcap") if not path.is_symlink()]
        return sorted(path for path in paths if self.own.owns_bag(path))

    def _read_thinned(self) -> Thinned:
        """Returns what is known of deleted bags; nothing, which is logged, of a damaged file."""
        try:
            return THINNED.read(self._folder.parent) or Thinned()
        except ValueError as error:
            _log.warning("memory_not_read", path=THINNED_FILE, reason=str(error))
            return Thinned()

    def _choose(self, snapshot: Snapshot, bags: Sequence[BagFile], shown: Thinned) -> _Staying:
        """Returns which messages of some bags stay, also beside the pauses that these show."""
        chosen = _Staying()
        thinned: dict[tuple[str, str], TopicThinning] = {}
        detections = DetectionColumns(self.extractor)
        times = TimeWindow(min(bag.start for bag in bags), max(bag.end for bag in bags) + 1)
        near = times.widened(STAMPS_BESIDE_NS)
        pauses = [pause for pause in shown.pauses if near.overlaps(*pause)]  # not those of a year
        for table in chain.from_iterable(self._tables(bag.path) for bag in bags):
            topic, kind = table.channel.topic, table.channel.type
            if why := self._why_left_out(table):
                chosen.left_out[topic] = why
            elif self._is_latched(snapshot, topic):
                chosen.latched.add(topic)
                chosen.times[topic, kind].update(table.log_times.tolist())
            else:
                thinned.setdefault((topic, kind), TopicThinning(detections)).add(table)
                chosen.times[topic, kind].update(beside_pauses(pauses, table.log_times).tolist())
        for key, thinning in thinned.items():
            chosen.times[key].update(thinning.times().tolist())
        return chosen

    def _why_left_out(self, table: Table) -> str | None:
        """Returns why nothing of a topic stays; None where something does."""
        topic = table.channel.topic
        if "" in table.left_out:
            return table.left_out[""]
        if is_sampled(table):
            return "it has long arrays of numbers"
        if self._is_of_people(f"{topic}/{table.channel.type}") and not self._limits.labels:
            return "it is of people, and memory.labels names none"
        if is_said(table) and not any(match_topics((topic,), glob) for glob in self._limits.texts):
            return "it has texts, and memory.texts does not name it"
        return None

    def _is_latched(self, snapshot: Snapshot, topic: str) -> bool:
        """Whether all messages of a topic stay: each holds until the next, however long that is."""
        timeline = snapshot.timeline
        return topic in self._static_topics or (
            timeline.is_transient_state(topic)
            and all(timeline.pace(topic, path).is_rare for path in timeline.recordings(topic))
        )

    def _staying_records(self, bags: Sequence[BagFile], chosen: _Staying) -> Iterator[Record]:
        """Yields the messages that stay, without people whose label may not."""
        topics = [*{topic for (topic, _), times in chosen.times.items() if times}]
        for bag in bags:
            for record in or_errors(self.reader.records(bag.path, topics, _EVERYTHING)):
                if isinstance(record, BagError):
                    if self._failing.may_recover(bag.path, record):
                        raise record
                    continue
                channel = record.channel
                if record.log_time not in chosen.times.get((channel.topic, channel.type), ()):
                    continue
                if channel.latched and channel.topic not in chosen.latched:
                    # Thinned, it would look like one whose messages hold until the next.
                    metadata = tuple((key, value) for key, value in channel.metadata if key != _QOS)
                    channel = replace(channel, latched=False, metadata=metadata)
                stays = self._without_people(
                    record._replace(channel=channel), rounds=channel.topic not in chosen.latched
                )
                if stays is not None:
                    yield stays

    def _tables(self, path: Path) -> Iterator[Table]:
        """Yields the messages of a bag as tables; what is damaged of it is left out.

        Raises:
            BagUnreachableError: the disk fails to read the bag, and may recover.
        """
        for group in or_errors(undecoded(self.reader, path, skip_undecodable=True)):
            if not isinstance(group, BagError):
                yield from group.tables()
            elif self._failing.may_recover(path, group):
                raise group
            else:
                _log.warning("memory_not_read", path=str(path), reason=group.reason)

    def _without_people(self, record: Record, *, rounds: bool) -> Record | None:
        """Returns a message without people whose label may not stay, maybe with rounded numbers.

        None where it cannot be parted from them, or where no transform of it is left.
        """
        try:
            whole, channel = self.reader.decode(record), record.channel
            message = _without_hidden(whole, self._is_hidden)
            if message is not whole and getattr(message, "transforms", None) == []:
                return None
            if self._names_people(message, channel.type):
                return None
            if rounds:
                message = rounded(message, self.reader.definition(channel))
            if message is whole:
                return record
            return record._replace(payload=self.reader.encode(channel, message))
        except UndecodableError:
            return None

    def _names_people(self, message: object, type_name: str) -> bool:
        extracted = self.extractor.exact(message, type_name)
        texts = [value for _, value in fields_in(message) if isinstance(value, str)]
        labels = [
            detection.label for value in (extracted, *texts) for detection in detections_of(value)
        ]
        said = chain(zip(repeat(LABELS[0]), labels), _labels(message), *map(_labels_in_json, texts))
        return any(starmap(self._is_hidden, said))

    def _is_hidden(self, field: str, text: str) -> bool:
        """Returns whether a text in such a field is of people.

        As the label of a detection a number may be: 0 is a person in COCO. Joints and frames have
        numbers, too, and those are none.
        """
        if text in self._limits.labels:
            return False
        is_number = field in _OF_DETECTIONS and text.strip().isdecimal()
        return is_number or self._is_of_people(text)

    def _is_of_people(self, name: str) -> bool:
        """Returns whether a label, a frame or a topic has a word for people in it: `person_1`."""
        # Whole, too: in `MÄDCHEN` and `McDonald` no word begins at a capital.
        words = f"{_words_in(' '.join(_WORD.findall(name)))}{_words_in(name)}"
        return not _PEOPLE.isdisjoint(words.split()) or any(one in words for one in self._people)

    def _write_day(self, day: str, records: Sequence[Record], bags: Sequence[BagFile]) -> None:
        """Writes a day anew, with more messages, which are those of some bags that stay.

        Raises:
            BagError: it cannot be written.
            OSError: likewise.
        """
        if self._folder.is_symlink():
            raise BagError(str(self._folder), "a symbolic link, which is not followed: remove it")
        self._folder.mkdir(exist_ok=True)
        path = self._writable_file(day)
        self.own.hold(self._folder, [path.name])
        self._replace_day(path, self._merged_by_hour(path, records), bags)

    def _replace_day(self, path: Path, records: Iterator[Record], bags: Sequence[BagFile]) -> None:
        """Writes a new file that takes the name of a day, and lists the bags that it has now, too.

        From that moment on those bags, and those listed for it before, count no longer.
        """
        bag_dir, name = self._folder.parent, f"{MEMORY_FOLDER}/{path.name}"
        with beside(path) as new:
            self.writer.write(new, records, dense=True)
            status, before = new.stat(), Superseded()
            with suppress(ValueError):  # a damaged list is replaced
                before = SUPERSEDED.read(bag_dir) or before
            # Those that could not be deleted yet.
            left = {bag: day for bag, day in before.bags.items() if (bag_dir / bag).exists()}
            listed = left | {str(bag.path.relative_to(bag_dir)): name for bag in bags}
            days = {other: before.days[other] for other in {*left.values()} - {name}}
            days[name] = status.st_size, status.st_mtime_ns
            SUPERSEDED.write(bag_dir, Superseded(days, listed))
            new.replace(path)
        flush(self._folder)
        flush(bag_dir)

    def _writable_file(self, day: str) -> Path:
        """Returns the file of a day that can be written anew: no damaged one, nor one of others."""
        number = 0
        while True:
            path = self._folder / memory_file(day, number)
            if not path.exists():
                return path
            with suppress(BagError):
                if self._is_whole(path) and self.own.owns_bag(path):
                    return path
            number += 1

    def _is_whole(self, path: Path) -> bool:
        summary = self.reader.summarize(path)
        return summary.complete and not summary.notes

    def _merged_by_hour(self, path: Path, added: Sequence[Record]) -> Iterator[Record]:
        """Yields the messages of a day and others, hour by hour and topic by topic, copies once.

        So what is alike lies together, and compresses.
        """
        topics = [channel.topic for channel in self.reader.channels(path)] if path.exists() else []
        hours: defaultdict[int, list[Record]] = defaultdict(list)
        for record in added:
            hours[record.log_time // HOUR_NS].append(record)
        if topics:
            # Not all from the first to the last: where the clock was set, years lie between.
            batches = self.reader.batches(path, topics, _EVERYTHING, bare=topics)
            for hour in {at // HOUR_NS for batch in batches for at in batch.log_times.tolist()}:
                hours.setdefault(hour, [])
        for hour in sorted(hours):
            window = TimeWindow(hour * HOUR_NS, (hour + 1) * HOUR_NS)
            before = [*self.reader.records(path, topics, window)] if topics else []
            identities: set[tuple[str, Ns, Ns, bytes]] = set()
            by_topic = attrgetter("channel.topic", "log_time")
            for record in sorted([*before, *hours[hour]], key=by_topic):
                channel, logged, published, payload = record
                identity = (channel.topic, logged, published, payload)
                if identity not in identities:
                    identities.add(identity)
                    yield record


@dataclass(slots=True)
class _Staying:
    """Which messages of some bags stay.

    Attributes:
        times: their log times (ns), by topic and type.
        latched: the topics of which all do.
        left_out: of which topics none does, and why.
    """

    times: dict[tuple[str, str], set[Ns]] = field(default_factory=lambda: defaultdict(set))
    latched: set[str] = field(default_factory=set)
    left_out: dict[str, str] = field(default_factory=dict)


def _words_in(name: str) -> str:
    """Returns the words and numbers in a name, each between blanks: ` user 1 ` of `user_1`."""
    return f" {' '.join(_WORD_OR_NUMBER.findall(caseless(name)))} "


def _labels(node: object, field: str = "") -> Iterator[tuple[str, str]]:
    """Yields the names in an entry of a list, each with its field.

    Such as its `name`, or the `class_id` of its `results[0].hypothesis`.
    """
    if isinstance(node, str):
        yield field, node
    for name, value in fields_in(node):
        for item in value if isinstance(value, list) else [value]:
            if name in _NAMES or not isinstance(item, str):
                yield from _labels(item, name)


def _labels_in_json(text: str) -> Iterator[tuple[str, str]]:
    """Yields what a text that is JSON has for labels, also of states, each with its field."""
    fields: list[tuple[str, object]] = []
    if looks_like_json(text):
        with suppress(ValueError, RecursionError):
            json.loads(text, object_pairs_hook=fields.extend)
    for name, value in fields:
        if name in _OF_DETECTIONS:
            items = value if isinstance(value, list) else [value]
            yield from ((name, str(item)) for item in items if isinstance(item, str | int))


def _without_hidden(message: object, is_hidden: Callable[[str, str], bool]) -> object:
    """Returns a decoded message without those entries of its lists that have a hidden label.

    What lies at the same place of a list of texts belongs to it: `name`, `position`.
    """
    if not is_dataclass(message) or isinstance(message, type):
        return message
    lists = {
        name: value for name, value in fields_in(message) if isinstance(value, list | np.ndarray)
    }
    hidden = {
        name: {
            row for row, item in enumerate(items) if any(starmap(is_hidden, _labels(item, name)))
        }
        for name, items in lists.items()
    }
    changed: dict[str, object] = {}
    for name, items in lists.items():
        parallel = (
            hidden[other]
            for other, texts in lists.items()
            if len(texts) == len(items) and all(isinstance(text, str) for text in texts)
        )
        gone = hidden[name].union(*parallel)
        if gone:
            left = [row for row in range(len(items)) if row not in gone]
            changed[name] = (
                items[left] if isinstance(items, np.ndarray) else [items[row] for row in left]
            )
    return replace(message, **changed) if changed else message
