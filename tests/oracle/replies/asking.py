"""Answers calls about one world: through the dispatcher, the page's routes, or the command line.

Nothing of a reply depends on the date, on where the folder lies, or on how fast the machine is:
the clock stands still, paths are replaced, and what is measured by the clock is left out.
"""

import hashlib
import json
import logging
import math
import os
import re
import shutil
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch
from xml.etree import ElementTree as ET

import anyio
import httpx2
import pyarrow as pa
import pyarrow.parquet as pq
import structlog
import yaml
from starlette.applications import Starlette

from ros2_memory import cli
from ros2_memory.bag_dir.state_files import TriggerState
from ros2_memory.bootstrap import build_backfill, build_dispatcher, build_memory, rules_of
from ros2_memory.cli.maintenance.index import fill_store
from ros2_memory.config import Settings, load_settings
from ros2_memory.core.errors import ConfigError
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.core.timebase import NS_PER_S, Deadline, WallClock
from ros2_memory.serving.page.routes import page_routes
from ros2_memory.triggers.rules import SplitSearch, chains_to_search

NOW_NS: Final = 1_900_000_000 * NS_PER_S
"""The wall clock of every call: later than all worlds but for the clocks that are wrong."""
RESOURCES: Final = frozenset({"describe_type", "list_moments", "show_moment"})
"""Tools that only resources use."""
_OF_THIS_MACHINE: Final = frozenset({"version", "whole_ms"})
"""Keys of the page that say nothing about what is recorded."""
_SVG: Final = "{http://www.w3.org/2000/svg}"
_DECIMAL: Final = re.compile(r"-?\d+(?:\.\d+)?")
_PLENTY_S: Final = 3600
_ID: Final = re.compile(r"correlation id \w+|\b[0-9a-f]{12}\b(?= in the log)")


@dataclass(frozen=True)
class Call:
    """One call.

    Attributes:
        way: how it is made: tool, page, cli, plot, parquet or rules.
        name: of the tool, the path of the page, or the command.
        given: the arguments of a tool, the query of a page, or the rules.
        words: of a command line; `{bags}` and `{out}` stand for folders.
    """

    way: str
    name: str
    given: Any = None
    words: Sequence[str] = ()

    def as_json(self) -> dict[str, Any]:
        """What `from_json` reads."""
        found: dict[str, Any] = {"way": self.way, "name": self.name}
        if self.given is not None:
            found["given"] = self.given
        if self.words:
            found["words"] = [*self.words]
        return found

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> "Call":
        """The call that `as_json` wrote."""
        return cls(found["way"], found["name"], found.get("given"), tuple(found.get("words", ())))

    @property
    def what(self) -> str:
        """What is asked, without its arguments: what a sample has one of each of."""
        return self.name if self.way == "tool" else f"{self.way} {self.name}"

    def __str__(self) -> str:
        given = "" if self.given is None else json.dumps(self.given, ensure_ascii=False)
        return f"{self.way} {self.name}({given or ' '.join(self.words)})"


@contextmanager
def still_time(cache: Path) -> Iterator[None]:
    """The wall clock stands still in UTC, no time runs out, and stores lie in a new folder."""
    own = {"XDG_CACHE_HOME": str(cache), "TZ": "UTC", "COLUMNS": "160", "MPLBACKEND": "agg"}
    others = [name for name in os.environ if name.startswith("MEMORY_")]
    with (
        patch.dict(os.environ, own),
        patch.object(WallClock, "now", lambda _: NOW_NS),
        # Parts of an answer have limits of their own, after which it would be partial.
        patch.object(Deadline, "expired", lambda _: False),
        patch.object(Deadline, "left_s", lambda _: math.inf),
    ):
        for name in others:
            del os.environ[name]
        time.tzset()
        _quiet()
        try:
            yield
        finally:
            structlog.reset_defaults()
    time.tzset()


def _quiet() -> None:
    """No log: what is logged is no reply, and commands set up the log anew."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))


class Asked:
    """A world that is asked; to be used within `still_time`.

    Args:
        folder: of the world: its bags lie in `bags`; other files may be written beside them.
        settings: besides those of every world.
        places: the named places, as places.yaml has them.
        stored: whether a store is filled first; else bags alone answer.
    """

    def __init__(
        self,
        folder: Path,
        settings: Sequence[str],
        places: Mapping[str, Any],
        *,
        stored: bool,
    ) -> None:
        self._folder, self._bags = folder, folder / "bags"
        places_file = folder / "places.yaml"
        places_file.write_text(yaml.safe_dump({"places": dict(places)}), encoding="utf-8")
        self._settings = [
            f"server.call_timeout_s={_PLENTY_S}",
            "server.max_reply_chars=60000",
            f"data.places_file='{places_file}'",
            *settings,
        ]
        loaded = self._loaded()
        self.memory = build_memory(loaded)
        if stored:
            fill_store(build_backfill(loaded, self.memory))
        self._dispatcher = build_dispatcher(loaded, self.memory)
        self._page = Starlette(routes=page_routes(self._dispatcher))

    def stop(self) -> None:
        """Ends its threads."""
        self._dispatcher.stop()

    def answer(self, call: Call) -> Any:
        """What is replied, as JSON."""
        ways = {
            "tool": self._tool,
            "page": self._look,
            "cli": self._command,
            "plot": self._plot,
            "parquet": self._parquet,
            "rules": self._rules,
        }
        return self._anywhere(ways[call.way](call))

    def _loaded(self, *more: str) -> Settings:
        looking = ["recorder=none", "storage=rosbag2", "data.now=latest"]
        bag_dir = f"recording.bag_dir='{self._bags}'"
        return load_settings([bag_dir, *looking, *self._settings, *more], env={})

    def _tool(self, call: Call) -> Any:
        async def reply() -> str:
            for_resource = call.name in RESOURCES
            answered = await self._dispatcher.answer(
                call.name, call.given, for_resource=for_resource
            )
            return answered.text

        return json.loads(anyio.run(reply))

    def _look(self, call: Call) -> Any:
        async def reply() -> httpx2.Response:
            transport = httpx2.ASGITransport(app=self._page)
            async with httpx2.AsyncClient(transport=transport, base_url="http://page") as client:
                return await client.get(call.name, params=call.given)

        answered = anyio.run(reply)
        if answered.status_code != 200:
            return {"status": answered.status_code, "text": answered.text}
        found = answered.json()
        if isinstance(found, dict):
            return {key: value for key, value in found.items() if key not in _OF_THIS_MACHINE}
        return found

    def _command(self, call: Call) -> Any:
        """The exit code, and what is printed: as JSON where it is, else in lines."""
        out, err = StringIO(), StringIO()
        places = {"bags": str(self._bags), "out": str(self._folder / "out")}
        words = [word.format(**places) if "{" in word else word for word in call.words]
        with redirect_stdout(out), redirect_stderr(err):
            code = cli.main([call.name, *words, *self._settings])
        _quiet()
        lines = out.getvalue().splitlines()
        found: dict[str, Any] = {"code": code}
        try:
            found["json"] = [json.loads(line) for line in lines]
        except ValueError:
            found["lines"] = [line.rstrip() for line in lines]
        if err.getvalue():
            found["notes"] = [line.rstrip() for line in err.getvalue().splitlines()]
        return found

    def _plot(self, call: Call) -> Any:
        """What is said, the texts of the picture, and where its lines are (in points)."""
        found = self._command(call)
        picture = self._folder / "out.svg"
        if not picture.exists():
            return found
        found["texts"], found["boxes"] = _drawn(picture.read_text(encoding="utf-8"))
        picture.unlink()
        return found

    def _parquet(self, call: Call) -> Any:
        """What is said, and how many rows each part has, with a digest of their content."""
        found = self._command(call)
        out = self._folder / "out"
        if out.is_dir():
            found["parts"] = _digests(out)
            shutil.rmtree(out)
        return found

    def _rules(self, call: Call) -> Any:
        """When rules fire in a search of all closed bags, and what could not be searched."""
        path = self._folder / "triggers.yaml"
        path.write_text(yaml.safe_dump({"rules": call.given}), encoding="utf-8")
        try:
            rules = rules_of(self._loaded(f"recording.keep_when='{path}'"), 10**12)
        except ConfigError as error:
            return {"error": str(error)}
        search = SplitSearch(self.memory.reader, self.memory.extractor, rules)
        closed: dict[str, list[BagFile]] = defaultdict(list)
        for bag in self.memory.index.refresh().bags:
            if bag.state is not BagState.ACTIVE:
                closed[str(bag.recording.relative_to(self._bags))].append(bag)
        state = TriggerState()
        chains = chains_to_search(closed, (), {}, lambda _: None, 10 * NS_PER_S)
        fired = [
            {
                "rule": firing.rule,
                "topic": firing.topic,
                "first_ns": firing.first,
                "at_ns": firing.at,
            }
            for chain in chains
            for firing in search.search(chain, state, lambda: False)[0]
        ]
        problems = {name: record.problem for name, record in state.rules.items() if record.problem}
        return {"fired": fired, "problems": problems}

    def _anywhere(self, reply: Any) -> Any:
        """A reply without the path of this folder."""
        text = json.dumps(reply, ensure_ascii=False)
        text = text.replace(str(self._folder), "/world")
        return json.loads(_ID.sub("<id>", text))


def _drawn(svg: str) -> tuple[list[str], list[list[float]]]:
    """The texts of a picture in order, and the bounds of what is drawn in each of its axes.

    Bounds are left, top, right and bottom in points; a fifth number is the length of all parts
    together, since a row of a timeline has many.
    """
    texts = [text.strip() for text in re.findall(r"<!--(.*?)-->", svg)]
    boxes = []
    for axes in ET.fromstring(svg).iter(f"{_SVG}g"):  # noqa: S314 - ours
        if not axes.get("id", "").startswith("axes_"):
            continue
        for group in axes.findall(f"{_SVG}g"):
            if not group.get("id", "").startswith(("matplotlib.axis", "legend", "text")):
                boxes += _bounds(group)
    return texts, boxes


def _bounds(group: ET.Element) -> list[list[float]]:
    corners, length = [], 0.0
    for part in group.iter():
        x, y = [], []
        if part.tag == f"{_SVG}use":
            x, y = [float(part.get("x", "0"))], [float(part.get("y", "0"))]
        elif part.tag == f"{_SVG}path" and part.get("id") is None:
            numbers = [*map(float, _DECIMAL.findall(part.get("d", "")))]
            x, y = numbers[::2], numbers[1::2]
        if x and len(x) == len(y):
            corners += [*zip(x, y, strict=True)]
            length += max(x) - min(x)
    if not corners:
        return []
    x, y = (sorted(axis) for axis in zip(*corners, strict=True))
    return [[round(number, 1) for number in (x[0], y[0], x[-1], y[-1], length)]]


def _digests(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for path in sorted(out.rglob("*.parquet")):
        # The replies were recorded before there were stamps of headers.
        table = pq.ParquetFile(path).read().drop_columns(["header_stamp"])
        for name in ("log_time", "publish_time"):  # Python's times have no nanoseconds
            number = table.schema.get_field_index(name)
            table = table.set_column(number, name, table.column(name).cast(pa.int64()))
        topics: dict[str, list[Any]] = {}
        for row in table.to_pylist():
            topics.setdefault(row["topic"], []).append(row)
        found[str(path.relative_to(out).parent)] = {
            topic: {"rows": len(own), "digest": _digest(own)} for topic, own in topics.items()
        }
    return found


def _digest(rows: Sequence[Any]) -> str:
    text = json.dumps(rows, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
