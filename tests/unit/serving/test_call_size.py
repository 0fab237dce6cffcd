from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.serving.call_size import (
    MAX_DEPTH,
    MAX_VALUES,
    excess_in_json,
)
from ros2_memory.serving.dispatch import excess_in_arguments
from ros2_memory.serving.request_limits import MAX_BODY_BYTES
from tests.unit.serving.test_web_app import MCP_HEADERS, app, call_tool, client, running

if TYPE_CHECKING:
    from collections.abc import Callable

TEXTS = st.text() | st.text(alphabet='"\\[]{},', max_size=20)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | TEXTS,
    lambda inner: st.lists(inner) | st.dictionaries(TEXTS, inner),
    max_leaves=20,
)


def depth_of(value: Any) -> int:
    if isinstance(value, dict):
        return 1 + max(map(depth_of, value.values()), default=0)
    return 1 + max(map(depth_of, value), default=0) if isinstance(value, list) else 0


@given(JSON, st.booleans())
def test_what_a_call_may_hold_is_never_refused(value: Any, ascii_only: bool) -> None:
    assert excess_in_json(json.dumps(value, ensure_ascii=ascii_only).encode()) is None
    assert excess_in_arguments({"a": value}) is None


@pytest.mark.parametrize("text", ['",[{' * 9000, "\\" * 90_000, '"' * 30_000, '\\",[' * 30_000])
def test_what_stands_in_a_text_is_no_value(text: str) -> None:
    assert excess_in_json(json.dumps({"a": text}).encode()) is None


@pytest.mark.parametrize("depth", [MAX_DEPTH - 1, MAX_DEPTH, MAX_DEPTH + 1])
@pytest.mark.parametrize("wrap", [lambda inner: [inner], lambda inner: {"x": inner}])
def test_depth_is_counted_exactly(depth: int, wrap: Callable[[Any], Any]) -> None:
    value: Any = 1
    for _ in range(depth):
        value = wrap(value)
    assert depth_of(value) == depth
    assert (excess_in_json(json.dumps(value).encode()) is None) == (depth <= MAX_DEPTH)
    assert (excess_in_arguments({"a": value}) is None) == (depth < MAX_DEPTH)


@given(st.binary() | st.text(alphabet='"\\[]{},a').map(str.encode))
def test_any_bytes_are_looked_through(text: bytes) -> None:
    excess_in_json(text)


@pytest.mark.parametrize(
    "body",
    [
        b"[" * MAX_BODY_BYTES,
        b"[" + b"0," * (MAX_BODY_BYTES // 2 - 1),
        b"{" + b",".join(b'"%d":0' % n for n in range(80_000)) + b"}",
        json.dumps([0] * 20_000).encode("utf-16"),
        json.dumps([0] * 20_000).encode("utf-32-be"),
    ],
    ids=["deep", "list", "keys", "utf-16", "utf-32"],
)
@pytest.mark.parametrize("path", ["/mcp", "/messages/?session_id=" + "0" * 32])
async def test_a_message_that_holds_too_much_is_refused_before_it_is_parsed(
    body: bytes, path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    web = app()
    async with running(web), client(web) as http:
        monkeypatch.setattr(json, "loads", lambda *_, **__: pytest.fail("it was parsed"))
        reply = await http.post(path, content=body, headers=MCP_HEADERS)
    assert reply.status_code == 413
    assert reply.text.startswith("The request ")


@pytest.mark.parametrize("body", [b'"' * MAX_BODY_BYTES, b'"x"' * (MAX_BODY_BYTES // 3)])
def test_texts_are_counted_before_they_are_looked_through(body: bytes) -> None:
    assert "quotation marks" in (excess_in_json(body) or "")


@pytest.mark.parametrize("body", [b'"' + b"\\" * 99_999, b"\\" * 99_999, b"9" * 99_999])
def test_what_is_no_json_is_left_to_the_parser(body: bytes) -> None:
    assert excess_in_json(body) is None


async def test_a_call_of_usual_size_is_answered() -> None:
    web = app()
    call = call_tool("ask")
    call["params"]["arguments"] = {"fields": ["x"] * (MAX_VALUES // 2)}
    async with running(web), client(web) as http:
        assert (await http.post("/mcp", json=call, headers=MCP_HEADERS)).status_code == 200
