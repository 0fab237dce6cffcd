"""One writer for one lake: a lock that the system releases when its holder dies, and a lease.

A commit of pyiceberg compares and swaps, so two writers would not lose a bag, nor have it twice.
But only one knows what was forgotten, and with the SQLite catalogue of another state directory
there would be a second lake in the same files. So there is one: by a lock in the lake's state
directory, on a file system that supports locks, and for those with another state directory by a
lease in the warehouse, whose holder renews its term. A state directory that has it goes on at once,
another one when the term is over.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import uuid
from contextlib import ExitStack, closing, contextmanager, suppress
from typing import TYPE_CHECKING, Final

from pyiceberg.io import load_file_io

from ros2_memory.bag_dir.durable_write import write_durably
from ros2_memory.bag_dir.lock import read_holder, write_holder
from ros2_memory.core.errors import LakeError
from ros2_memory.core.timebase import NS_PER_S, Clock, Ns, iso_local
from ros2_memory.lake.tables import NAMESPACE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.lake.warehouse import LakeLocation

LEASE_FILE: Final = "writer.lock"
TERM_NS: Final[Ns] = 600 * NS_PER_S
"""How long the lease in the warehouse holds: longer than any commit takes."""
_RENEWED_NS: Final = TERM_NS // 4
_ID_FILE: Final = "writer.id"
_MAX_TEXT: Final = 1000


@contextmanager
def writing_alone(state_dir: Path) -> Iterator[None]:
    """Holds the lock of a lake.

    Raises:
        LakeError: another process holds it, which the sentence names; or nothing can be locked.
    """
    with _locked(state_dir, os.O_RDWR | os.O_CREAT, fcntl.LOCK_EX) as (descriptor, holder):
        if holder is not None:
            raise LakeError(
                f"{holder} writes into this lake; a lake has one writer: stop that process first"
            )
        write_holder(descriptor)
        yield


def holder_of(state_dir: Path) -> str | None:
    """Returns who holds the lock of a lake; None where nobody does. Writes nothing.

    Raises:
        LakeError: that cannot be found out.
    """
    try:
        with _locked(state_dir, os.O_RDONLY, fcntl.LOCK_SH) as (_, holder):
            return holder
    except FileNotFoundError:
        return None


@contextmanager
def _locked(state_dir: Path, flags: int, lock: int) -> Iterator[tuple[int, str | None]]:
    """Locks the file, if nobody else has; yields its descriptor, and who has.

    Raises:
        FileNotFoundError: there is none, and it is not to be made.
        LakeError: it cannot be opened or locked.
    """
    path, holder = state_dir / LEASE_FILE, None
    with ExitStack() as opened:
        try:
            if flags & os.O_CREAT:
                state_dir.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, flags | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
            opened.callback(os.close, descriptor)
            fcntl.flock(descriptor, lock | fcntl.LOCK_NB)
        except BlockingIOError:
            pid, host = read_holder(descriptor)
            holder = "another process" if pid is None else f"process {pid} on {host}"
        except FileNotFoundError:
            raise
        except OSError as error:
            raise LakeError(
                f"{path} cannot be opened or locked: {error.strerror}; lake.state_dir must be on a "
                "file system that supports locks"
            ) from error
        yield descriptor, holder


class WarehouseLease:
    """A lease in the warehouse of a lake, for those who do not share its state directory.

    A store has no locks, so two that take it at the same moment may both have it, until either
    looks at it before its next commit; of two commits at once a table takes only one.

    Args:
        location: the lake.
        clock: the wall clock, which must not differ between machines by as much as the term.
    """

    def __init__(self, location: LakeLocation, clock: Clock) -> None:
        self._location = location
        self._clock = clock
        self._file = f"{location.warehouse}/{NAMESPACE}/writer.json"
        self._store = load_file_io({**location.properties, **location.secrets}, self._file)
        self._id = _id_in(location.state_dir)
        self._until: Ns = 0

    def renew(self) -> None:
        """Takes the lease, or prolongs it where a quarter of its term is over.

        Raises:
            LakeError: another state directory has it, or the warehouse cannot be reached.
        """
        now = self._clock.now()
        if self._until - now <= TERM_NS - _RENEWED_NS:
            self._until = 0
            with self._location.translated("taking the lease of the lake"):
                self._write(now, now + TERM_NS)
                self._require_mine(now)
            self._until = now + TERM_NS

    def confirm(self) -> None:
        """Looks whether the lease is still held, and renews it: before each commit.

        Raises:
            LakeError: as `renew`.
        """
        self._until = 0
        self.renew()

    def close(self) -> None:
        """Ends the lease, if it is held; one that cannot be ended is over with its term."""
        if self._until:
            with suppress(LakeError), self._location.translated("ending the lease of the lake"):
                self._write(self._clock.now(), 0)

    def _require_mine(self, now: Ns) -> None:
        known: object = None
        file = self._store.new_input(self._file)
        if file.exists():
            with file.open() as stream, suppress(ValueError):
                known = json.loads(stream.read(_MAX_TEXT))
        if not isinstance(known, dict) or known.get("id") == self._id:
            return
        until = known.get("until")
        if isinstance(until, int) and until > now:
            raise LakeError(
                f"process {known.get('pid')} on {known.get('host')} writes into this lake, with "
                f"another lake.state_dir, until {iso_local(until)}: a lake has one writer, and one "
                "state_dir"
            )

    def _write(self, now: Ns, until: Ns) -> None:
        self._require_mine(now)
        known = {"id": self._id, "pid": os.getpid(), "host": socket.gethostname(), "until": until}
        with closing(self._store.new_output(self._file).create(overwrite=True)) as stream:
            stream.write(json.dumps(known).encode())


def _id_in(state_dir: Path) -> str:
    """Returns the id of a state directory, which is made with the first call.

    Raises:
        LakeError: it cannot be read or written.
    """
    path = state_dir / _ID_FILE
    try:
        if not path.exists():
            write_durably(path, uuid.uuid4().hex)
        return path.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise LakeError(f"{path} cannot be read or written: {error.strerror}") from error
