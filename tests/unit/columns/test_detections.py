"""What columns say that messages detect: the same as each decoded message."""

from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings

from ros2_memory.columns.detections import DetectionColumns, Detections, detections_by
from ros2_memory.columns.table import Table
from ros2_memory.messages.detections import Detection, detections_of
from tests.support.examples import examples
from tests.support.memories import shipped_extractor
from tests.unit.columns.drawn_tables import Drawn, drawn_tables, rounded, stored

EXTRACTOR = shipped_extractor()
SETTLED = (
    "std_msgs/msg/String",
    "vision_msgs/msg/Detection2DArray",
    "vision_msgs/msg/Detection3DArray",
    "ros2_vision_interfaces/msg/VisionDetectionArray",
    "ros2_vision_interfaces/msg/StampedString",
    "own_msgs/msg/Label",
    "own_msgs/msg/PosedArray",
    "aruco_opencv_msgs/msg/ArucoDetection",
)


def detections_in(message: object, type_name: str) -> list[Detection]:
    frame = EXTRACTOR.frame(message)
    found = detections_of(EXTRACTOR.exact(message, type_name))
    return [one if one.frame_id else one._replace(frame_id=frame) for one in found]


def listed(found: Detections, step: float) -> list[tuple[int | str, ...]]:
    """Detections in an order that does not depend on where in a message they are.

    Their numbers are rounded to a multiple of `step`, if it is not 0.
    """
    columns = (
        found.rows.tolist(),
        found.labels.values(),
        found.frames.values(),
        rounded(found.scores, step).tolist(),
        rounded(found.places, step).tolist(),
    )

    def said(number: float) -> str:
        """A number as a text, so that NaN is NaN; next to zero is zero."""
        return "0" if abs(number) < 1e-12 else f"{number:.12g}"

    rows: list[tuple[int | str, ...]] = []
    for row, label, frame, score, place in zip(*columns, strict=True):
        where = [said(axis) for axis in place]
        # A point of zeros is not filled in.
        where = [] if {*where} <= {"0", "nan"} else where
        rows.append((row, label, frame if where else "", said(score), *where))
    return sorted(rows)


def compared(table: Table, messages: Sequence[object], step: float = 0.0) -> bool:
    """Checks what the columns settle, rounded to `step`; returns whether they do."""
    type_name = table.channel.type
    expected = detections_by([detections_in(each, type_name) for each in messages])
    # A point of zeros is none, so that another may be the first where it is rounded to zeros.
    if (np.abs(expected.places) < step).all(axis=1).any():
        return True
    columns = DetectionColumns(EXTRACTOR)
    found = columns.of(table)
    assert columns.may_have_any(table) or not expected.rows.size
    if found is None:
        return False
    assert listed(found.detections, step) == listed(expected, step)
    stamps = [getattr(getattr(each, "header", None), "stamp", None) for each in messages]
    if found.stamps is not None:
        read = [each.sec * 10**9 + each.nanosec for each in stamps if each is not None]
        assert found.stamps.tolist() == read
    return True


@settings(max_examples=examples(150), deadline=None)
@given(drawn_tables())
def test_columns_detect_what_drawn_messages_detect(drawn: Drawn) -> None:
    compared(drawn.table, drawn.messages)


@settings(max_examples=examples(80), deadline=None)
@given(drawn_tables(SETTLED))
def test_detections_of_common_types_need_no_reading_and_are_stored_but_for_rounding(
    drawn: Drawn,
) -> None:
    is_settled = compared(drawn.table, drawn.messages)
    # An object without a name may hold detections.
    every = [detections_in(each, drawn.type) for each in drawn.messages]
    assert is_settled or any(every)
    for step in (0.0, 1e-6):
        compared(stored(drawn.table, step), drawn.messages, step)
