"""Clients of every habit. Each returns how often it saw what, and none leaves anything open."""

import asyncio
import json
import re
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from functools import partial
from itertools import chain, count
from typing import Any, Final, TypeAlias

from mcp import Client
from mcp.client.sse import sse_client

from tests.soak.wire import BOUND_S, answer, asked, call, connected, head, posted
from tests.support import examples
from tests.support.robot_run import ANSWERED, T0_S, ask

Seen: TypeAlias = "Counter[str]"
Habit: TypeAlias = "Callable[[int], Awaitable[Seen]]"

LONG: Final = ("get_topic_in_range", {"topic": "/odom", "start": 0, "end": 2e9})
"""The longest question about these bags; its reply is long, too."""

UNREAD_AT_ONCE: Final = 4000 if examples.LONG else 100
"""Calls whose replies nobody reads, one right after another; 75 fill what the system buffers."""
BETWEEN_S: Final = 0.5
"""Between two calls after these, until the server has lost its patience."""


def transports(port: int) -> tuple[Any, str]:
    """Both, as the SDK's client takes them."""
    url = f"http://127.0.0.1:{port}"
    return sse_client(f"{url}/sse", timeout=BOUND_S), f"{url}/mcp"


async def all_tools(port: int) -> Seen:
    """Every tool, by the SDK's client, over both transports."""
    seen: Seen = Counter()
    for transport in transports(port):
        async with Client(transport) as client:
            for name, given, key in ANSWERED:
                told, is_error = await ask(client, name, given)
                assert not is_error, (name, told)
                assert key in (told[0] if isinstance(told, list) else told)
                seen["answered"] += 1
    return seen


async def many_calls_at_once(port: int) -> Seen:
    """64 calls by one client; all are answered, or refused with a reason."""
    seen: Seen = Counter()

    async def one(client: Client, number: int) -> None:
        name, given, _ = ANSWERED[number % len(ANSWERED)]
        told, is_error = await ask(client, name, given)
        assert not is_error or told["error"] in {"busy", "timeout"}, told
        seen["busy" if is_error else "answered"] += 1

    for transport in transports(port):
        async with Client(transport) as client, asyncio.timeout(BOUND_S):
            await asyncio.gather(*(one(client, number) for number in range(64)))
    return seen


def hostile_bodies() -> Iterator[tuple[bytes, str]]:
    """Requests that only a program in error or in anger sends, and what is wrong in each."""
    deep, big = "[" * 10_000 + "]" * 10_000, "x" * 1_000_000
    for value in ("NaN", "Infinity", "1e308", "1" + "0" * 400, '"1"', "true", "{}", deep):
        yield call("get_position_at", f'{{"timestamp": {value}}}'), "timestamp"
    yield call("get_position_at", '{"timestamp": 1, "timestamp": "x"}'), "timestamp"
    for value in (f'"{big}"', '"\\u0000"', '"\\ud800"', "7", deep, "null", '""'):
        yield call("get_topic_in_last", f'{{"topic": {value}, "seconds": 1}}'), "topic"
    yield call("trajectory_summary", '{"start": 9, "end": 1}'), "start"
    yield call("trajectory_summary", f'{{"start": 1, "end": 2, "{big}": 1}}'), "unknown argument"
    yield call("find_last_match", '{"topic": "/odom", "condition_type": 1, "value": 1}'), "cond"
    yield call(big, "{}"), "unknown tool"
    yield call("list_frames", json.dumps({str(n): n for n in range(20_000)})), "unknown argument"
    yield call("list_frames", "[]"), ""
    yield call("list_frames", deep), ""
    yield b"{", ""
    yield b"[" * 1_000_000, ""
    yield b'{"jsonrpc": "2.0", "id": 1, "method": "' + b"x" * 1_000_000 + b'"}', ""
    yield b'{"jsonrpc": "2.0", "id": {}, "method": "tools/list"}', ""
    yield b"\xff\xfe\x00", ""


def modern(body: bytes) -> tuple[bytes, str]:
    """The request in the protocol of 2026, which another parser of the library reads."""
    about = (
        b'"params": {"_meta": {"io.modelcontextprotocol/protocolVersion": "2026-07-28", '
        b'"io.modelcontextprotocol/clientCapabilities": {}}, '
    )
    named = re.search(rb'"name": "([^"]{0,100})"', body)
    name = named[1].decode() if named else "none"
    return body.replace(b'"params": {', about, 1), (
        f"mcp-protocol-version: 2026-07-28\r\nmcp-method: tools/call\r\nmcp-name: {name}\r\n"
    )


async def hostile(port: int) -> Seen:
    """Each is answered with what is wrong in it, shortly."""
    seen: Seen = Counter()
    bodies = [(body, "", wrong) for body, wrong in hostile_bodies()]
    bodies += [(*modern(body), wrong) for body, wrong in hostile_bodies()]
    for body, more, wrong in bodies:
        status, told = await posted(port, body, more=more)
        if status == 202:  # taken for a notification, which has no answer
            seen["accepted"] += 1
            continue
        if status == 413:  # not even parsed
            assert told.startswith(b"The request "), (body[:80], told)
            seen["too much"] += 1
            continue
        assert told, (body[:80], status)
        reply = json.loads(told)
        if "result" in reply:
            assert len(told) < 4_000, (body[:80], len(told))
            [block] = reply["result"]["content"]
            payload = json.loads(block["text"])
            assert payload["error"] in {"invalid_arguments", "no_data"}, (body[:200], payload)
            assert wrong in payload["detail"], (body[:200], payload)
            seen[payload["error"]] += 1
        else:
            # The protocol's own errors repeat the name of a method.
            assert len(told) < len(body) + 1_000, (body[:80], len(told))
            assert reply["error"]["message"], (body[:80], reply)
            assert status >= 400 or reply["error"]["code"] < 0
            seen["refused"] += 1
    return seen


async def too_large(port: int) -> Seen:
    """Bodies past the limit, stated and not, and headers without end."""
    seen: Seen = Counter()
    async with connected(port) as (reader, writer):
        writer.write(head("POST", "/mcp", 1 << 30))
        seen[str((await answer(reader))[0])] += 1
    async with connected(port) as (reader, writer):
        writer.write(head("POST", "/mcp", None, "transfer-encoding: chunked\r\n"))
        with suppress(ConnectionError):
            for _ in range(80):
                writer.write(b"10000\r\n" + b"x" * 65536 + b"\r\n")
                await writer.drain()
        seen[str((await answer(reader))[0])] += 1
    async with connected(port) as (reader, writer):
        with suppress(ConnectionError):
            writer.write(b"GET /mcp HTTP/1.1\r\n")
            for number in range(20_000):
                writer.write(b"x-%d: %d\r\n" % (number, number))
                await writer.drain()
        status = (await answer(reader))[0]
        seen[str(status or 400)] += 1
    assert seen == {"413": 2, "400": 1}, seen
    return seen


async def never_reading(port: int) -> Seen:
    """Asks on an event stream until the server takes no more, and reads none of the answers."""
    seen: Seen = Counter()
    async with connected(port, window=1 << 14) as (stream, writer):
        writer.write(head("GET", "/sse"))
        async with asyncio.timeout(BOUND_S):
            told = await stream.readuntil(b"session_id=")
            session = (await stream.readuntil(b"\r\n")).strip().decode()
        assert b" 200 " in told
        stream._transport.pause_reading()  # type: ignore[attr-defined]
        path = f"/messages/?session_id={session}"
        async with connected(port) as (reader, posts):
            question = partial(call, LONG[0], json.dumps(LONG[1]))
            for number, body in enumerate(chain(opening(), map(question, count(1)))):
                posts.write(head("POST", path, len(body)) + body)
                status, _ = await answer(reader)
                seen[str(status)] += 1
                if status != 202:
                    break
                if number > UNREAD_AT_ONCE:
                    await asyncio.sleep(BETWEEN_S)
    # Refused for not reading, or the stream was ended already.
    assert seen.keys() - {"202"} <= {"429", "404", "0"}, seen
    return seen


def opening() -> tuple[bytes, bytes]:
    """The two messages that open a session."""
    about = {
        "protocolVersion": "2025-06-18",
        "capabilities": {},
        "clientInfo": {"name": "soak", "version": "1"},
    }
    hello = {"jsonrpc": "2.0", "id": 0, "method": "initialize", "params": about}
    return json.dumps(hello).encode(), b'{"jsonrpc": "2.0", "method": "notifications/initialized"}'


async def leaving(port: int) -> Seen:
    """Asks what takes long and leaves at once; others are answered meanwhile."""
    seen: Seen = Counter()
    body = call(LONG[0], json.dumps(LONG[1]))

    async def one() -> None:
        async with connected(port) as (_, writer):
            writer.write(head("POST", "/mcp", len(body)) + body)
            await writer.drain()
            await asyncio.sleep(0)
        seen["left"] += 1

    await asyncio.gather(*(one() for _ in range(40)))
    told = await asked(port, "get_position_at", f'{{"timestamp": {T0_S + 3}}}')
    assert told["topic"] == "/odom", told
    seen["answered"] += 1
    return seen


async def coming_and_going(port: int) -> Seen:
    """Connects and disconnects: without a word, at the beginning of a stream, within a request."""
    seen: Seen = Counter()
    half = call(*LONG[:1], "{}")[:30]
    for sent in (
        b"",
        b"GET /sse HT",
        head("GET", "/sse"),
        head("GET", "/mcp"),
        head("POST", "/mcp", 500) + half,
        head("GET", "/health"),
    ):

        async def one(sent: bytes = sent) -> None:
            async with connected(port) as (_, writer):
                writer.write(sent)
                await writer.drain()
            seen["connected"] += 1

        for _ in range(5):
            await asyncio.gather(*(one() for _ in range(5)))
    for _ in range(10):
        async with connected(port) as (stream, writer):
            writer.write(head("GET", "/sse"))
            async with asyncio.timeout(BOUND_S):
                await stream.readuntil(b"session_id=")
        seen["streams"] += 1
    return seen


async def slow_loris(port: int) -> Seen:
    """Requests that never end, some of them sent byte by byte: each gets an error reply."""
    seen: Seen = Counter()

    async def one(*parts: bytes, trickle: bytes = b"") -> None:
        async with connected(port) as (reader, writer):
            for part in parts:
                writer.write(part)
            told = asyncio.ensure_future(answer(reader))
            while not told.done():
                await asyncio.wait([told], timeout=0.2)
                if trickle:
                    writer.write(trickle)
            seen[str((await told)[0])] += 1

    await asyncio.gather(
        *(one(b"GET /s") for _ in range(10)),
        *(one(b"GET /sse HTTP/1.1\r\nx: ", trickle=b"y") for _ in range(10)),
        *(one() for _ in range(10)),
    )
    assert seen == {"408": 30}, seen
    return seen


async def endless_bodies(port: int) -> Seen:
    """Bodies sent byte by byte: each gets an error reply."""
    seen: Seen = Counter()

    async def one() -> None:
        async with connected(port) as (reader, writer):
            writer.write(head("POST", "/mcp", 10_000))
            told = asyncio.ensure_future(answer(reader))
            while not told.done():
                await asyncio.wait([told], timeout=0.2)
                writer.write(b"{")
            seen[str((await told)[0])] += 1

    await asyncio.gather(*(one() for _ in range(10)))
    assert seen == {"408": 10}, seen
    return seen


async def crowd(port: int) -> Seen:
    """More connections than are served: those too many get an error reply, the others an answer."""
    seen: Seen = Counter()
    here = asyncio.Event()

    async def one() -> None:
        async with connected(port) as (reader, writer):
            writer.write(head("GET", "/health"))
            status, _ = await answer(reader)
            seen[str(status)] += 1
            if sum(seen.values()) == 400:
                here.set()
            async with asyncio.timeout(BOUND_S):
                await here.wait()

    await asyncio.gather(*(one() for _ in range(400)))
    assert seen.keys() <= {"200", "503", "0"}, seen
    assert seen["200"] >= 100, seen
    return seen
