"""Hubs with different state directories write one lake one after the other."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import pytest

from ros2_memory.core.errors import LakeError
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.lake.lease import TERM_NS, WarehouseLease
from ros2_memory.lake.warehouse import LakeLocation
from tests.support.clocks import SettableClock

NOW = 1_795_161_600 * NS_PER_S


def location(folder: Path, hub: str) -> LakeLocation:
    state_dir = folder / hub
    state_dir.mkdir(exist_ok=True)
    return LakeLocation((folder / "lake").as_uri(), state_dir)


def test_another_hub_is_refused_until_the_first_has_ended(tmp_path: Path) -> None:
    clock = SettableClock(NOW)
    one, other = (WarehouseLease(location(tmp_path, hub), clock) for hub in ("one", "other"))
    one.renew()
    with pytest.raises(LakeError, match=r"another lake\.state_dir.*one writer"):
        other.renew()
    one.close()
    other.renew()
    with pytest.raises(LakeError, match="one writer"):
        one.confirm()


def test_a_hub_that_was_killed_goes_on_at_once_and_another_after_the_term(tmp_path: Path) -> None:
    clock = SettableClock(NOW)
    WarehouseLease(location(tmp_path, "one"), clock).renew()
    again = WarehouseLease(location(tmp_path, "one"), clock)
    again.renew()
    other = WarehouseLease(location(tmp_path, "other"), clock)
    clock.at = NOW + TERM_NS - 1
    with pytest.raises(LakeError, match="one writer"):
        other.renew()
    clock.at = NOW + TERM_NS
    other.renew()
    # What the first would commit now is refused.
    with pytest.raises(LakeError, match="one writer"):
        again.confirm()


def test_one_that_ships_on_keeps_its_lease(tmp_path: Path) -> None:
    clock = SettableClock(NOW)
    other = WarehouseLease(location(tmp_path, "other"), clock)
    with closing(WarehouseLease(location(tmp_path, "one"), clock)) as lease:
        for quarter in range(12):
            clock.at = NOW + quarter * TERM_NS // 4
            lease.renew()
            with pytest.raises(LakeError, match="one writer"):
                other.renew()
    other.renew()


@pytest.mark.parametrize("text", ["", "{", "[]", json.dumps({"id": 5, "until": "soon"})])
def test_a_damaged_lease_keeps_nobody_out(tmp_path: Path, text: str) -> None:
    file = tmp_path / "lake" / "ros2_memory" / "writer.json"
    file.parent.mkdir(parents=True)
    file.write_text(text)
    WarehouseLease(location(tmp_path, "one"), SettableClock(NOW)).renew()
    assert json.loads(file.read_text())["until"] == NOW + TERM_NS
