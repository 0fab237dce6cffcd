"""The digests of closed bags, in one SQLite file that outlives the process.

Everything here is derived: deleting the file changes no answer, only how long it takes. An entry
is the digest of one file under the part of the configuration that it depends on. The file is
identified by its path below the bag directory, its size and mtime, and the mtime of the sidecar
that says which of its messages count. An entry never changes; one that replaces it has another
number, and no number is used twice, not even after the catalogue's file was lost.
"""

from __future__ import annotations

import json
import os
import time
from typing import TYPE_CHECKING, Final, TypeVar

from ros2_memory.catalogue.codec import (
    decode_counts,
)
from ros2_memory.catalogue.digest_config import may_be_one
from ros2_memory.catalogue.packing import unpacked
from ros2_memory.catalogue.sql import (
    COUNTS,
    NO_TOPIC,
    OF_CONFIGS,
    RELATCHED,
    TABLES,
    UNDECODABLE,
    any_is_gone,
    delete_entries,
    entry_rows,
    existing_rows,
    insert_entry,
    model_of,
    packed_by_model,
    renew_entry,
    topic_rows,
)
from ros2_memory.columns.database import Database
from ros2_memory.columns.store import BagKey
from ros2_memory.core.bag_summary import BagSummary, SummarySchema
from ros2_memory.core.model import BagFile, BagState

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import numpy as np

    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.catalogue.digest import Digest
    from ros2_memory.catalogue.digest_config import DigestConfig
    from ros2_memory.core.timebase import Ns

FOLDER: Final = ".episodic"
FILE: Final = "catalogue.sqlite"

_BATCH: Final = 4096
"""Rows that are held at a time while known files are made of them."""

T = TypeVar("T")


class Catalogue(Database):
    """Stores digests, and finds those that one configuration can use.

    Safe for several threads and several processes.

    No error of the file is raised: if it fails, the catalogue has no bag.

    Args:
        paths: where the file may lie, in order of preference; a database in memory serves where
            none can be written. Where the candidates may change, a function that returns those
            of the moment.
        config: what digests depend on besides the bag.
        sources: other files that may be copied to a path that has none yet; only read.
        waits_for: a directory; until it exists, nothing is opened or made.
        monotonic: a clock that never steps, in seconds.
    """

    def __init__(
        self,
        paths: Sequence[Path] | Callable[[], Sequence[Path]],
        config: DigestConfig,
        *,
        sources: Sequence[Path] = (),
        waits_for: Path | None = None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(paths, TABLES, sources=sources, waits_for=waits_for, monotonic=monotonic)
        self._config = config

    def newest(self) -> int:
        """Returns the greatest number of any entry; it grows with each one that is added."""

        def ask(connection: sqlite3.Connection) -> int:
            last = connection.execute("SELECT max(id) FROM bags").fetchone()[0]
            return self.offset + int(last or 0)

        return self.read(ask, 0)

    def known_files(self, bag_dir: Path) -> dict[str, BagFile]:
        """Returns every file below the bag directory as it was read, by its whole path.

        Start and end are 0 where it has no message.

        A start reads this for a week of bags, so the files of one summary schema, which are many,
        are read together.
        """
        root = f"{bag_dir}{os.sep}"

        def ask(connection: sqlite3.Connection) -> dict[str, BagFile]:
            found: dict[str, BagFile] = {}
            configs, offset = self._usable(connection), self.offset
            for number, text in connection.execute("SELECT id, text FROM shapes").fetchall():
                schema = SummarySchema.from_json(text)
                model = model_of(connection, number, COUNTS)
                cursor = connection.execute(
                    "SELECT path, size, mtime, sidecar, counts, id FROM bags"  # noqa: S608
                    f" WHERE {OF_CONFIGS} AND shape = ?",
                    (configs, number),
                )
                while rows := cursor.fetchmany(_BATCH):
                    counts = decode_counts(
                        [unpacked(row[4], model) for row in rows], len(schema.topics)
                    )
                    starts, ends = _time_spans(counts)
                    for row, numbers, start, end in zip(rows, counts, starts, ends, strict=True):
                        path, size, mtime, sidecar, _, row_id = row
                        summary = BagSummary.decoded(schema, numbers.tobytes())
                        file = root + path
                        entry, state = offset + row_id, BagState.CLOSED
                        found[file] = BagFile(
                            file, size, mtime, state, summary, start, end, sidecar, entry
                        )
            return found

        return self.read(ask, {})

    def paths(self) -> list[str]:
        """Returns the files that have an entry, as paths below the bag directory."""

        def ask(connection: sqlite3.Connection) -> list[str]:
            rows = connection.execute(
                f"SELECT path FROM bags WHERE {OF_CONFIGS}",  # noqa: S608
                (self._usable(connection),),
            )
            return [row[0] for row in rows]

        return self.read(ask, [])

    def find(self, keys: Sequence[BagKey]) -> list[int | None]:
        """Returns the number of each file's entry; None if there is none for these bytes."""

        def ask(connection: sqlite3.Connection) -> dict[BagKey, int]:
            rows = entry_rows(connection, self._usable(connection), [key.path for key in keys])
            return {BagKey(*key): self.offset + number for number, *key in rows}

        found: dict[BagKey, int] = self.read(ask, {})
        return [found.get(key) for key in keys]

    def existing(self, numbers: Sequence[int]) -> set[int]:
        """Returns which of these entries exist; what has replaced one has another number."""

        def ask(connection: sqlite3.Connection) -> set[int]:
            offset = self.offset
            rows = existing_rows(connection, self.row_ids(numbers))
            return {offset + row[0] for row in rows}

        return self.read(ask, set())

    # Each of the next eight reads one topic of some entries. Entries that hold none of the topic,
    # and those that were deleted meanwhile, are left out.

    def words(self, topic: str, numbers: Sequence[int]) -> dict[int, str]:
        """Returns the words in texts of the topic, as a lake knows them; see `may_match`."""
        del topic, numbers
        return {}

    def topic_events(self, topic: str, numbers: Sequence[int]) -> dict[int, TopicEvents | None]:
        """Returns the events on the topic, which a lake holds: `NO_EVENTS`, or None.

        None where no message can be decoded.
        """
        del topic, numbers
        return {}

    def undecodable(self, topic: str, numbers: Sequence[int]) -> dict[int, dict[str, str]]:
        """Returns, by message type, why messages of the topic cannot be decoded; mostly nothing."""
        return self._of_topic(topic, numbers, UNDECODABLE, lambda row: dict(json.loads(row[1])))

    def relatched(self, topic: str, numbers: Sequence[int]) -> dict[int, bool]:
        """Returns, by entry, whether the topic may repeat a message of another recording."""
        return self._of_topic(topic, numbers, RELATCHED, lambda row: bool(row[1]))

    def _of_topic(
        self,
        topic: str,
        numbers: Sequence[int],
        columns: str,
        decode: Callable[[sqlite3.Row], T],
    ) -> dict[int, T]:
        """Decodes columns of one topic, by entry; skips rows whose first column is NULL."""

        def ask(connection: sqlite3.Connection) -> dict[int, T]:
            offset = self.offset
            rows = topic_rows(connection, columns, topic, self.row_ids(numbers))
            return {offset + row[0]: decode(row) for row in rows if row[1] is not None}

        return self.read(ask, {})

    def cached_answer(self, question: str, numbers: Sequence[int]) -> str | None:
        """Returns the answer that was computed from exactly these entries, if all still exist."""

        def ask(connection: sqlite3.Connection) -> str | None:
            row_ids = self.row_ids(numbers)
            if len(row_ids) < len(numbers):
                return None
            return _stored_text(connection, question, row_ids)

        return self.read(ask, None)

    def cache_answer(self, question: str, numbers: Sequence[int], answer: str) -> None:
        """Stores what was computed from these entries, until the oldest of them is deleted.

        Stores nothing where there are none: it would never be deleted.
        """

        def write(connection: sqlite3.Connection) -> None:
            row_ids = self.row_ids(numbers)
            if row_ids and len(row_ids) == len(numbers) and not any_is_gone(connection, row_ids):
                plain = answer.encode("utf-8", "surrogatepass")
                stored = packed_by_model(connection, NO_TOPIC, _kind_of(question), plain)
                connection.execute(
                    "INSERT OR REPLACE INTO remembered VALUES (?, ?, ?)",
                    (json.dumps([question, *row_ids]), min(row_ids), stored),
                )

        self.write(write)

    def text(self, name: str) -> str | None:
        """Returns the text that was stored under a name, if any."""
        return self.read(lambda connection: _stored_text(connection, name, ()), None)

    def store_text(self, name: str, text: str) -> None:
        """Stores a text that depends on no entry, until the newest of now is deleted."""

        def write(connection: sqlite3.Connection) -> None:
            stored = packed_by_model(connection, NO_TOPIC, _kind_of(name), text.encode())
            connection.execute(
                "INSERT OR REPLACE INTO remembered"
                " SELECT ?, id, ? FROM bags ORDER BY id DESC LIMIT 1",
                (json.dumps([name]), stored),
            )

        self.write(write)

    def put(self, key: BagKey, digest: Digest) -> bool:
        """Adds an entry in place of any other of that path; returns whether it was written."""
        return self.put_all([(key, digest)])

    def put_all(self, entries: Sequence[tuple[BagKey, Digest]]) -> bool:
        """Adds all of these entries or none; returns whether they were written."""

        def write(connection: sqlite3.Connection) -> None:
            self._delete_paths(connection, [key.path for key, _ in entries])
            for key, digest in entries:
                types = [topic.type for topic in digest.summary.schema.topics]
                insert_entry(connection, self._config.text(types), key, digest)

        return self.write(write)

    def with_other_sidecar(self, keys: Sequence[BagKey]) -> set[BagKey]:
        """Returns the keys from which that of an entry differs in the time of the sidecar alone."""

        def ask(connection: sqlite3.Connection) -> set[BagKey]:
            rows = entry_rows(connection, self._usable(connection), [key.path for key in keys])
            known = {path: BagKey(path, *rest) for _, path, *rest in rows}
            return {
                key
                for key in keys
                if (before := known.get(key.path)) is not None
                and before != key == before._replace(sidecar_ns=key.sidecar_ns)
            }

        return self.read(ask, set())

    def renew(self, entries: Sequence[tuple[BagKey, BagSummary]]) -> set[BagKey]:
        """Gives entries that `with_other_sidecar` returned their key; returns the keys of these.

        Only entries that have this very summary.
        """
        renewed: set[BagKey] = set()

        def write(connection: sqlite3.Connection) -> None:
            renewed.clear()
            for key, summary in entries:
                for row_id, *_ in entry_rows(connection, self._usable(connection), [key.path]):
                    if _summary_of(connection, row_id) == summary:
                        renew_entry(connection, row_id, key.sidecar_ns)
                        renewed.add(key)

        return renewed if entries and self.write(write) else set()

    def forget(self, paths: Sequence[str]) -> None:
        """Deletes the entries of these files."""
        if paths:
            self.write(lambda connection: self._delete_paths(connection, paths))

    def forget_older_configurations(self) -> None:
        """Deletes entries that this configuration cannot use, except of the one that wrote last.

        Two programs of different configuration may share the catalogue: if each deleted the
        other's entries, they would digest all bags for ever.
        """

        def write(connection: sqlite3.Connection) -> None:
            configs = dict(connection.execute("SELECT id, text FROM configs").fetchall())
            others = {number for number, text in configs.items() if not self._config.reads(text)}
            latest = connection.execute(
                f"SELECT config FROM bags WHERE {OF_CONFIGS} ORDER BY id DESC LIMIT 1",  # noqa: S608
                (json.dumps([*others]),),
            ).fetchone()
            if latest is None:
                return
            kept = configs[latest[0]]
            older = [number for number in others if not may_be_one(configs[number], kept)]
            rows = connection.execute(
                f"SELECT id FROM bags WHERE {OF_CONFIGS}",  # noqa: S608
                (json.dumps(older),),
            )
            delete_entries(connection, [row[0] for row in rows.fetchall()])

        self.write(write)

    def _usable(self, connection: sqlite3.Connection) -> str:
        """Returns the ids of the configurations whose entries are the same under this one."""
        rows = connection.execute("SELECT id, text FROM configs").fetchall()
        return json.dumps([number for number, text in rows if self._config.reads(text)])

    def _delete_paths(self, connection: sqlite3.Connection, paths: Sequence[str]) -> None:
        rows = entry_rows(connection, self._usable(connection), paths)
        delete_entries(connection, [row[0] for row in rows])


def _summary_of(connection: sqlite3.Connection, row_id: int) -> BagSummary:
    """Returns the summary of an entry."""
    number, text, counts = connection.execute(
        "SELECT shape, text, counts FROM bags JOIN shapes ON shapes.id = shape WHERE bags.id = ?",
        (row_id,),
    ).fetchone()
    schema = SummarySchema.from_json(text)
    plain = unpacked(counts, model_of(connection, number, COUNTS))
    [numbers] = decode_counts([plain], len(schema.topics))
    return BagSummary.decoded(schema, numbers.tobytes())


def _stored_text(
    connection: sqlite3.Connection, question: str, row_ids: Sequence[int]
) -> str | None:
    """Returns the answer to a question that is stored for these entries, if any."""
    key = json.dumps([question, *row_ids])
    row = connection.execute("SELECT answer FROM remembered WHERE question = ?", (key,)).fetchone()
    if row is None:
        return None
    model = model_of(connection, NO_TOPIC, _kind_of(question))
    return unpacked(row[0], model).decode("utf-8", "surrogatepass")


def _kind_of(question: str) -> str:
    """Returns the kind of a question's answers, by its first word."""
    return f"answer {question.partition(' ')[0]}"


def _time_spans(
    counts: np.ndarray[tuple[int, int, int], np.dtype[np.int64]],
) -> tuple[list[Ns], list[Ns]]:
    """Returns the log times of the first and last message of bags of one summary schema.

    0 for bags without a message.
    """
    if not counts.size:
        return [0] * len(counts), [0] * len(counts)
    return counts[:, :, 1].min(axis=1).tolist(), counts[:, :, 2].max(axis=1).tolist()
