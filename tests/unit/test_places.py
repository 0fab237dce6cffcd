"""The file of named places."""

from pathlib import Path

import pytest

from ros2_memory.bootstrap import places_of
from ros2_memory.config import load_settings
from ros2_memory.core.errors import ConfigError
from ros2_memory.core.regions import Circle, Place, Polygon, Rectangle


def places(folder: Path, text: str) -> tuple[Place, ...]:
    path = folder / "places.yaml"
    path.write_text(text, encoding="utf-8")
    return places_of(load_settings([f"data.places_file={path}"]))


def test_each_place_is_a_circle_a_rectangle_or_a_polygon(tmp_path: Path) -> None:
    found = places(
        tmp_path,
        "places:\n"
        "  dock: {x: 6, y: 0.6, radius_m: 0.4}\n"
        "  kitchen: {x: [0, 5], y: [5.5, 9]}\n"
        "  corner: {frame: yard, polygon: [[0, 0], [2, 0], [0, 2]]}\n",
    )
    assert found == (
        Place("dock", "map", Circle(6.0, 0.6, 0.4)),
        Place("kitchen", "map", Rectangle(0.0, 5.0, 5.5, 9.0)),
        Place("corner", "yard", Polygon(((0.0, 0.0), (2.0, 0.0), (0.0, 2.0)))),
    )


@pytest.mark.parametrize(
    "shape",
    [
        "{x: 6, y: 0.6}",
        "{x: [5, 0], y: [0, 9]}",
        "{polygon: [[0, 0], [2, 0]]}",
        "{polygon: [[0, 0], [2, 2], [5, 5], [1, 1]]}",
        "{x: 1, y: 1, radius_m: 1, polygon: [[0, 0], [2, 0], [0, 2]]}",
        "{x: [0, 1], y: [0, 1], radius_m: 1}",
        "{x: .nan, y: 0, radius_m: 1}",
        "{radius_m: 0, x: 1, y: 1}",
        "{colour: red}",
    ],
)
def test_what_is_no_shape_is_refused(tmp_path: Path, shape: str) -> None:
    with pytest.raises(ConfigError, match="places"):
        places(tmp_path, f"places: {{dock: {shape}}}\n")
