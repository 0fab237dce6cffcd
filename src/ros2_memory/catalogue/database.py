"""The open base of the catalogue, whatever becomes of its file while it is open.

The file may be deleted, replaced, overwritten, locked or on a full disk at any moment. Nothing is
raised because of it: what cannot be asked is unknown, and the file is gone back to by itself.
"""

from __future__ import annotations

import sqlite3
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final, TypeVar

from ros2_memory.catalogue.file import (
    BUSY_S,
    VERSION,
    fault_of,
    in_memory,
    is_busy,
    is_passing,
    open_file,
    set_aside,
)
from ros2_memory.core.logging_setup import get_logger

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ros2_memory.catalogue.file import OpenDatabase

RETRY_S: Final = 10.0
"""How often a file is tried again that could not be opened."""

_PAUSE_S: Final = 0.02
_BASE_BITS: Final = 40
"""The low bits of a number are the row's in its base, the others say which base that was."""

T = TypeVar("T")

log = get_logger(__name__)


class CatalogueDatabase:
    """One base after the other, and the numbers of rows told apart by base. Safe for threads.

    Args:
        places: where the file may lie, in order of preference; memory where none can be written.
            Where that may change, a function that gives the places of the moment.
        waits_for: a directory; while it does not exist, nothing is opened or made.
        monotonic: a clock that never steps, in seconds.
    """

    def __init__(
        self,
        places: Sequence[Path] | Callable[[], Sequence[Path]],
        *,
        waits_for: Path | None = None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._places = places if callable(places) else lambda: places
        self._waits_for = waits_for
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._opened: OpenDatabase | None = None
        self._bases = 0
        self._closed = False
        self._tried_s = 0.0
        self._trouble: str | None = None
        self._failing = False
        self.failures = 0
        """How often it could not be asked: what was read meanwhile may lack something."""

    @property
    def path(self) -> Path | None:
        """Where the file lies; None in memory, and before there is one."""
        with self._lock:
            opened = self._ready()
        return None if opened is None else opened.path

    @property
    def trouble(self) -> str | None:
        """What is amiss, as the end of a sentence about it, or None. Waits for nothing."""
        return self._trouble

    @property
    def is_failing(self) -> bool:
        """Whether it failed, and has not been written since."""
        return self._failing

    @property
    def first(self) -> int:
        """What is added to a row's number in the open base: rows of no other base are like it."""
        return self._bases << _BASE_BITS

    def here(self, numbers: Sequence[int]) -> Sequence[int]:
        """The rows of these numbers in the open base; of those of an earlier base nothing."""
        first, base = self.first, self._bases
        return [number - first for number in numbers if number >> _BASE_BITS == base]

    def is_same(self, number: int, other: int) -> bool:
        """Whether two numbers are of one base."""
        return number >> _BASE_BITS == other >> _BASE_BITS

    def close(self) -> None:
        """Ends; afterwards everything is unknown."""
        with self._lock:
            self._closed = True
            if self._opened is not None:
                self._opened.base.close()
                self._opened = None

    def read(self, ask: Callable[[sqlite3.Connection], T], unknown: T) -> T:
        """What the base says; `unknown` where it cannot be asked."""
        with self._lock:
            opened = self._ready()
            if opened is None:
                self.failures += 1
                return unknown
            try:
                return ask(opened.base)
            # Rows of a damaged file hold anything.
            except (sqlite3.Error, ValueError, TypeError, LookupError, MemoryError) as error:
                self._failed(error)
                return unknown

    def write(self, write: Callable[[sqlite3.Connection], None]) -> bool:
        """Writes all or nothing; whether it was written."""
        give_up_s = self._monotonic() + BUSY_S
        while True:
            with self._lock:
                opened = self._ready()
                if opened is None:
                    return False
                try:
                    _transact(opened.base, write, probing=self._failing)
                except (sqlite3.Error, MemoryError) as error:
                    if not is_busy(error) or self._monotonic() >= give_up_s:
                        self._failed(error)
                        return False
                # A number or text that SQLite does not hold: the bags stay without an entry.
                except (ValueError, OverflowError) as error:
                    log.warning("catalogue_refused", reason=str(error))
                    return False
                else:
                    self._works()
                    return True
            # Those who only ask do not wait for who else writes.
            time.sleep(_PAUSE_S)

    def look_after(self, *, thorough: bool = False) -> None:
        """Goes on with the file where it was deleted, replaced, or could not be opened before.

        Where a better place for it has come up since, it moves there, with all that it holds.

        It may take a while, so no question should wait for it.

        Args:
            thorough: whether all of the file is read to see that it is whole.
        """
        with self._lock:
            opened = self._opened
            if opened is None or not self._may_open():
                return
            if not opened.is_in_place():
                self._lose("its file was deleted or replaced", aside=opened.is_mixed())
                return
        if self._is_due():
            self._go_on_at_a_better_place(opened)
        if opened.path is None or self._opened is not opened:
            return
        # What is kept in memory of a file hides that it was overwritten.
        fault = fault_of(opened.path, thorough=thorough)
        if fault is not None and not is_passing(fault):
            with self._lock:
                if self._opened is opened:
                    self._failed(fault)

    # What follows runs under the lock, but for `_go_on_at_a_better_place`.

    def _may_open(self) -> bool:
        return not self._closed and (self._waits_for is None or self._waits_for.is_dir())

    def _ready(self) -> OpenDatabase | None:
        """The open base; None where there is none yet, or no more."""
        if self._opened is None and self._may_open():
            self._tried_s = self._monotonic()
            places = self._places()
            found = open_file(places)
            self._opened = in_memory() if isinstance(found, str) else found
            self._trouble = None
            if isinstance(found, str) and places:
                self._trouble = f"is kept in memory: {found}"
        return self._opened

    def _is_due(self) -> bool:
        return self._monotonic() - self._tried_s >= RETRY_S

    def _go_on_at_a_better_place(self, before: OpenDatabase) -> None:
        """Opens the file at a place that is preferred to the present one, where there is one now.

        What a file held is copied there before; what memory held is found again.
        """
        self._tried_s = self._monotonic()
        places = tuple(self._places())
        # It is not moved away from where it may no longer be made.
        if before.path is not None:
            places = places[: places.index(before.path)] if before.path in places else ()
        found = open_file(places, again=True, former=before.path) if places else ""
        if isinstance(found, str):
            return
        with self._lock:
            if self._closed or self._opened is not before:
                found.base.close()
                return
            before.base.close()
            self._opened = found
            self._bases += 1
            self._trouble, self._failing = None, False
            if before.path is None:
                log.info("catalogue_in_file_again", path=str(found.path))
            else:
                log.info("catalogue_moved", path=str(found.path))

    def _works(self) -> None:
        """It could be written: nothing is amiss any more."""
        if self._failing:
            self._failing = False
            self._trouble = None
            log.info("catalogue_works_again")

    def _failed(self, error: Exception) -> None:
        """A base that is only busy or full is asked again; any other is set aside."""
        if not is_passing(error):
            self._lose(f"it is damaged: {error}", aside=True)
            return
        self.failures += 1
        trouble = f"cannot be used: {error}"
        if trouble != self._trouble:
            path = None if self._opened is None else self._opened.path
            log.warning("catalogue_failed", path=str(path), reason=str(error))
        self._trouble, self._failing = trouble, True

    def _lose(self, reason: str, *, aside: bool) -> None:
        """Gives the open base up; whoever asks next opens or makes another."""
        opened, self._opened = self._opened, None
        self.failures += 1
        self._bases += 1
        if opened is None:
            return
        with suppress(sqlite3.Error):
            opened.base.close()
        if opened.path is None or not aside:
            log.warning("catalogue_lost", path=str(opened.path), reason=reason)
            return
        try:
            set_aside(opened.path, reason)
        except OSError as error:
            log.warning("catalogue_not_set_aside", path=str(opened.path), reason=str(error))


def _transact(
    base: sqlite3.Connection, write: Callable[[sqlite3.Connection], None], *, probing: bool
) -> None:
    """Writes in one transaction; `probing`: one page at least, where `write` may have nothing to.

    A transaction without a change touches no disk, and says nothing of it.
    """
    base.execute("BEGIN IMMEDIATE")
    try:
        write(base)
        if probing:
            base.execute(f"PRAGMA user_version = {VERSION:d}")
        base.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):
            base.execute("ROLLBACK")
        raise
