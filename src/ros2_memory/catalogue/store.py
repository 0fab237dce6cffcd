"""What each closed bag was found to hold, in one SQLite file that outlives the process.

Everything here is derived: deleting the file changes no answer, only how long it takes. An entry
is of one file, told by its path below the bag directory, its size and mtime and the mtime of the
sidecar that says which of its messages count, under one way of reading (a hash of the
configuration). An entry never changes; what takes its place has another number, and numbers are
not used twice: not even where another file takes the place of this one.
"""

from __future__ import annotations

import json
import os
import time
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.topic_events import NO_EVENTS
from ros2_memory.catalogue.codec import (
    decode_poses,
    decode_topic_events,
    unpacked_standstills,
)
from ros2_memory.catalogue.database import CatalogueDatabase
from ros2_memory.catalogue.former import known_files
from ros2_memory.catalogue.sql import (
    EVIDENCE,
    drop,
    evidence_of,
    held_rows,
    kept_rows,
    keys_rows,
    numbers_of,
    put,
    tale_rows,
)
from ros2_memory.catalogue.topic_digest import EdgeDigest
from ros2_memory.storage.base import Channel, Record, Schema

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ros2_memory.analysis.odometry import PoseDigest
    from ros2_memory.analysis.standstills import StandstillDigest
    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.analysis.zone_map import ZoneMap
    from ros2_memory.catalogue.digest import Digest
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.file_state import KnownFile

FOLDER: Final = ".episodic"
FILE: Final = "catalogue.sqlite"


class BagKey(NamedTuple):
    """Which bytes an entry is of: a file below the bag directory, as it looked from outside."""

    path: str
    size: int
    mtime_ns: Ns
    sidecar_ns: Ns

    @classmethod
    def of(cls, bag: BagFile, bag_dir: Path) -> BagKey:
        """The key of a bag of the index."""
        return cls(below(bag.file, str(bag_dir)), bag.size, bag.mtime_ns, bag.sidecar_ns)


class Catalogue:
    """Keeps digests under one configuration. Safe for several threads and several processes.

    Nothing is ever raised because of the file: where it fails, nothing is known of any bag.

    Args:
        places: where the file may lie, in order of preference; memory where none can be written.
            Where that may change, a function that gives the places of the moment.
        config: what digests depend on besides the bag, as a hash.
        waits_for: a directory; until it exists, nothing is opened or made.
        monotonic: a clock that never steps, in seconds.
    """

    def __init__(
        self,
        places: Sequence[Path] | Callable[[], Sequence[Path]],
        config: str,
        *,
        waits_for: Path | None = None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config = config
        self._base = CatalogueDatabase(places, waits_for=waits_for, monotonic=monotonic)
        self._read = self._base.read
        self._write = self._base.write
        self._channels: dict[int, Channel] = {}

    @property
    def path(self) -> Path | None:
        """Where the file lies; None in memory, and before there is one."""
        return self._base.path

    @property
    def trouble(self) -> str | None:
        """Why it is not what it should be, for the operator; None where nothing is amiss."""
        return self._base.trouble

    @property
    def is_failing(self) -> bool:
        """Whether it could not be written or asked when that was last tried."""
        return self._base.is_failing

    @property
    def failures(self) -> int:
        """How often it could not be asked: what was read meanwhile may lack something."""
        return self._base.failures

    def look_after(self, *, thorough: bool = False) -> None:
        """Goes back to the file where it was lost, or is damaged; may take a while.

        Args:
            thorough: whether all of the file is read to see that it is whole.
        """
        self._base.look_after(thorough=thorough)

    def close(self) -> None:
        """Ends; afterwards nothing is known of any bag."""
        self._base.close()

    def is_same_base(self, number: int, other: int) -> bool:
        """Whether two numbers are of one file: those of another say nothing of this one."""
        return self._base.is_same(number, other)

    def is_current(self, number: int) -> bool:
        """Whether a number is of the file that is open, and of none that was open before."""
        return self._base.is_same(number, self._base.first)

    def newest(self) -> int:
        """The greatest number of any entry: it grows with each one that is added, by whomever."""

        def ask(base: sqlite3.Connection) -> int:
            last = base.execute("SELECT max(id) FROM bags").fetchone()[0]
            return self._base.first + int(last or 0)

        return self._read(ask, 0)

    def summaries(self, bag_dir: Path) -> dict[str, KnownFile]:
        """What is known of every file below the bag directory, by its whole path."""
        return self._read(partial(known_files, config=self._config, root=f"{bag_dir}{os.sep}"), {})

    def paths(self) -> list[str]:
        """The files that have an entry, below the bag directory."""

        def ask(base: sqlite3.Connection) -> list[str]:
            rows = base.execute("SELECT path FROM bags WHERE config = ?", (self._config,))
            return [row[0] for row in rows]

        return self._read(ask, [])

    def find(self, keys: Sequence[BagKey]) -> list[int | None]:
        """The number of each file's entry; None where there is none, or it is of other bytes."""

        def ask(base: sqlite3.Connection) -> dict[BagKey, int]:
            first = self._base.first
            rows = keys_rows(base, self._config, [key.path for key in keys])
            return {BagKey(*key): first + number for number, *key in rows}

        found: dict[BagKey, int] = self._read(ask, {})
        return [found.get(key) for key in keys]

    def evidence(self, topic: str, numbers: Sequence[int]) -> dict[int, ZoneMap]:
        """What the entries say of the topic; those that hold none of it are left out."""

        def ask(base: sqlite3.Connection) -> dict[int, ZoneMap]:
            first, here = self._base.first, self._base.here(numbers)
            rows = held_rows(base, EVIDENCE, topic, here)
            return {first + row[0]: evidence_of(row) for row in rows}

        return self._read(ask, {})

    def poses(self, topic: str, numbers: Sequence[int]) -> dict[int, PoseDigest]:
        """The poses of the topic in the entries; those that are not all poses are left out."""

        def ask(base: sqlite3.Connection) -> dict[int, PoseDigest]:
            first, here = self._base.first, self._base.here(numbers)
            rows = held_rows(base, "poses", topic, here)
            return {
                first + number: decode_poses(packed)
                for number, packed in rows
                if packed is not None
            }

        return self._read(ask, {})

    def standstills(self, topic: str, numbers: Sequence[int]) -> dict[int, StandstillDigest]:
        """Where the poses of the topic in the entries stand still; not where some have no pose."""

        def ask(base: sqlite3.Connection) -> dict[int, StandstillDigest]:
            first, here = self._base.first, self._base.here(numbers)
            rows = tale_rows(base, "rests", topic, here)
            return {first + number: unpacked_standstills(packed) for number, packed in rows}

        return self._read(ask, {})

    def stories(self, topic: str, numbers: Sequence[int]) -> dict[int, TopicEvents | None]:
        """What the messages of the topic in the entries say.

        `NO_EVENTS` where they say nothing; None where none can be decoded. Entries that hold
        none of it are left out, and so are those that were dropped meanwhile.
        """

        def ask(base: sqlite3.Connection) -> dict[int, TopicEvents | None]:
            first, here = self._base.first, self._base.here(numbers)
            held = held_rows(base, "NULL", topic, here)
            found: dict[int, TopicEvents | None] = {first + number: NO_EVENTS for number, _ in held}
            for number, text in tale_rows(base, "story", topic, here):
                found[first + number] = decode_topic_events(text) if text else None
            return found

        return self._read(ask, {})

    def edges(self, topic: str, numbers: Sequence[int]) -> dict[int, EdgeDigest]:
        """The frame edges of the topic in the entries; where they are not all known: left out."""

        def ask(base: sqlite3.Connection) -> dict[int, EdgeDigest]:
            columns = "(SELECT pairs FROM edges WHERE id = held.edges), first_stamp, last_stamp"
            pairs: dict[str, tuple[tuple[str, str], ...]] = {}
            found: dict[int, EdgeDigest] = {}
            here = self._base.here(numbers)
            for number, text, first, last in held_rows(base, columns, topic, here):
                if text is None:
                    continue
                if text not in pairs:
                    pairs[text] = tuple((parent, child) for parent, child in json.loads(text))
                found[self._base.first + number] = EdgeDigest(pairs[text], first, last)
            return found

        return self._read(ask, {})

    def kept(self, topic: str, numbers: Sequence[int]) -> dict[int, tuple[Record, ...]]:
        """All messages of the topic in the entries that keep them."""

        def ask(base: sqlite3.Connection) -> dict[int, tuple[Record, ...]]:
            first, here = self._base.first, self._base.here(numbers)
            held = held_rows(base, "kept", topic, here)
            found: dict[int, list[Record]] = {number: [] for number, keeps in held if keeps}
            rows = kept_rows(base, topic, [*found])
            for number, channel, log_time, publish_time, payload in rows:
                record = Record(self._channel(base, channel), log_time, publish_time, payload)
                found[number].append(record)
            return {first + number: tuple(records) for number, records in found.items()}

        return self._read(ask, {})

    def undecodable(self, topic: str, numbers: Sequence[int]) -> dict[int, dict[str, str]]:
        """By type, why messages of the topic in the entries cannot be decoded; mostly nothing."""

        def ask(base: sqlite3.Connection) -> dict[int, dict[str, str]]:
            first, here = self._base.first, self._base.here(numbers)
            rows = held_rows(base, "undecodable", topic, here)
            return {
                first + number: {} if text is None else json.loads(text) for number, text in rows
            }

        return self._read(ask, {})

    def remembered(self, question: str, numbers: Sequence[int]) -> str | None:
        """The answer that was worked out from these entries, if they all stand."""

        def ask(base: sqlite3.Connection) -> str | None:
            here = self._base.here(numbers)
            if len(here) < len(numbers):
                return None
            row = base.execute(
                "SELECT answer FROM remembered WHERE question = ?", (_named(question, here),)
            ).fetchone()
            return None if row is None else str(row[0])

        return self._read(ask, None)

    def remember(self, question: str, numbers: Sequence[int], answer: str) -> None:
        """Keeps what was worked out from these entries, until the oldest of them goes."""

        def write(base: sqlite3.Connection) -> None:
            here = self._base.here(numbers)
            if len(here) == len(numbers):
                base.execute(
                    "INSERT OR REPLACE INTO remembered VALUES (?, ?, ?)",
                    (_named(question, here), min(here), answer),
                )

        self._write(write)

    def put(self, key: BagKey, digest: Digest) -> bool:
        """Adds an entry in place of any other of that path; whether it could be written."""
        return self.put_all([(key, digest)])

    def put_all(self, entries: Sequence[tuple[BagKey, Digest]]) -> bool:
        """Adds entries, all or none of them; whether they could be written."""

        def write(base: sqlite3.Connection) -> None:
            self._forget(base, [key.path for key, _ in entries])
            for key, digest in entries:
                put(base, self._config, key, digest)

        return self._write(write)

    def forget(self, paths: Sequence[str]) -> None:
        """Drops what is known of these files."""

        def write(base: sqlite3.Connection) -> None:
            self._forget(base, paths)
            base.execute("DELETE FROM payloads WHERE id NOT IN (SELECT payload FROM kept)")

        if paths:
            self._write(write)

    def forget_older_configurations(self) -> None:
        """Drops what was found under other configurations but for the one that wrote last.

        Two programs of different configuration may share the catalogue: each dropping what the
        other has found, they would digest all bags for ever.
        """

        def write(base: sqlite3.Connection) -> None:
            latest = base.execute(
                "SELECT config FROM bags WHERE config <> ? ORDER BY id DESC LIMIT 1",
                (self._config,),
            ).fetchone()
            if latest is None:
                return
            rows = base.execute(
                "SELECT id FROM bags WHERE config NOT IN (?, ?)", (self._config, latest[0])
            )
            drop(base, [row[0] for row in rows.fetchall()])

        self._write(write)

    def _forget(self, base: sqlite3.Connection, paths: Sequence[str]) -> None:
        drop(base, numbers_of(base, self._config, paths))

    def _channel(self, base: sqlite3.Connection, number: int) -> Channel:
        """The channel of a number: one object for all records, as decoders are found by it."""
        known = self._base.first + number
        if known not in self._channels:
            topic, encoding, latched, name, kind, text = base.execute(
                "SELECT topic, encoding, latched, schema_name, schema_encoding, schema_text"
                " FROM channels WHERE id = ?",
                (number,),
            ).fetchone()
            schema = Schema(name, kind, text)
            self._channels[known] = Channel(topic, encoding, schema, bool(latched))
        return self._channels[known]


def _named(question: str, numbers: Sequence[int]) -> str:
    return json.dumps([question, *numbers])


def relative(path: Path, bag_dir: Path) -> str:
    """A file as entries name it, so that the bag directory can be moved."""
    return below(str(path), str(bag_dir))


def below(path: str, bag_dir: str) -> str:
    """As `relative`, of texts: of 60,000 at once."""
    inner = path.removeprefix(f"{bag_dir.rstrip(os.sep)}{os.sep}")
    # A name that is no UTF-8 would be no text for SQLite.
    return inner if inner.isascii() else inner.encode("utf-8", "backslashreplace").decode()
