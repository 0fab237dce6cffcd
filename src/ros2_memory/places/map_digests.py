"""The map digests of bags: those of the catalogue that are valid, and others made from the bags.

A digest depends on the static transforms that its bag's session has at the bag's end. An entry
that was made with others, as of a session whose later bags were not there yet, is not used: the
answer is then computed from the bag, and is the same with the catalogue and without.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from threading import Lock
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.bulk_decode import BulkDecoder, motion_sample
from ros2_memory.analysis.payload_templates import template_for
from ros2_memory.catalogue.map_digest import MapCollector, MapDigest, MapSettings
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.places.bag_statics import BagStatics

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ros2_memory.analysis.payload_templates import Bytes, PayloadTemplate
    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.catalogue.map_digest import Statics
    from ros2_memory.core.model import BagFile, Pose
    from ros2_memory.history.context import QuerySettings
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Segment
    from ros2_memory.storage.base import Record

_BATCH: Final = 1024
_CACHED: Final = 256
"""Digests that were made from bags, and stay in memory: those without an entry are few."""


def map_settings(limits: QuerySettings) -> MapSettings:
    """Returns the settings that map digests depend on."""
    return MapSettings(limits.pose_topic, limits.map_frame, limits.tf_topics, limits.tf_clock)


class _MadeDigests:
    """The digests that were made from bags last. Thread-safe."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._made: OrderedDict[tuple[object, ...], MapDigest] = OrderedDict()

    def get(self, key: tuple[object, ...]) -> MapDigest | None:
        """Returns one, and marks it as used."""
        with self._lock:
            found = self._made.get(key)
            if found is not None:
                self._made.move_to_end(key)
            return found

    def put(self, key: tuple[object, ...], digest: MapDigest) -> None:
        """Stores one, and drops the one that was not used for longest."""
        with self._lock:
            self._made[key] = digest
            if len(self._made) > _CACHED:
                self._made.popitem(last=False)


_MADE: Final = _MadeDigests()


class MapDigests:
    """The map digests of the bags of a view."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._settings = replace(map_settings(view.memory.limits), pose_topic=view.pose_topic)
        self.statics = BagStatics(view)

    def valid_in(self, digests: SegmentDigests, segment: Segment) -> Mapping[str, int]:
        """Returns, by file, the entries of a segment's bags whose map digest is valid.

        Valid is what was made with the static transforms that are in force in this view.
        """

        def valid() -> dict[str, int]:
            keys, numbers = digests.map_keys(), digests.numbers
            found = {
                bag.file: number
                for bag in segment.bags
                if (number := numbers.get(bag.file)) is not None
                and keys.get(number) == self.statics.of(bag).key
            }
            digests.is_outdated |= len(found) < len(numbers)
            return found

        return self.statics.remembered(digests, valid)

    def made(self, bag: BagFile) -> MapDigest:
        """Returns the digest of a bag, read from it.

        What cannot be read of the bag is left out, with a note. The digests of the bags that were
        asked for last stay in memory.
        """
        statics = self.statics.of(bag)
        stat = (bag.file, bag.size, bag.mtime_ns, bag.sidecar_ns, bag.end)
        key = (*stat, statics.key, self._settings, id(self._view.memory.reader))
        known = _MADE.get(key)
        if known is not None:
            return known
        reader = _MapReader(self._view, self._settings)
        made = reader.digest(bag, statics)
        if reader.is_complete and bag.state is not BagState.ACTIVE:
            _MADE.put(key, made)
        return made


class _MapReader:
    """Makes the map digest of a bag as the catalogue's `Digester` does."""

    def __init__(self, view: View, settings: MapSettings) -> None:
        self._view = view
        self._settings = settings
        self._collector = MapCollector(settings)
        self._decoders: dict[str, BulkDecoder[Pose | None, PayloadTemplate]] = {}
        self.is_complete = True

    def digest(self, bag: BagFile, statics: Statics) -> MapDigest:
        """Returns the digest of all messages of the bag that can be read."""
        topics = {
            each.topic
            for each in bag.summary.schema.topics
            if self._collector.has_poses(each.topic) or self._collector.has_transforms(each.topic)
        }
        waiting: dict[str, list[Record]] = {topic: [] for topic in topics}
        before = self._view.notes.added
        if topics:
            read = self._view.bags.read(bag, sorted(topics), TimeWindow.everything())
            for found in self._view.bags.track_sources(read):
                batch = waiting[found.record.channel.topic]
                batch.append(found.record)
                if len(batch) == _BATCH:
                    self._add(batch)
                    batch.clear()
        for batch in waiting.values():
            self._add(batch)
        self.is_complete = self._view.notes.added == before
        return self._collector.digest(statics)

    def _add(self, batch: Sequence[Record]) -> None:
        if not batch:
            return
        topic = batch[0].channel.topic
        to = self._collector
        if to.has_poses(topic) or to.has_transforms(topic):
            if topic not in self._decoders:
                self._decoders[topic] = BulkDecoder(self._decode, self._template, self._apply)
            samples = self._decoders[topic].decode(batch)
            for record, pose in zip(batch, samples, strict=True):
                if isinstance(pose, UndecodableError) or pose is None or not to.has_poses(topic):
                    continue
                to.add_pose(record.log_time, pose)

    def _decode(self, record: Record) -> Pose | None:
        extractor = self._view.memory.extractor
        message = self._view.memory.reader.decode(record)
        if self._collector.has_transforms(record.channel.topic):
            self._collector.add_transforms(
                extractor.transforms(message, record.log_time, static=False)
            )
        return motion_sample(extractor, message, record.channel.type).pose

    def _template(self, record: Record, _: Pose | None) -> PayloadTemplate | None:
        memory = self._view.memory
        template = template_for(memory.reader, memory.extractor, record)
        valid = memory.extractor.transforms(
            memory.reader.decode(record), record.log_time, static=False
        )
        if template is None or template.pairs != {(each.parent, each.child) for each in valid}:
            return None
        return template

    def _apply(
        self, template: PayloadTemplate, _: Pose | None, records: Sequence[Record], rows: Bytes
    ) -> Iterable[Pose | None]:
        if self._collector.has_transforms(records[0].channel.topic):
            self._collector.add_rows(template, records, rows)
        return template.poses(rows)
