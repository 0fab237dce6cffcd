"""Two processes fill one catalogue where bags are many and a core is free."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

from ros2_memory.cli import main
from ros2_memory.cli.maintenance import second_process
from ros2_memory.cli.maintenance.second_process import FreeCores, is_second
from ros2_memory.serving.backfill import Backfill
from tests.support.bags import odom, write_mcap
from tests.support.processes import until

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from ros2_memory.core.model import BagFile

T0 = 1_700_000_000 * 10**9
S = 10**9


def test_each_process_digests_its_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(second_process, "_SHARED", 8)
    monkeypatch.setattr(FreeCores, "__call__", lambda _self, _own: 2.0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    digested: list[str] = []
    digest = Backfill.digest
    files = set()
    for number in range(16):
        at = T0 + number * 10 * S
        path = tmp_path / "bags" / "rec" / f"rec_{number}.mcap"
        write_mcap(path, [odom(at + n * S, n, 0.0) for n in range(10)])
        os.utime(path, ns=(at + 10 * S,) * 2)
        files.add(str(path))
    of_the_other = {
        os.path.relpath(file, tmp_path / "bags") for file in files if is_second(file, 1)
    }

    def noted(backfill: Backfill, bag: BagFile) -> bool:
        if not digested:
            # Bags that the other process has not reached would be digested by this one.
            until(lambda: of_the_other <= {*backfill.catalogue.paths()} or None)
        digested.append(bag.file)
        return digest(backfill, bag)

    monkeypatch.setattr(Backfill, "digest", noted)
    assert main(["index", str(tmp_path / "bags"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"bags": 16, "in_catalogue": 16, "refused": 0}
    assert sorted(digested) == sorted(each for each in files if not is_second(each, 1))
