"""What most answers have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from ros2_memory.core.reply import Keys


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerWithNotes:
    """The base of most answers.

    `notes` are sentences on what was downsampled, left out, clamped or could not be read.
    """

    notes: tuple[str, ...] = ()

    reply: ClassVar[Keys]
