"""Decodes many equally laid out messages at once: one of them by rosbags, the others by template.

`rosbags` needs 7.6 µs to decode an Odometry message; its position by offset takes 0.74 µs.
"""

from __future__ import annotations

import json
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, Protocol, TypeVar

from ros2_memory.analysis.payload_templates import json_template_for, template_for
from ros2_memory.core.errors import UndecodableError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from ros2_memory.analysis.payload_templates import Bytes, PayloadTemplate
    from ros2_memory.core.model import Pose
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.messages.json_template import JsonTemplate
    from ros2_memory.storage.base import BagReader, Record

FEWEST: Final = 32
"""Messages below which decoding them one by one costs no more than finding a template."""
_MIN_MATCHES: Final = 8
"""A template that matches fewer messages costs more than it saves."""
_MAX_TEMPLATES: Final = 8
_AS_JSON: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode

T = TypeVar("T")


class RowTemplate(Protocol):
    """What is common to the payloads of many messages."""

    @property
    def angles(self) -> tuple[str, ...]:
        """Fields of angles whose ranges are wanted: exact only where a message is decoded alone."""

    def matching(
        self, first: Record, records: Sequence[Record], among: Sequence[int]
    ) -> tuple[list[int], Bytes]:
        """Returns the indices of records that match as `first` does, and their payloads as rows."""


P = TypeVar("P", bound=RowTemplate)


class BulkDecoder(Generic[T, P]):
    """Decodes the messages of one topic in batches; templates found in one serve the next.

    Args:
        decode: decodes one message; may raise UndecodableError.
        template: the template of a message, given what it decoded into; None where it has none.
        apply: what messages decode into, by their template, what its first message decoded into,
            and their payloads as rows.
        fewest: how many messages must be left for a template to be looked for.
    """

    def __init__(
        self,
        decode: Callable[[Record], T],
        template: Callable[[Record, T], P | None],
        apply: Callable[[P, T, Sequence[Record], Bytes], Iterable[T]],
        *,
        fewest: int = FEWEST,
    ) -> None:
        self._decode = decode
        self._template = template
        self._apply = apply
        self._fewest = fewest
        self._known: list[tuple[P, Record, T]] = []
        self._may_learn = True

    def decode(self, records: Sequence[Record]) -> list[T | UndecodableError]:
        """Returns what each message decodes into, or why it cannot be decoded."""
        found: dict[int, T | UndecodableError] = {}
        rest = deque(range(len(records)))
        for nth, known in enumerate(self._known):
            rest = self._match(known, records, rest, found)
            if not rest and not nth:
                return [*found.values()]  # in order, as in most batches
        while rest:
            record = records[at := rest.popleft()]
            try:
                decoded = self._decode(record)
            except UndecodableError as error:
                # A new one, since the one that was raised keeps the message by its traceback.
                found[at] = UndecodableError(error.topic, error.type_name, error.reason)
                continue
            found[at] = decoded
            if not self._may_learn or len(rest) < self._fewest:
                continue
            template, before = self._template(record, decoded), len(rest)
            if template is not None and template.angles and before < FEWEST:
                template = None  # their ranges are exact where messages are decoded one by one
            if template is not None:
                rest = self._match((template, record, decoded), records, rest, found)
            # The first template that does not pay is the last one that is looked for.
            self._may_learn = before - len(rest) >= _MIN_MATCHES
            if template is not None and self._may_learn:
                self._known.append((template, record, decoded))
                self._may_learn = len(self._known) < _MAX_TEMPLATES
        return [found[at] for at in range(len(records))]

    def _match(
        self,
        known: tuple[P, Record, T],
        records: Sequence[Record],
        rest: deque[int],
        found: dict[int, T | UndecodableError],
    ) -> deque[int]:
        """Decodes those of `rest` that match a template; returns the others."""
        template, first, decoded = known
        matched, rows = template.matching(first, records, rest)
        if not matched:
            return rest
        is_whole = len(matched) == len(records)
        among = records if is_whole else [records[at] for at in matched]
        found.update(zip(matched, self._apply(template, decoded, among, rows), strict=True))
        return deque() if len(matched) == len(rest) else deque(at for at in rest if at not in found)


class JsonRow(NamedTuple):
    """A message as JSON, and its pose."""

    text: str
    pose: Pose | None


class _JsonRows(NamedTuple):
    """The template of messages, and of their JSON."""

    payload: PayloadTemplate
    json: JsonTemplate
    angles: tuple[str, ...] = ()

    def matching(
        self, first: Record, records: Sequence[Record], among: Sequence[int]
    ) -> tuple[list[int], Bytes]:
        return self.payload.matching(first, records, among)


class JsonRows:
    """Decodes messages of any topics as JSON in UTF-8, many at once.

    Args:
        reader: of the messages.
        extractor: gives their values, as replies show them, and poses.
    """

    def __init__(self, reader: BagReader, extractor: SchemaExtractor) -> None:
        self._reader = reader
        self._extractor = extractor
        self._decoders: dict[str, BulkDecoder[JsonRow, _JsonRows]] = {}

    def of(self, records: Sequence[Record]) -> list[JsonRow | UndecodableError]:
        """Returns what each message says, or why it cannot be decoded."""
        by_topic: dict[str, list[int]] = {}
        for at, record in enumerate(records):
            by_topic.setdefault(record.channel.topic, []).append(at)
        found: dict[int, JsonRow | UndecodableError] = {}
        for topic, places in by_topic.items():
            if topic not in self._decoders:
                self._decoders[topic] = BulkDecoder(self._decode, self._template, self._apply)
            rows = self._decoders[topic].decode([records[at] for at in places])
            found.update(zip(places, rows, strict=True))
        return [found[at] for at in range(len(records))]

    def _decode(self, record: Record) -> JsonRow:
        message, type_name = self._reader.decode(record), record.channel.type
        shown = self._extractor.shown(message, type_name)
        # The text for replies is ASCII with escapes; a column of UTF-8 has the letters themselves.
        text = _AS_JSON(shown.value) if "\\" in shown.text else shown.text
        return JsonRow(text, self._extractor.pose(message, type_name))

    def _template(self, record: Record, _: JsonRow) -> _JsonRows | None:
        payload = template_for(self._reader, self._extractor, record)
        if payload is None:
            return None
        found = json_template_for(self._reader, self._extractor, record, payload)
        return None if found is None else _JsonRows(payload, found)

    def _apply(
        self, template: _JsonRows, _: JsonRow, _records: Sequence[Record], rows: Bytes
    ) -> Iterable[JsonRow]:
        payload = template.payload
        texts = template.json.texts(
            len(rows), partial(payload.column, rows), partial(payload.nanoseconds, rows)
        )
        return map(JsonRow, texts, payload.poses(rows))
