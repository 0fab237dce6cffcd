"""What is asked of a world, drawn by its name from what its topics are.

The program itself is asked what there is to ask about. What was drawn is kept with the replies, so
that a comparison asks the same even where the program now says something else.
"""

from __future__ import annotations

import json
from random import Random
from typing import TYPE_CHECKING, Any, Final

from tests.oracle.replies.asking import Asked, Call

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence


ROUND: Final = 6
_POSES: Final = ("Odometry", "PoseStamped", "PoseWithCovarianceStamped", "NavSatFix", "Pose")
_SEEN: Final = ("VisionDetectionArray", "Detection3DArray", "Detection2DArray")
_BYS: Final = ("day", "hour", "weekday", "place")


class Topic:
    """A topic with some of its messages.

    Attributes:
        name: of the topic.
        type: of its messages.
        times: of some messages, Unix s, ascending.
        scalars: the values that some fields had, by dot-path.
    """

    def __init__(self, row: Mapping[str, Any], samples: Sequence[Mapping[str, Any]]) -> None:
        self.name: str = row["topic"]
        self.type: str = row["type"]
        self.times = [sample["timestamp"] for sample in samples] or [row["first_ts"]]
        self.scalars: dict[str, list[Any]] = {}
        for sample in samples:
            for path, value in _scalars(sample.get("value"), ""):
                self.scalars.setdefault(path, []).append(value)

    @property
    def has_poses(self) -> bool:
        """Whether it may carry the robot's pose."""
        return self.type.rpartition("/")[2] in _POSES

    @property
    def numbers(self) -> list[str]:
        """The paths of numbers."""
        return [path for path, values in self.scalars.items() if _is_number(values[0])]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _scalars(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _scalars(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        for inner in value[:4]:
            if isinstance(inner, dict):
                yield from _scalars(inner, path)
    elif value is not None:
        yield path, value


class Facts:
    """What a world has to ask about.

    Args:
        asked: the world.
        draw: for places.
    """

    def __init__(self, asked: Asked, draw: Random) -> None:
        rows = asked.tool("list_recorded_topics")
        rows = [row for row in rows if "topic" in row] if isinstance(rows, list) else []
        self.span = asked.tool("data_time_range")
        self.earliest: float = self.span.get("earliest") or 1_784_000_000.0
        self.latest: float = self.span.get("latest") or self.earliest + 60.0
        self.topics = [self._topic(asked, row) for row in rows if row.get("first_ts") is not None]
        frames = asked.tool("list_frames")
        self.frames: list[str] = frames.get("frames", []) if isinstance(frames, dict) else []
        self.track = self._track(asked)
        found = asked.tool("find_things", limit=30)
        self.labels = [thing["label"] for thing in found.get("things", [])]
        self.places = _places(self.track, draw)

    @staticmethod
    def _topic(asked: Asked, row: Mapping[str, Any]) -> Topic:
        found = asked.tool(
            "get_topic_in_range",
            topic=row["topic"],
            start=row["first_ts"],
            end=row["last_ts"],
            max_samples=12,
        )
        return Topic(row, found.get("samples", []) if isinstance(found, dict) else [])

    def _track(self, asked: Asked) -> list[tuple[float, float, float]]:
        given = {"start": self.earliest, "end": self.latest, "max_waypoints": 60}
        found = asked.tool("trajectory_summary", **given, frame_id="map")
        if "waypoints" not in found:
            found = asked.tool("trajectory_summary", **given)
        rows = found.get("waypoints", [])
        return [(row["timestamp"], row["x"], row["y"]) for row in rows if row["x"] is not None]


def _places(track: Sequence[tuple[float, float, float]], draw: Random) -> dict[str, Any]:
    """A circle and a rectangle where the robot was, a polygon, and a place where it never was."""
    if not track:
        return {"nowhere": {"x": 900.0, "y": 900.0, "radius_m": 1.0}}
    _, x, y = draw.choice(track)
    xs, ys = [row[1] for row in track], [row[2] for row in track]
    middle = (min(xs) + max(xs)) / 2
    corners = [[max(xs) + 1, max(ys) + 1], [middle, max(ys) + 1], [max(xs) + 1, min(ys) - 1]]
    return {
        "kitchen": {"x": round(x, 2), "y": round(y, 2), "radius_m": 0.8},
        "west wing": {
            "x": [round(min(xs) - 1, 2), round(middle, 2)],
            "y": [round(min(ys) - 1, 2), round(max(ys) + 1, 2)],
        },
        "corner": {"polygon": [[round(a, 2), round(b, 2)] for a, b in corners]},
        "nowhere": {"x": round(max(xs) + 500, 2), "y": 900.0, "radius_m": 1.0},
    }


class Calls:
    """Draws calls.

    Args:
        facts: what there is to ask about.
        draw: decides.
        shows_messages: whether replies may repeat whole messages.
    """

    def __init__(self, facts: Facts, draw: Random, *, shows_messages: bool = True) -> None:
        self._facts = facts
        self._draw = draw
        self._shows = shows_messages
        self._poses = [topic for topic in facts.topics if topic.has_poses]
        self._testable = [topic for topic in facts.topics if topic.scalars]

    def drawn(self, count: int) -> list[Call]:
        """About `count` different calls: each way once, then ways by how much they can differ."""
        once: list[Callable[[], Call]] = [
            self._topics, self._span, self._status, self._list_frames, self._moments,
            self._position_at, self._position_ago, self._velocity_at, self._velocity_ago,
            self._transform_at, self._transform_ago, self._path, self._recent_path,
            self._visits, self._things, self._compare, self._recap, self._page_span,
            self._page_moment, self._listed, self._rules,
        ]  # fmt: skip
        slow = [self._info, self._forget, self._plot_path, self._plot_timeline, self._plot_recap]
        whole = [self._value_at, self._value_ago, self._values_in, self._values_last]
        slow += [self._parquet, self._plot_signal] if self._shows and self._facts.topics else []
        searches = [self._last_match, self._matches, self._value_when, self._matches_by]
        often = [*once[5:20], self._visits, self._recap, self._path, self._page_tool]
        if self._facts.topics:
            once += [*searches[:3], self._describe] if self._testable else []
            once += [*whole, self._cat] if self._shows else []
            often += [*searches * 4] if self._testable else []
            often += [*whole * 2, self._cat] if self._shows else []
            often += [self._counted, self._counted]
        found: dict[str, Call] = {}
        for make in [*once, *once, *slow]:
            self._add(found, make())
        for call in self._refused():
            self._add(found, call)
        for _ in range(4 * count):
            if len(found) >= count:
                break
            self._add(found, self._draw.choice(often)())
        return [*found.values()]

    @staticmethod
    def _add(found: dict[str, Call], call: Call) -> None:
        found.setdefault(json.dumps(call.as_json(), sort_keys=True), call)

    # -- parts of arguments

    def _maybe(self, chance: float, **given: Any) -> dict[str, Any]:
        return given if self._draw.random() < chance else {}

    def _topic(self) -> Topic:
        return self._draw.choice(self._facts.topics)

    def _time(self, topic: Topic | None = None) -> float:
        """A time at, beside or between messages, and now and then far off."""
        draw, facts = self._draw, self._facts
        known = [at for other in facts.topics for at in other.times] or [facts.earliest]
        at: float = draw.choice(topic.times if topic is not None else known)
        beside = draw.choice((0.0, 0.0, 0.03, -0.04, 0.5, -1.2, 7.0))
        if draw.random() < 0.04:
            beside = draw.choice((-5e6, 5e6))
        return round(at + beside, ROUND)

    def _window(self, topic: Topic | None = None) -> dict[str, float]:
        kind = self._draw.random()
        if kind < 0.35:
            return {"start": self._facts.earliest, "end": self._facts.latest}
        start = self._time(topic)
        end = (
            self._time(topic) if kind < 0.7 else start + self._draw.choice((1.0, 5.0, 30.0, 300.0))
        )
        start, end = sorted((start, round(end, ROUND)))
        return {"start": start, "end": end if end > start else start + 1.0}

    def _last(self) -> float:
        whole = max(self._facts.latest - self._facts.earliest, 1.0)
        return round(self._draw.choice((1.0, 7.5, 60.0, 600.0, whole, whole / 3)), 3)

    def _where(self) -> Any:
        draw = self._draw
        if draw.random() < 0.6 or not self._facts.track:
            return draw.choice([*self._facts.places])
        _, x, y = draw.choice(self._facts.track)
        near = {"x": round(x + draw.uniform(-1, 1), 2), "y": round(y + draw.uniform(-1, 1), 2)}
        if draw.random() < 0.5:
            return near | {"radius_m": draw.choice((0.3, 1.0, 3.0))}
        return {axis: [round(at - 0.7, 2), round(at + 0.9, 2)] for axis, at in near.items()}

    def _by(self) -> str:
        return self._draw.choice(_BYS)

    def _frame(self) -> str:
        return self._draw.choice([*self._facts.frames, "map", "odom"])

    def _fields(self, topic: Topic, *, numbers: bool = False) -> list[str]:
        paths = topic.numbers if numbers else [*topic.scalars]
        return self._draw.sample(paths, min(len(paths), self._draw.randint(1, 3)))

    def _condition(self, *, lists: bool = True) -> dict[str, Any]:
        """A condition that some messages meet, most of the time."""
        draw = self._draw
        topic = draw.choice(self._testable)
        given: dict[str, Any] = {"topic": topic.name}
        if topic.has_poses and self._facts.track and draw.random() < 0.6:
            _, x, y = draw.choice(self._facts.track)
            near = {"x": round(x + draw.uniform(-0.6, 0.6), 3), "y": round(y, 3)}
            return given | {"condition_type": "near_position", "value": near}
        path, values = draw.choice([*topic.scalars.items()])
        value = draw.choice(values)
        if not (isinstance(value, str) and draw.random() < 0.5):
            given["field"] = path
        if "/" in topic.name[1:] and lists and draw.random() < 0.15:
            given["topic"] = f"*/{topic.name.rpartition('/')[2]}"
        if isinstance(value, bool):
            given |= {"condition_type": "equals", "value": draw.choice((True, False))}
        elif isinstance(value, str):
            first = draw.randrange(max(len(value), 1))
            part = value[first : first + draw.randint(2, 8)].strip() or value or "never said"
            part = draw.choice((value or part, part, part.upper(), "never said"))
            kind = "equals" if part == value and draw.random() < 0.3 else "contains"
            given |= {"condition_type": kind, "value": part}
        else:
            kind = draw.choice(("above", "below", "above", "below", "equals"))
            off = 0 if kind == "equals" else draw.choice((0, 0, 0.01, -0.01, 1, 1e6, -1e6))
            given |= {"condition_type": kind, "value": value + off}
        if topic.type.rpartition("/")[2] in _SEEN and draw.random() < 0.3:
            given["min_score"] = draw.choice((0.0, 0.5, 0.9))
        return given

    # -- what there is

    def _topics(self) -> Call:
        glob = self._draw.choice(("/tf*", "*objects", "odom", "/never/*"))
        return Call("tool", "list_recorded_topics", self._maybe(0.5, pattern=glob))

    def _span(self) -> Call:
        return Call("tool", "data_time_range", {})

    def _status(self) -> Call:
        return Call("tool", "memory_status", {})

    def _list_frames(self) -> Call:
        return Call("tool", "list_frames", {})

    def _moments(self) -> Call:
        return Call("tool", "list_moments", {})

    def _describe(self) -> Call:
        return Call("tool", "describe_type", {"type": self._topic().type})

    # -- values

    def _value_at(self) -> Call:
        topic = self._topic()
        given: dict[str, Any] = {"topic": topic.name}
        if self._draw.random() < 0.2:
            given["timestamps"] = sorted({self._time(topic) for _ in range(3)})
        else:
            given["timestamp"] = self._time(topic)
        given |= self._maybe(0.5, tolerance_s=self._draw.choice((0.0, 1.0, 60.0)))
        given |= self._maybe(0.5, fields=self._fields(topic)) if topic.scalars else {}
        return Call("tool", "get_topic_at_time", given)

    def _value_ago(self) -> Call:
        topic = self._topic()
        given: dict[str, Any] = {"topic": topic.name, "seconds_ago": self._last()}
        given |= self._maybe(0.6, tolerance_s=self._draw.choice((0.5, 60.0)))
        return Call("tool", "get_topic_seconds_ago", given)

    def _values_in(self) -> Call:
        topic = self._topic()
        given = {"topic": topic.name, **self._window(topic)}
        given["max_samples"] = self._draw.choice((1, 2, 5, 12))
        given |= self._maybe(0.6, fields=self._fields(topic)) if topic.scalars else {}
        return Call("tool", "get_topic_in_range", given)

    def _values_last(self) -> Call:
        topic = self._topic()
        given: dict[str, Any] = {"topic": topic.name, "seconds": self._last(), "max_samples": 4}
        given |= self._maybe(0.6, fields=self._fields(topic)) if topic.scalars else {}
        return Call("tool", "get_topic_in_last", given)

    def _counted(self) -> Call:
        topic = self._topic()
        given = {"topic": topic.name, **self._window(topic), "by": self._by()}
        if topic.numbers:
            given |= self._maybe(0.8, fields=self._fields(topic, numbers=True))
        return Call("tool", "get_topic_in_range", given)

    # -- the robot

    def _motion(self, moment: dict[str, Any]) -> dict[str, Any]:
        given = dict(moment)
        if self._poses:
            given |= self._maybe(0.4, topic=self._draw.choice(self._poses).name)
        return given | self._maybe(0.3, tolerance_s=self._draw.choice((0.0, 2.0, 60.0)))

    def _moment(self) -> dict[str, Any]:
        topic = self._draw.choice(self._poses) if self._poses else None
        if self._draw.random() < 0.2:
            return {"timestamps": sorted({self._time(topic) for _ in range(4)})}
        return {"timestamp": self._time(topic)}

    def _position_at(self) -> Call:
        given = self._motion(self._moment()) | self._maybe(0.5, frame_id=self._frame())
        return Call("tool", "get_position_at", given)

    def _position_ago(self) -> Call:
        given = self._motion({"seconds_ago": self._last()})
        return Call("tool", "get_position_seconds_ago", given | self._maybe(0.5, frame_id="map"))

    def _velocity_at(self) -> Call:
        return Call("tool", "get_velocity_at", self._motion(self._moment()))

    def _velocity_ago(self) -> Call:
        return Call("tool", "get_velocity_seconds_ago", self._motion({"seconds_ago": self._last()}))

    def _transform_at(self) -> Call:
        given = {"parent": self._frame(), "child": self._frame(), **self._moment()}
        return Call("tool", "get_transform_at", given)

    def _transform_ago(self) -> Call:
        given = {"parent": self._frame(), "child": self._frame(), "seconds_ago": self._last()}
        return Call("tool", "get_transform_seconds_ago", given)

    def _way(self) -> dict[str, Any]:
        given: dict[str, Any] = {"max_waypoints": self._draw.choice((0, 2, 10))}
        if self._poses:
            given |= self._maybe(0.2, topic=self._draw.choice(self._poses).name)
        given |= self._maybe(0.3, frame_id=self._frame())
        extra = self._draw.random()
        if extra < 0.35:
            given["where"] = self._where()
        elif extra < 0.6:
            given["by"] = self._by()
        return given

    def _path(self) -> Call:
        return Call("tool", "trajectory_summary", {**self._window(), **self._way()})

    def _recent_path(self) -> Call:
        given = {"seconds": self._last(), **self._way()}
        return Call("tool", "recent_trajectory_summary", given)

    def _visits(self) -> Call:
        draw = self._draw
        given: dict[str, Any] = self._maybe(0.5, **self._window())
        kind = draw.random()
        if kind < 0.4 and self._facts.track:
            _, x, y = draw.choice(self._facts.track)
            given |= {"x": round(x, 2), "y": round(y, 2)}
            given |= self._maybe(0.7, radius_m=draw.choice((0.2, 1.0, 4.0)))
            given |= self._maybe(0.2, frame_id=self._frame())
        elif kind < 0.85:
            given["where"] = self._where()
        given |= self._maybe(0.3, by=self._by()) | self._maybe(0.3, limit=draw.choice((1, 50)))
        return Call("tool", "visits", given)

    # -- conditions

    def _last_match(self) -> Call:
        given = self._condition() | self._maybe(0.4, before=self._time())
        return Call("tool", "find_last_match", given)

    def _value_when(self) -> Call:
        condition = self._condition()
        condition["condition_topic"] = condition.pop("topic")
        topic = self._topic()
        given = {"value_topic": topic.name, **condition}
        if topic.scalars and (not self._shows or self._draw.random() < 0.5):
            given["fields"] = self._fields(topic)[:1]
        return Call("tool", "get_value_when", given | self._maybe(0.2, before=self._time()))

    def _matches(self) -> Call:
        draw = self._draw
        given = self._condition() | {"limit": draw.choice((1, 3, 8))}
        window = draw.random()
        if window < 0.4:
            given |= self._window()
        elif window < 0.6:
            given["seconds"] = self._last()
        given |= self._maybe(0.2, oldest_first=True) | self._maybe(0.25, where=self._where())
        if draw.random() < 0.25:
            given["while"] = {
                key: value
                for key, value in self._condition(lists=False).items()
                if key != "min_score"
            }
        return Call("tool", "find_matches", given | self._maybe(0.15, frame_id=self._frame()))

    def _matches_by(self) -> Call:
        given = self._condition() | {"by": self._by()} | self._maybe(0.6, **self._window())
        return Call("tool", "find_matches", given | self._maybe(0.2, where=self._where()))

    # -- what happened

    def _things(self) -> Call:
        draw = self._draw
        given: dict[str, Any] = self._maybe(0.4, **self._window())
        if self._facts.labels:
            given |= self._maybe(0.5, label=draw.choice([*self._facts.labels, "unicorn"]))
        given |= self._maybe(0.35, where=self._where())
        given |= self._maybe(0.3, min_score=draw.choice((0.0, 0.5, 0.9)))
        return Call("tool", "find_things", given)

    def _compare(self) -> Call:
        now, then = self._window(), self._window()
        given: dict[str, Any] = {**now, "with_start": then["start"], "with_end": then["end"]}
        return Call("tool", "compare", given | self._maybe(0.3, where=self._where()))

    def _recap(self) -> Call:
        draw, kind = self._draw, self._draw.random()
        given: dict[str, Any] = {"last_s": self._last()}
        if kind < 0.4:
            given = dict(self._window())
        elif kind < 0.7:
            given = {"around": self._time()} | self._maybe(0.4, seconds_before=30)
        given |= self._maybe(0.2, where=self._where()) | self._maybe(0.2, frame_id=self._frame())
        return Call("tool", "recap", given | self._maybe(0.2, min_score=draw.choice((0.5, 0.9))))

    # -- the page

    def _page_span(self) -> Call:
        given: list[list[str]] = [["patient", "1"]]
        if self._draw.random() < 0.6:
            given += [[key, repr(at)] for key, at in self._window().items()]
        plotted = [topic for topic in self._facts.topics if topic.numbers]
        if plotted and self._draw.random() < 0.6:
            topic = self._draw.choice(plotted)
            given.append(["signal", f"{topic.name}:{self._draw.choice(topic.numbers)}"])
        return Call("page", "/page/span", given)

    def _page_moment(self) -> Call:
        if self._draw.random() < 0.5:
            return Call("page", "/page/moment", [["t", repr(self._time())]])
        given = [[key, repr(at)] for key, at in self._window().items()]
        if self._facts.labels and self._draw.random() < 0.5:
            given.append(["label", self._draw.choice(self._facts.labels)])
        return Call("page", "/page/moment", given)

    def _page_tool(self) -> Call:
        tool = self._draw.choice((self._path, self._recap, self._visits))()
        given = [["tool", tool.name], ["arguments", json.dumps(tool.given)]]
        return Call("page", "/page/moment", given)

    # -- the command line

    def _bounds(self) -> list[str]:
        window = self._window()
        return ["--start", repr(window["start"]), "--end", repr(window["end"])]

    def _info(self) -> Call:
        return Call("cli", "info", words=["{bags}", *self._draw.choice(((), ("--json",)))])

    def _listed(self) -> Call:
        return Call("cli", self._draw.choice(("topics", "recordings")), words=["{bags}", "--json"])

    def _cat(self) -> Call:
        topic = self._topic()
        words = [topic.name, "{bags}", *self._draw.choice(((), ("--json",), ("--csv",)))]
        words += self._bounds() if self._draw.random() < 0.5 else []
        words += [self._draw.choice(("--limit", "--tail")), "6"]
        if topic.scalars and self._draw.random() < 0.5:
            words += ["--field", self._draw.choice([*topic.scalars])]
        return Call("cli", "cat", words=words)

    def _plot_path(self) -> Call:
        return Call("plot", "plot", words=["path", "{bags}", *self._bounds(), "--out", "{out}.svg"])

    def _plot_timeline(self) -> Call:
        words = ["timeline", "{bags}", *self._bounds(), "--out", "{out}.svg"]
        return Call("plot", "plot", words=words)

    def _plot_recap(self) -> Call:
        return Call(
            "plot", "plot", words=["recap", "{bags}", *self._bounds(), "--out", "{out}.svg"]
        )

    def _plot_signal(self) -> Call:
        plotted = [topic for topic in self._facts.topics if topic.numbers] or self._facts.topics
        topic = self._draw.choice(plotted)
        words = ["signal", topic.name, "{bags}", *self._bounds(), "--out", "{out}.svg"]
        return Call("plot", "plot", words=words)

    def _parquet(self) -> Call:
        words = ["{bags}", "--parquet", "{out}", "--json", *self._bounds()]
        if self._draw.random() < 0.4:
            words += ["--topic", self._topic().name]
        return Call("parquet", "export", words=words)

    def _forget(self) -> Call:
        place = self._draw.choice([*self._facts.places])
        bounds = self._bounds()
        recorded = ["--bag-dir", "{bags}", "recorder=ros2bag", "retention.foreign=delete"]
        words = ["--where", place, *bounds, "--dry-run", "--json", *recorded]
        return Call("cli", "forget", words=words)

    def _rules(self) -> Call:
        rules: dict[str, Any] = {}
        for number in range(3 if self._testable else 0):
            rule = self._condition(lists=False)
            if self._draw.random() < 0.4:
                rule["for_s"] = self._draw.choice((0.5, 3.0, 20.0))
            rules[f"rule {number}"] = rule
        if self._facts.topics:
            silent = {"kind": "silent", "topic": self._topic().name, "for_s": 5.0}
            rules["silence"] = silent
        return Call("rules", "search", rules)

    # -- what is refused

    def _refused(self) -> list[Call]:
        some = self._facts.topics[0].name if self._facts.topics else "/odom"
        at, start = self._facts.latest, self._facts.earliest
        wrong: list[tuple[str, dict[str, Any]]] = [
            ("get_positon_at", {"timestamp": at}),
            ("remember_moment", {"label": "x"}),
            ("get_position_at", {}),
            ("get_position_at", {"timestamp": at, "timestamps": [at]}),
            ("get_position_at", {"timestamp": "10 s ago"}),
            ("get_position_at", {"timestamp": at * 1000}),
            ("get_position_at", {"timestamp": at, "frame_id": "nirvana"}),
            ("get_topic_at_time", {"topic": f"{some}x", "timestamp": at}),
            ("get_topic_at_time", {"topic": some, "timestamp": at, "fields": ["no.such"]}),
            ("get_topic_in_range", {"topic": some, "start": at, "end": start - 1}),
            ("get_topic_in_range", {"topic": some, "start": start, "end": at, "by": "month"}),
            ("find_last_match", {"topic": some, "condition_type": "like", "value": 1}),
            ("find_last_match", {"topic": "/no/*", "condition_type": "equals", "value": 1}),
            (
                "find_matches",
                {"topic": some, "condition_type": "contains", "value": "a", "where": "attic"},
            ),
            ("visits", {"x": 1.0}),
            ("visits", {"where": {"x": 1.0, "y": [2, 1]}}),
            ("recap", {"last_s": 5, "around": at}),
            ("get_transform_at", {"parent": "map", "child": "nirvana", "timestamp": at}),
            ("compare", {"start": start, "end": at, "with_start": at, "with_end": start}),
            ("show_moment", {"moment": "none"}),
            ("describe_type", {"type": "no_msgs/msg/Such"}),
        ]
        chosen = self._draw.sample(wrong, 7)
        if not self._shows:
            chosen = [row for row in chosen if not row[0].startswith("get_topic")]
        return [Call("tool", name, given) for name, given in chosen]
