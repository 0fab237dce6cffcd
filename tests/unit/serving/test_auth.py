"""Who can reach the server, what its gate lets in, and the token: where it is from, what it is."""

import hmac
import os
import socket
import traceback
from pathlib import Path
from typing import Any

import httpx2
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.responses import PlainTextResponse
from structlog.testing import capture_logs

from ros2_memory.config import load_settings
from ros2_memory.core.errors import ConfigError
from ros2_memory.recorder.process.installation import without_ours
from ros2_memory.serving.auth import (
    LOG_INTERVAL_S,
    LONGEST_TOKEN,
    SHORTEST_TOKEN,
    TokenGate,
    Tokens,
    access_of,
    api_token,
    take_tokens,
)
from ros2_memory.serving.listen import CannotListenError, listen, resolve

GOOD = "kJ7-x._~+/0123456789=="


class Inside:
    """An application that notes who came in, and whether a token had been shown."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, object]] = []

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        self.seen.append((scope["type"], access_of(scope) is not None))
        if scope["type"] == "http":
            await PlainTextResponse("inside")(scope, receive, send)


async def asked(inside: Inside, path: str = "/mcp", **headers: str) -> httpx2.Response:
    transport = httpx2.ASGITransport(app=TokenGate(inside, {GOOD: None}))
    async with httpx2.AsyncClient(transport=transport, base_url="http://robot") as http:
        return await http.get(path, headers=headers)


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
async def test_another_token_is_told_to_be_wrong(path: str, header: str) -> None:
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
        # Query strings are logged: a token in one is none.
        *(f"/sse?{name}={GOOD}" for name in ("token", "access_token", "authorization", "api_key")),
    ],
)
async def test_nothing_but_health_is_open(path: str) -> None:
    inside = Inside()
    response = await asked(inside, path)
    assert response.status_code == 401
    assert response.headers["www-authenticate"] == 'Bearer realm="ros2-memory"'
    assert inside.seen == []


@pytest.mark.parametrize(
    ("path", "is_open"),
    [
        *((path, True) for path in ("/mcp", "/mcp/", "/sse", "/messages/", "/health")),
        *((path, False) for path in ("/mcp-admin", "/sse/x", "/messages/x", "/metrics")),
    ],
)
async def test_a_token_for_some_robots_opens_the_paths_of_questions_alone(
    path: str, is_open: bool
) -> None:
    inside = Inside()
    transport = httpx2.ASGITransport(app=TokenGate(inside, {GOOD: frozenset({"r1"})}))
    async with httpx2.AsyncClient(transport=transport, base_url="http://robot") as http:
        response = await http.get(path, headers={"authorization": f"Bearer {GOOD}"})
    assert response.status_code == (200 if is_open else 403)
    assert len(inside.seen) == is_open


@given(st.binary(max_size=80))
async def test_no_other_bytes_open_the_gate(shown: bytes) -> None:
    inside = Inside()
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    async def receive() -> Any:
        raise AssertionError("the body is read before the token is right")

    twice = [f"Bearer {GOOD}".encode()] * 2
    for headers in ([shown], [b"Bearer " + shown], twice):
        named = [(b"authorization", header) for header in headers]
        scope: Any = {"type": "http", "path": "/mcp", "headers": named}
        await TokenGate(inside, {GOOD: None})(scope, receive, send)
    assert [each["status"] for each in sent if "status" in each] == [401] * 3
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
    gate = TokenGate(Inside(), {GOOD: None}, monotonic=lambda: now[0])
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


UNUSABLE = {
    "short": "sEcReT7",
    "one_too_few": "s" * (SHORTEST_TOKEN - 1),
    "inner_space": "sEcReT7 sEcReT7 sEcReT7",
    "line_break": "sEcReT7sEcReT7\nX-Other: sEcReT7",
    "quote": 'sEcReT7sEcReT7"sEcReT7',
    "not_ascii": "sEcReT7sEcReT7\u00e9sEcReT7",
    "padding_alone": "=" * 20,
    "padding_inside": "sEcReT7=sEcReT7sEcReT7",
    "nothing_but_spaces": " " * 20,
    "control": "sEcReT7sEcReT7\x00sEcReT7",
    "long": "s" * (LONGEST_TOKEN + 1),
}


def refused(env: dict[str, str]) -> str:
    """The sentence that refuses an environment; whatever a traceback of it shows is looked at."""
    with pytest.raises(ConfigError) as caught:
        api_token(env)
    shown = "".join(traceback.format_exception(caught.value)) + repr(caught.value)
    assert "sEcReT7" not in shown
    assert "ssss" not in shown
    return str(caught.value)


def revealed(env: dict[str, str]) -> str | None:
    token = api_token(env)
    return token.get_secret_value() if token else None


@pytest.mark.parametrize("ending", ["", "\n", "\r\n"])
def test_a_token_comes_from_a_file_whose_last_line_may_end(tmp_path: Path, ending: str) -> None:
    file = tmp_path / "token"
    file.write_bytes((GOOD + ending).encode())
    assert revealed({"MEMORY_API_TOKEN_FILE": str(file)}) == GOOD


def test_two_sources_of_a_token_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "memory_api_token").write_text(GOOD)
    reply = refused({"MEMORY_API_TOKEN": GOOD, "CREDENTIALS_DIRECTORY": str(tmp_path)})
    assert "MEMORY_API_TOKEN and the credential memory_api_token" in reply


@pytest.mark.parametrize("text", UNUSABLE.values(), ids=UNUSABLE)
def test_a_token_that_cannot_be_used_is_refused_without_being_shown(
    tmp_path: Path, text: str
) -> None:
    reply = refused({"MEMORY_API_TOKEN": text})
    assert reply.startswith("MEMORY_API_TOKEN: the API token")
    assert "openssl rand -hex 32" in reply
    file = tmp_path / "token"
    file.write_text(text, encoding="utf-8")
    assert refused({"MEMORY_API_TOKEN_FILE": str(file)}).startswith(
        "MEMORY_API_TOKEN_FILE: the API"
    )


def test_a_token_in_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    assert "not a regular file" in refused({"MEMORY_API_TOKEN_FILE": str(pipe)})
    assert "not a regular file" in refused({"MEMORY_API_TOKEN_FILE": str(tmp_path)})
    reply = refused({"MEMORY_API_TOKEN_FILE": str(tmp_path / "none")})
    assert "No such file" in reply
    assert "none" in reply


def test_a_server_on_the_loopback_address_may_have_a_token_which_what_it_starts_has_not() -> None:
    for none in ({}, {"MEMORY_API_TOKEN": "", "MEMORY_API_TOKEN_FILE": ""}):
        assert take_tokens(none, {}, resolve("127.0.0.1", 0)) == {}
    env = {"MEMORY_API_TOKEN": GOOD, "PATH": "/bin"}
    assert take_tokens(env, {}, resolve("127.0.0.1", 0)) == {GOOD: None}
    assert env == {"PATH": "/bin"}
    assert "MEMORY_API_TOKEN" not in without_ours({"MEMORY_API_TOKEN": GOOD})


def taken(env: dict[str, str], files: dict[Path, list[str]]) -> Tokens:
    return take_tokens(env, files, resolve("10.0.0.1", 0))


def test_a_limited_token_that_is_also_for_everything_is_refused(tmp_path: Path) -> None:
    """Whoever shows it would be answered about all robots."""
    site, other = tmp_path / "site", tmp_path / "other"
    site.write_text(f"{GOOD}\n")
    other.write_text("another-0123456789")
    with pytest.raises(ConfigError, match="site: it is the API token") as refusal:
        taken({"MEMORY_API_TOKEN": GOOD}, {other: ["r2"], site: ["r1"]})
    assert GOOD not in str(refusal.value)
    limited, another = {GOOD: frozenset({"r1"})}, "another-0123456789"
    assert taken({"MEMORY_API_TOKEN": another}, {site: ["r1"]}) == {another: None, **limited}
    assert taken({}, {site: ["r1"]}) == limited


def test_a_token_in_a_file_of_the_configuration_is_refused_and_not_repeated(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("server:\n  api_token: sEcReT7sEcReT7sEcReT7\n")
    with pytest.raises(ConfigError) as caught:
        load_settings((), {"MEMORY_CONFIG_DIR": str(tmp_path)})
    assert "server.api_token" in str(caught.value)
    assert "sEcReT7" not in str(caught.value)


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.0.0.2", True),
        ("localhost", True),
        ("LOCALHOST", True),
        ("::1", True),
        ("127.1", True),
        (".".join("0000"), False),
        ("::", False),
        ("192.0.2.7", False),
        ("fe80::1", False),
        ("2001:db8::1", False),
    ],
)
def test_is_loopback_is_judged_by_the_address_of_a_host(host: str, loopback: bool) -> None:
    assert resolve(host, 9203).is_loopback is loopback


@pytest.mark.parametrize("host", ["nosuch.invalid", "a" * 300, "..", "robot lan"])
def test_a_host_without_an_address_is_told_with_what_to_do(host: str) -> None:
    with pytest.raises(CannotListenError, match="give an address of this machine with MCP_HOST"):
        resolve(host, 9203)


def test_listen_takes_the_address_that_was_judged() -> None:
    address = resolve("localhost", 0)
    with listen(address) as listening:
        assert listening.getsockname()[0] == address.ip
        assert listening.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
