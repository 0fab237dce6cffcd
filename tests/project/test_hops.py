"""How many files and stacked calls one question goes through: what a reader has to follow.

Counted by `sys.setprofile` from the dispatcher's `answer` to the reply. The question is the first
of a server that has scanned its bags: nothing is read, decoded or cached yet.
"""

from __future__ import annotations

import json
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Final

import ros2_memory
from ros2_memory.bootstrap import build_dispatcher, build_memory
from ros2_memory.config import load_settings
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import odom, write_mcap

if TYPE_CHECKING:
    from types import FrameType

    import pytest

T0: Final = 1_700_000_000 * NS_PER_S
PACKAGE: Final = f"{Path(ros2_memory.__file__).parent}/"
MOST_FILES: Final = 50
MOST_FRAMES: Final = 20


class CallProfile:
    """Collects which files of the package are entered, and the deepest stack of its own frames."""

    def __init__(self) -> None:
        self.files: set[str] = set()
        self.deepest: list[str] = []

    def __call__(self, frame: FrameType, event: str, _arg: object) -> None:
        if event != "call" or not frame.f_code.co_filename.startswith(PACKAGE):
            return
        self.files.add(frame.f_code.co_filename.removeprefix(PACKAGE))
        stack = []
        at: FrameType | None = frame
        while at is not None:
            if at.f_code.co_filename.startswith(PACKAGE):
                file = at.f_code.co_filename.removeprefix(PACKAGE)
                stack.append(f"{file}: {at.f_code.co_qualname}")
            at = at.f_back
        if len(stack) > len(self.deepest):
            self.deepest = stack


async def test_the_first_question_about_a_position_goes_through_few_files_and_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = tmp_path / "bags"
    for split in range(3):
        times = [T0 + (split * 10 + n) * NS_PER_S for n in range(10)]
        messages = [odom(time, float(n), 0.0) for n, time in enumerate(times)]
        write_mcap(bags / "rec_0" / f"rec_0_{split}.mcap", messages)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    settings = load_settings(["data.now=latest"], {"MEMORY_BAG_DIR": str(bags)})
    memory = build_memory(settings)
    memory.index.refresh()
    dispatcher = build_dispatcher(settings, memory)
    profile = CallProfile()
    threading.setprofile(profile)
    sys.setprofile(profile)
    try:
        reply = await dispatcher.answer("get_position_seconds_ago", {"seconds_ago": 5})
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    dispatcher.stop()
    assert json.loads(reply.text)["x"] == 4.0
    assert len(profile.files) <= MOST_FILES, "\n".join(sorted(profile.files))
    assert len(profile.deepest) <= MOST_FRAMES, "\n".join(profile.deepest)
