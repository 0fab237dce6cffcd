"""Notes of one call: values while it runs, sentences when its reply is made."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from ros2_memory.core.timebase import MAX_NS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable
    from pathlib import Path

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.text import Reason
    from ros2_memory.core.timebase import Ns

NoteKey: TypeAlias = "tuple[Reason, str]"
"""The kind of a note, and the file that it is on."""


class Note(NamedTuple):
    """What is wrong with one file (or topic, or recording); all of a kind make one sentence.

    Attributes:
        kind: the sentence.
        file: its name as replies have it.
        detail: what is special about this one; may be empty.
        until: nothing of it lies after this log time.
    """

    kind: Reason
    file: str
    detail: str = ""
    until: Ns = MAX_NS


class Notes:
    """Collects notes, each once.

    Attributes:
        complete: False once something that bears on the answer could not be read.
    """

    def __init__(self) -> None:
        self.complete = True
        self._order: dict[str | Reason, None] = {}
        self._notes: dict[NoteKey, Note] = {}
        self._remarks: dict[str, tuple[str, ...]] = {}

    def add(self, note: str | Note) -> None:
        """Adds a sentence, or a note that shares one with others of its kind."""
        if isinstance(note, str):
            self._order.setdefault(note)
            return
        self._order.setdefault(note.kind)
        known = self._notes.get((note.kind, note.file))
        if known is None or known.until < note.until:
            self._notes[note.kind, note.file] = note

    def sentences(self) -> tuple[str, ...]:
        """Returns the sentences for the reply, in the order in which each was first needed."""
        by_kind: dict[Reason, dict[str, str]] = {}
        for note in self._notes.values():
            # A sentence on the bag's summary may say the same already.
            if note.detail not in self._remarks.get(note.file, ()):
                by_kind.setdefault(note.kind, {})[note.file] = note.detail
        # In which order bags are found damaged depends on what the catalogue knows: sorted, the
        # sentences are the same with and without it.
        shared = iter(sorted(kind.sentence(files) for kind, files in by_kind.items()))
        return tuple(
            each if isinstance(each, str) else next(shared)
            for each in self._order
            if isinstance(each, str) or each in by_kind
        )

    def add_remarks(self, bags: Iterable[BagFile]) -> None:
        """Records that sentences already have what the summaries of these bags remark."""
        self._remarks |= {short_name(bag.path): bag.summary.remarks for bag in bags}

    def has_remarks(self, bag: BagFile) -> bool:
        """Whether notes on what was read of a bag have all that its summary remarks."""
        name = short_name(bag.path)
        if name in self._remarks:
            return False
        details = {note.detail for note in self._notes.values() if note.file == name}
        return details.issuperset(bag.summary.remarks)

    def keys(self) -> frozenset[NoteKey]:
        """Returns which notes there are, for `retract_before`."""
        return frozenset(self._notes)

    def retract_before(self, moment: Ns, keep: Collection[NoteKey] = frozenset()) -> None:
        """Removes the notes on what lies before a moment, except those to `keep`.

        For a question that did not need it: how far back is read besides what is asked for depends
        on what the catalogue knows, and the reply must not.
        """
        self._notes = {
            key: note for key, note in self._notes.items() if note.until >= moment or key in keep
        }


def short_name(path: Path) -> str:
    """Returns a bag's name for a reply: recording and file, never a path of this machine."""
    return f"{path.parent.name}/{path.name}"
