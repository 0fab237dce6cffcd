from __future__ import annotations

import pytest
from hypothesis import given

from ros2_memory.core.model import JsonValue
from ros2_memory.messages.detections import Detection, detections_of
from tests.support.strategies import json_values


def test_detections_with_a_label_and_a_point_are_things_in_the_frame_of_the_message() -> None:
    value: JsonValue = {
        "detections": [
            {"label": "cup", "score": 0.9, "point": {"x": 1.0, "y": -2.0, "z": 0.5}},
            {"label": "table", "bbox": [0, 1, 2, 3]},
        ]
    }
    assert detections_of(value, "base_link") == (
        Detection("cup", (1.0, -2.0, 0.5), "base_link", 0.9),
        Detection("table", None, "base_link"),
    )


def test_a_detection_of_vision_msgs_is_its_best_hypothesis() -> None:
    value: JsonValue = {
        "frame_id": "map",
        "detections": [
            {
                "header": {"frame_id": "camera"},
                "results": [
                    {"hypothesis": {"class_id": "mug", "score": 0.2}},
                    {
                        "hypothesis": {"class_id": "cup", "score": 0.7},
                        "pose": {"pose": {"position": {"x": 0.0, "y": 0.0, "z": 0.0}}},
                    },
                ],
                "bbox": {"center": {"position": {"x": 1.0, "y": 2.0, "z": 3.0}}},
            }
        ],
    }
    assert detections_of(value) == (Detection("cup", (1.0, 2.0, 3.0), "camera", 0.7),)


def test_the_centre_of_a_box_in_an_image_is_no_place() -> None:
    value: JsonValue = {
        "detections": [
            {
                "results": [{"hypothesis": {"class_id": "cup", "score": 0.7}}],
                "bbox": {"center": {"position": {"x": 320.0, "y": 240.0}, "theta": 0.0}},
            }
        ]
    }
    assert detections_of(value) == (Detection("cup", score=0.7),)


def test_a_point_that_nobody_filled_in_is_no_place() -> None:
    value: JsonValue = [{"label": "cup", "point": {"x": 0.0, "y": 0.0, "z": 0.0}}]
    assert detections_of(value) == (Detection("cup"),)


def test_a_text_that_is_json_is_looked_into() -> None:
    value: JsonValue = {"value": '[{"label": "cup", "point": [1, 2, 3]}]'}
    assert detections_of(value, "odom") == (Detection("cup", (1.0, 2.0, 3.0), "odom"),)


def test_a_list_of_names_is_a_list_of_things() -> None:
    assert detections_of({"labels": ["cup", "", "fork"]}) == (Detection("cup"), Detection("fork"))


@pytest.mark.parametrize(
    ("said", "score"),
    [
        ({"score": 0.5}, 0.5),
        ({"confidence": 1}, 1),
        ({"probability": 0.25}, 0.25),
        ({"score": True, "confidence": 0.5}, 0.5),
        ({"score": "high"}, None),
        ({"score": float("nan")}, None),
        ({}, None),
    ],
    ids=str,
)
def test_a_score_is_a_number_under_one_of_its_names(
    said: dict[str, JsonValue], score: float | None
) -> None:
    assert detections_of([{"label": "cup", **said}]) == (Detection("cup", score=score),)


@pytest.mark.parametrize(
    "value",
    [
        {"layout": {"dim": [{"label": "x", "size": 3, "stride": 3}]}, "data": [1, 2, 3]},
        {"value": "I see a cup."},
        {"value": "[not json"},
        {"status": [{"level": 0, "name": "lidar", "message": "fine"}]},
        {"x": 1.0, "y": 2.0},
        True,
        None,
    ],
    ids=str,
)
def test_other_messages_tell_of_no_things(value: JsonValue) -> None:
    assert detections_of(value) == ()


def test_all_things_of_a_message_are_looked_at() -> None:
    assert len(detections_of([{"label": str(nth)} for nth in range(1000)])) == 1000


@given(json_values)
def test_no_value_is_too_odd(value: JsonValue) -> None:
    assert all(thing.label.strip() for thing in detections_of(value))
