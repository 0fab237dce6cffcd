"""What the gate lets in, and what it asks for."""

from __future__ import annotations

import gc
import hmac
from typing import Any

import httpx2
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.responses import PlainTextResponse
from structlog.testing import capture_logs

from ros2_memory.serving.auth import AUTHENTICATED, LOG_INTERVAL_S, TokenGate

GOOD = "kJ7-x._~+/0123456789=="


class Inside:
    """An application that notes who came in, and whether a token had been shown."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, object]] = []

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        self.seen.append((scope["type"], scope.get(AUTHENTICATED)))
        if scope["type"] == "http":
            await PlainTextResponse("inside")(scope, receive, send)


async def asked(
    inside: Inside, path: str = "/mcp", **headers: str | list[tuple[bytes, bytes]]
) -> httpx2.Response:
    transport = httpx2.ASGITransport(app=TokenGate(inside, GOOD))
    async with httpx2.AsyncClient(transport=transport, base_url="http://robot") as http:
        return await http.get(path, headers=headers.get("raw", headers))  # type: ignore[arg-type]


@pytest.mark.parametrize("scheme", ["Bearer", "bearer", "BEARER", "Bearer  "])
async def test_who_shows_the_token_comes_in(scheme: str) -> None:
    inside = Inside()
    response = await asked(inside, authorization=f"{scheme} {GOOD}")
    assert response.status_code == 200
    assert inside.seen == [("http", True)]


@pytest.mark.parametrize(
    "header",
    [
        "Bearer",
        "Bearer ",
        f"Bearer {GOOD}=",
        f"Bearer {GOOD[:-1]}",
        f"Bearer {GOOD.lower()}",
        f"Bearer {GOOD} {GOOD}",
        f"Bearer {GOOD}, Bearer {GOOD}",
        f"Basic {GOOD}",
        f"Token {GOOD}",
        f"Digest {GOOD}",
        f"Bearer\t{GOOD}",
        GOOD,
        "",
    ],
)
@pytest.mark.parametrize("path", ["/mcp", "/health"])
async def test_who_shows_another_is_told_that_it_is_wrong(path: str, header: str) -> None:
    inside = Inside()
    response = await asked(inside, path, authorization=header)
    assert response.status_code == 401
    assert response.headers["www-authenticate"] == (
        'Bearer realm="ros2-memory", error="invalid_token"'
    )
    assert GOOD not in response.text
    if path == "/mcp":
        assert response.json()["error"]["message"] == "The token is not the one of this server."
    assert inside.seen == []


@pytest.mark.parametrize(
    "path",
    [
        "/sse",
        "/mcp",
        "/mcp/",
        "/messages/",
        "/messages/?session_id=1",
        "/health/",
        "/HEALTH",
        "/health%2f..%2fmcp",
        "//health",
        "/.well-known/oauth-protected-resource",
        "/what-will-be-added-one-day",
    ],
)
async def test_nothing_but_health_is_open(path: str) -> None:
    inside = Inside()
    response = await asked(inside, path)
    assert response.status_code == 401
    assert response.headers["www-authenticate"] == 'Bearer realm="ros2-memory"'
    assert inside.seen == []


@pytest.mark.parametrize("name", ["token", "access_token", "authorization", "api_key"])
async def test_a_token_in_a_query_string_is_none(name: str) -> None:
    inside = Inside()
    response = await asked(inside, f"/sse?{name}={GOOD}")
    assert response.status_code == 401
    assert inside.seen == []


async def test_two_headers_are_none() -> None:
    inside = Inside()
    right = (b"authorization", f"Bearer {GOOD}".encode())
    response = await asked(inside, raw=[right, right])
    assert response.status_code == 401


@given(st.binary(max_size=80))
async def test_no_other_bytes_open_it(shown: bytes) -> None:
    inside = Inside()
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    async def receive() -> Any:
        raise AssertionError("the body is read before the token is right")

    for header in (shown, b"Bearer " + shown):
        scope: Any = {"type": "http", "path": "/mcp", "headers": [(b"authorization", header)]}
        await TokenGate(inside, GOOD)(scope, receive, send)
    assert [each["status"] for each in sent if "status" in each] == [401, 401]
    assert inside.seen == []


async def test_tokens_are_compared_in_constant_time(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[tuple[bytes, bytes]] = []
    real = hmac.compare_digest

    def compare(one: bytes, other: bytes) -> bool:
        compared.append((one, other))
        return real(one, other)

    monkeypatch.setattr(hmac, "compare_digest", compare)
    for shown in (GOOD, "x", "x" * 500):
        await asked(Inside(), authorization=f"Bearer {shown}")
    # As many bytes whatever was shown, so that not even the token's length can be timed.
    assert [(len(one), len(other)) for one, other in compared] == [(32, 32)] * 3


async def test_refusals_are_logged_now_and_then_with_nothing_of_what_was_sent() -> None:
    now = [0.0]
    gate = TokenGate(Inside(), GOOD, monotonic=lambda: now[0])
    transport = httpx2.ASGITransport(app=gate, client=("192.0.2.7", 4711))
    with capture_logs() as events:
        async with httpx2.AsyncClient(transport=transport, base_url="http://robot") as http:
            for _ in range(5):
                await http.get(f"/{GOOD}?token={GOOD}", headers={"authorization": "Bearer gUeSs"})
            now[0] = LOG_INTERVAL_S
            await http.get("/mcp")
            await http.get("/mcp", headers={"authorization": f"Bearer {GOOD}"})
    assert [(event["reason"], event["client"], event["refused"]) for event in events] == [
        ("another token", "192.0.2.7", 1),
        ("no token", "192.0.2.7", 5),
    ]
    assert GOOD not in repr(events)
    assert "gUeSs" not in repr(events)


def test_it_keeps_no_token() -> None:
    held = TokenGate(Inside(), GOOD)
    kept = gc.get_referents(held, *gc.get_referents(held))
    assert GOOD not in kept
    assert GOOD.encode() not in kept
    assert GOOD not in repr(vars(held))
