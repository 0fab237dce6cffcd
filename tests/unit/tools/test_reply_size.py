import json
from itertools import pairwise
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.tools.reply_size import fit_reply, to_json_text

FLOATS = st.floats(allow_nan=True, allow_infinity=True)
SCALARS = st.none() | st.booleans() | st.integers() | FLOATS | st.text(max_size=60)
VALUES: st.SearchStrategy[Any] = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=60) | st.dictionaries(st.text(max_size=30), inner, max_size=40)
    ),
    max_leaves=30,
)
REPLIES = st.dictionaries(
    st.sampled_from(["topic", "value", "samples", "waypoints", "frames", "detail"]), VALUES
)
NOTES = st.lists(st.text(max_size=300), max_size=20)


def strict(text: str) -> Any:
    def refuse(name: str) -> Any:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=refuse)


def samples(count: int) -> dict[str, Any]:
    return {
        "topic": "/odom",
        "total": count,
        "samples": [{"timestamp": 1.5 + n, "value": {"x": n}} for n in range(count)],
    }


@given(VALUES)
def test_any_value_becomes_valid_json_without_spaces(value: Any) -> None:
    text = to_json_text(value)
    strict(text)
    assert text.encode("utf-8").decode("utf-8") == text
    assert text == json.dumps(strict(text), separators=(",", ":"), ensure_ascii=False)


@given(REPLIES, NOTES, st.integers(500, 5000))
def test_a_reply_never_passes_the_cap_and_is_always_valid(
    reply: dict[str, Any], notes: list[Any], cap: int
) -> None:
    text = fit_reply({**reply, "notes": notes}, cap)
    assert len(text) <= cap
    assert isinstance(strict(text), dict)


@given(st.integers(2, 3000), st.integers(1000, 30_000))
def test_a_thinned_range_keeps_its_ends_is_evenly_spaced_and_uses_the_room(
    count: int, cap: int
) -> None:
    shown = strict(fit_reply(samples(count), cap))
    kept = [row["timestamp"] for row in shown["samples"]]
    assert (kept[0], kept[-1]) == (1.5, 0.5 + count)
    gaps = {after - before for before, after in pairwise(kept)}
    assert min(gaps) > 0
    if count >= 40 and cap >= 1500:
        assert max(gaps) - min(gaps) <= 1
        assert len(kept) == count or len(to_json_text(shown)) > cap - 800


@given(st.integers(2, 300), st.integers(1, 60), st.integers(600, 6000))
def test_a_thinned_table_keeps_its_ends_and_every_cell_of_its_columns(
    count: int, columns: int, cap: int
) -> None:
    names: list[Any] = ["timestamp", *(f"field_{n}" for n in range(columns))]
    rows: list[Any] = [[1.5 + at, *(at + n for n in range(columns))] for at in range(count)]
    shown = strict(fit_reply({"fields": names, "rows": rows, "notes": []}, cap))
    if "rows" not in shown:
        return  # two rows are more than fits
    assert shown["fields"] == names
    assert shown["rows"][0] == rows[0]
    assert shown["rows"][-1] == rows[-1]
    assert all(row in rows for row in shown["rows"])


def test_what_cannot_be_shortened_leaves_what_it_is_about() -> None:
    tree: Any = 1
    for _ in range(5):
        tree = {f"branch_{n}": tree for n in range(5)}
    shown = strict(fit_reply({"topic": "/tree", "timestamp": 1.5, "value": tree}, 1000))
    assert (shown["topic"], shown["timestamp"]) == ("/tree", 1.5)
    assert "value" not in shown
    assert "does not fit into 1000 characters" in shown["notes"][0]


def test_a_long_note_does_not_drive_out_the_answer() -> None:
    shown = strict(fit_reply({"value": 1, "notes": ["n" * 3000] * 50}, 24_000))
    assert shown["value"] == 1
    assert shown["notes"][-1] == "and 38 more notes"
