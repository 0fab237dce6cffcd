"""Two processes fill one catalogue where bags are many and a core is free."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

from ros2_memory.cli import main
from ros2_memory.cli.maintenance import index
from ros2_memory.serving.backfill import Backfill
from tests.support.bags import odom, write_mcap

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from ros2_memory.core.model import BagFile

T0 = 1_700_000_000 * 10**9
S = 10**9


def test_each_process_digests_its_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(index, "_SHARED", 8)
    monkeypatch.setattr(index, "_FREE_CORES", -1000.0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    digested: list[str] = []
    digest = Backfill.digest

    def noted(backfill: Backfill, bag: BagFile) -> bool:
        digested.append(bag.file)
        return digest(backfill, bag)

    monkeypatch.setattr(Backfill, "digest", noted)
    files = set()
    for number in range(16):
        at = T0 + number * 10 * S
        path = tmp_path / "bags" / "rec" / f"rec_{number}.mcap"
        write_mcap(path, [odom(at + n * S, n, 0.0) for n in range(10)])
        os.utime(path, ns=(at + 10 * S,) * 2)
        files.add(str(path))
    assert main(["index", str(tmp_path / "bags"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"bags": 16, "in_catalogue": 16, "refused": 0}
    # The other process has the rest, which this one would digest if that one ended too early.
    assert sorted(digested) == sorted(each for each in files if not index.is_second(each))
