"""A lake whose tables a REST catalogue lists: shipped once, and asked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tests.support.lakes import location, ship_and_ask
from tests.support.rest_catalogue import rest_catalogue


def test_bags_are_shipped_once_and_asked_through_a_rest_catalogue(tmp_path: Path) -> None:
    with rest_catalogue(tmp_path / "lake") as uri:
        where = replace(location(tmp_path / "lake"), catalog="rest", uri=uri)
        ship_and_ask(where, tmp_path / "hall")
        assert where.last_commit() is not None
