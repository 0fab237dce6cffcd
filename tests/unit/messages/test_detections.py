import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.model import JsonValue
from ros2_memory.core.reply import JsonObject
from ros2_memory.messages.conversions import NamedNumber, label_names
from ros2_memory.messages.detections import (
    HYPOTHESES,
    MAX_DEPTH,
    Detection,
    detections_of,
    without_low_scores,
)
from tests.support.strategies import json_values

FLAT: dict[str, JsonValue] = {"x": 1.0, "y": 2.0, "z": 3.0}
AT: JsonValue = {"position": FLAT}


PLACE = (1.0, 2.0, 3.0)
CUP = Detection("cup", PLACE, "camera", 0.5)
STAMPED: JsonValue = {"header": {"frame_id": "map"}, "pose": AT}


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        # vision_msgs 2, yolo_msgs, a number alone, aruco_msgs, and a stamped pose
        ({"results": [{"id": "cup", "score": 0.5, "pose": {"pose": AT}}]}, CUP),
        (
            {
                "class_id": 41,
                "class_name": "cup",
                "score": 0.5,
                "id": "3",
                "bbox3d": {"center": AT, "frame_id": "base_link"},
            },
            CUP._replace(frame_id="base_link", id="3"),
        ),
        ({"class_id": 41, "score": 0.5, "pose": AT}, CUP._replace(label="41")),
        ({"id": 7, "confidence": 0.5, "pose": {"pose": AT}}, CUP._replace(label="7", id="7")),
        ({"label": "cup", "score": 0.5, "pose": STAMPED}, CUP._replace(frame_id="map")),
        # JSON of ultralytics, and with a flat place
        ({"name": "cup", "class": 41, "confidence": 0.5, "pose": FLAT}, CUP),
        ({"category": "cup", "confidence": 0.5, **FLAT}, CUP),
        # autoware_perception_msgs: the likeliest of several classes, and a place in the kinematics
        (
            {
                "object_id": {"uuid": [1, 2]},
                "classification": [
                    {"label": 6, "probability": 0.25},
                    {"label": 7, "probability": 0.5},
                ],
                "kinematics": {"initial_pose_with_covariance": {"pose": AT}},
            },
            CUP._replace(label="7"),
        ),
        (
            {
                "classification": [{"label": 6, "probability": 0.5}],
                "kinematics": {"pose_with_covariance": {"pose": AT}},
            },
            CUP._replace(label="6"),
        ),
        # Without a label: isaac_ros_apriltag_interfaces, aruco_opencv_msgs, darknet_ros_msgs
        (
            {"family": "tag36h11", "id": 7, "pose": {"pose": {"pose": AT}}},
            Detection("7", PLACE, "camera", id="7"),
        ),
        ({"marker_id": 7, "pose": AT}, Detection("7", PLACE, "camera")),
        (
            {"Class": "cup", "probability": 0.5, "xmin": 1, "id": 41},
            Detection("cup", None, "camera", 0.5, "41"),
        ),
    ],
)
def test_detections_are_named_and_placed_as_common_packages_do(
    value: JsonValue, expected: Detection
) -> None:
    assert detections_of({"detections": [value]}, "camera") == (expected,)
    wrapped = {"payload": {"frame_id": "camera", "detections": [value]}}
    assert detections_of({"data": json.dumps(wrapped)}) == (expected,)
    left = () if expected.score else (expected,)
    assert detections_of(without_low_scores({"detections": [value]}, 0.6), "camera") == left


@pytest.mark.parametrize(
    ("flag", "present"),
    [("out_of_stock", False), ("missing", False), ("in_stock", True), ("visible", True)],
)
def test_what_a_flag_says_is_not_there_is_not_seen(flag: str, present: bool) -> None:
    item: JsonObject = {"label": "oat milk", "position": [1, 2, 3]}
    shelf: JsonValue = [{**item, flag: present}, {**item, flag: not present}]
    for said in (shelf, json.dumps(shelf)):
        assert detections_of({"items": said}) == (Detection("oat milk", (1, 2, 3)),)


@pytest.mark.parametrize(
    "said",
    [
        pytest.param('\n  {"label": "cup"}', id="behind white space"),
        pytest.param(json.dumps({"label": "cup", "outline": [[1.5, 2.5]] * 9000}), id="100 kB"),
    ],
)
def test_json_is_looked_into_wherever_it_begins_and_however_long_it_is(said: str) -> None:
    assert detections_of({"data": said}) == (Detection("cup"),)
    assert detections_of(without_low_scores({"data": said}, 0.9)) == (Detection("cup"),)


PUMP: JsonValue = {"label": "pump", "score": 0.5}


@pytest.mark.parametrize(
    ("said", "labels"),
    [
        ({"state": "closed", "force_n": 12.5, "object": "crate blue"}, []),
        ({"class": "battery", "level": "low"}, []),
        ({"class": "battery", "level": {"is": "low"}, "cells": []}, []),
        ({"alarm": {"class": "battery", "level": "low"}}, []),
        ({"class": "none", "level": "ok"}, []),
        ({"label": "docked", "flags": [True, False]}, []),
        ({"class": "none"}, []),
        ([{"class": "none"}], []),
        ({"n": 1, "class": "EVT", "deep": {"list": [PUMP, {"label": "valve"}]}}, ["pump", "valve"]),
        ([{"class": "EVT", "items": [PUMP, {"label": "valve"}]}], ["EVT", "pump"]),
        ({"class": "EVT", "results": [{"class_id": "cup", "score": 0.5}]}, ["cup"]),
        ({"class": "cup"}, ["cup"]),
        ([{"class": "cup", "state": "full", "parts": [{"label": "handle"}]}], ["cup"]),
        ({"class": "cup", "state": "full", "score": 0.5}, ["cup"]),
        ({"class": "cup", "state": "full", "position": [1, 2, 3]}, ["cup"]),
        ({"class": "cup", "state": "full", "corners": [[1, 2], [3, 4]]}, ["cup"]),
    ],
    ids=str,
)
def test_json_that_names_something_in_a_state_detects_nothing(
    said: JsonValue, labels: list[str]
) -> None:
    value: JsonValue = {"data": json.dumps(said)}
    assert [seen.label for seen in detections_of(value)] == labels
    kept = without_low_scores(value, 0.6)
    assert [seen.label for seen in detections_of(kept)] == [
        seen.label for seen in detections_of(value) if seen.score is None
    ]


@pytest.mark.parametrize(
    ("beside", "labels"),
    [
        ({}, []),
        ({"header": {"stamp": 1.0, "frame_id": "camera"}, "threshold": 0.3}, []),
        ({"scores": [0.4]}, ["cup"]),
        ({"boxes": []}, ["cup"]),
    ],
)
def test_the_classes_that_a_detector_is_to_look_for_are_not_seen(
    beside: JsonObject, labels: list[str]
) -> None:
    """An open-vocabulary detector is prompted with them; among what it saw are scores or boxes."""
    classes: JsonObject = {"classes": ["cup"], **beside}
    values: list[JsonValue] = [classes, {"data": json.dumps(classes)}, {"detections": [classes]}]
    for value in values:
        assert [seen.label for seen in detections_of(value)] == labels


@pytest.mark.parametrize(
    ("beside", "labels"),
    [
        ({}, ["glasses"]),
        ({"header": {"stamp": 1.0, "frame_id": ""}}, ["glasses"]),
        ({"intent": "find_object", "confidence": 0.8}, []),
    ],
)
def test_the_object_of_a_command_is_not_seen(beside: JsonObject, labels: list[str]) -> None:
    """An intent has what the user named in a text of JSON, beside what is to be done."""
    value: JsonValue = {**beside, "data": json.dumps({"object": "glasses"})}
    assert [seen.label for seen in detections_of(value)] == labels
    several = {**beside, "data": json.dumps([{"object": "glasses"}])}
    assert [seen.label for seen in detections_of(several)] == ["glasses"]


def test_what_lies_too_deep_is_not_looked_into() -> None:
    value: JsonValue = [{"label": "cup"}]
    for _ in range(MAX_DEPTH - 2):
        value = {"inner": value}
    assert detections_of(value) == (Detection("cup"),)
    assert detections_of({"inner": value}) == ()
    text = json.dumps(value)
    for _ in range(MAX_DEPTH):
        text = json.dumps({"inner": text})
    for hostile in (text, "[" * 50_000, '{"a":' * 10_000, json.dumps([[[[[[text]]]]]])):
        assert detections_of({"data": hostile}) == ()
        assert without_low_scores({"data": hostile}, 0.5) == {"data": hostile}


@pytest.mark.parametrize(
    ("said", "score"),
    [
        ({"score": 0.5}, 0.5),
        ({"confidence": 1}, 1),
        ({"probability": 0.25}, 0.25),
        ({"score": True, "confidence": 0.5}, 0.5),
        ({"score": "high"}, None),
        ({"score": 10**400}, None),
        ({"score": float("nan")}, None),
        ({}, None),
    ],
    ids=str,
)
def test_a_score_is_a_number_under_one_of_its_names(
    said: dict[str, JsonValue], score: float | None
) -> None:
    assert detections_of([{"label": "cup", **said}]) == (Detection("cup", score=score),)


SCORED: JsonValue = {
    "detections": [
        {"label": "cup", "score": 0.4},
        {"label": "fork", "score": 0.5},
        {"label": "table"},
        {
            "results": [
                {"hypothesis": {"class_id": "mug", "score": 0.2}},
                {"hypothesis": {"class_id": "vase", "score": 0.6}},
            ]
        },
        {"results": [{"class_id": "bowl", "score": 0.4}]},
    ],
    "labels": ["lamp"],
    "score": 0.1,
}


def test_detections_of_a_low_score_leave_their_places_empty() -> None:
    assert without_low_scores(SCORED, 0.5) == {
        "detections": [
            None,
            {"label": "fork", "score": 0.5},
            {"label": "table"},
            {"results": [None, {"hypothesis": {"class_id": "vase", "score": 0.6}}]},
            None,
        ],
        "labels": ["lamp"],
        "score": 0.1,
    }
    assert without_low_scores(SCORED, 0.1) is SCORED
    assert without_low_scores({"class": "cup", "score": 0.4}, 0.5) is None


def test_constants_of_its_type_name_the_numbers_of_a_label() -> None:
    classes = [("CAR", 1), ("TRUCK", 2), ("LORRY", 2)]
    assert label_names(["label", "size"], classes) == {"label": {1: "CAR"}}
    own = [("SHAPE_BOX", 0), ("LABEL_CAR", 0), ("LABEL_TRUCK", 1)]
    assert label_names(["label"], own) == {"label": {0: "CAR", 1: "TRUCK"}}
    assert label_names(["mode"], own) == {}
    assert detections_of([{"label": NamedNumber.of(1, "CAR")}]) == (Detection("CAR"),)


_scores = st.none() | st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0, math.nan])
_named = st.fixed_dictionaries({"label": st.sampled_from(["cup", "fork"]), "score": _scores})
_several = st.builds(
    lambda name, parts: {name: [*parts]},
    st.sampled_from(HYPOTHESES),
    st.lists(_named, max_size=3),
)
_seen = st.recursive(
    _named | _several | json_values,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["x", "labels", "results"]), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(_seen, st.sampled_from([0.25, 0.5, 0.75]))
def test_what_is_left_are_the_detections_that_do_not_score_less(
    value: JsonValue, least: float
) -> None:
    for each in (value, json.dumps(value)):
        enough = [one for one in detections_of(each) if one.score is None or one.score >= least]
        assert [*detections_of(without_low_scores(each, least))] == enough


@given(json_values)
def test_no_value_is_too_odd(value: JsonValue) -> None:
    assert all(thing.label.strip() for thing in detections_of(value))
