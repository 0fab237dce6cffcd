"""Hubs with different state directories write one lake one after the other."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ros2_memory.core.errors import LakeError
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.lake.warehouse import TERM_NS, LakeLocation, WarehouseLease
from tests.support.clocks import SettableClock

NOW = 1_795_161_600 * NS_PER_S


def lease(folder: Path, hub: str, clock: SettableClock) -> WarehouseLease:
    state_dir = folder / hub
    state_dir.mkdir(exist_ok=True)
    return WarehouseLease(LakeLocation((folder / "lake").as_uri(), state_dir), clock)


def test_another_hub_is_refused_until_the_first_has_ended(tmp_path: Path) -> None:
    clock = SettableClock(NOW)
    one, other = (lease(tmp_path, hub, clock) for hub in ("one", "other"))
    # One that ships on keeps it.
    for quarter in range(12):
        clock.at = NOW + quarter * TERM_NS // 4
        one.renew()
        with pytest.raises(LakeError, match=r"another lake\.state_dir.*one writer"):
            other.renew()
    one.close()
    other.renew()
    with pytest.raises(LakeError, match="one writer"):
        one.confirm()


def test_a_hub_that_was_killed_goes_on_at_once_and_another_after_the_term(tmp_path: Path) -> None:
    clock = SettableClock(NOW)
    lease(tmp_path, "one", clock).renew()
    again, other = (lease(tmp_path, hub, clock) for hub in ("one", "other"))
    again.renew()
    clock.at = NOW + TERM_NS - 1
    with pytest.raises(LakeError, match="one writer"):
        other.renew()
    clock.at = NOW + TERM_NS
    other.renew()
    # What the first would commit now is refused.
    with pytest.raises(LakeError, match="one writer"):
        again.confirm()


@pytest.mark.parametrize("text", ["", "{", "[]", json.dumps({"id": 5, "until": "soon"})])
def test_a_damaged_lease_keeps_nobody_out(tmp_path: Path, text: str) -> None:
    file = tmp_path / "lake" / "ros2_memory" / "writer.json"
    file.parent.mkdir(parents=True)
    file.write_text(text)
    lease(tmp_path, "one", SettableClock(NOW)).renew()
    assert json.loads(file.read_text())["until"] == NOW + TERM_NS
