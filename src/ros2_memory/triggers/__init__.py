"""Rules that keep what was recorded around an event: `recording.keep_when`."""

from typing import Literal, TypeAlias

RuleKind: TypeAlias = Literal["message", "silent", "recorder_restart"]
