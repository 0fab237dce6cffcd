"""A message's value in columns: what has one, and what stays JSON."""

from ros2_memory.lake.rows import taken_apart


def test_scalars_have_columns_by_their_kind_and_their_paths() -> None:
    apart = taken_apart(
        {"header": {"frame_id": "map", "stamp": {"sec": 5}}, "on": True, "x": 0.5, "data": [1, 2]}
    )
    assert apart == {
        "value": (
            '{"header":{"frame_id":null,"stamp":{"sec":null}},"on":null,"x":null,"data":[1,2]}'
        ),
        "flags": [("on", True)],
        "integers": [("header.stamp.sec", 5)],
        "numbers": [("x", 0.5)],
        "texts": [("header.frame_id", "map")],
    }


def test_what_no_column_can_have_stays_json() -> None:
    apart = {**taken_apart({"a.b": 1, "large": 2**63, "none": None, "": {"x": 1}})}
    assert apart.pop("value") == '{"a.b":1,"large":9223372036854775808,"none":null,"":{"x":1}}'
    assert not any(apart.values())
