"""A bag directory that a recorder of ours fills split by split, and screens before it is served."""

from collections.abc import Iterable
from pathlib import Path

from mcap.reader import make_reader

from ros2_memory.analysis.conditions import parse_condition
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.bag_dir.layout import utc_stamp
from ros2_memory.bag_dir.state_files import read_withheld
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.triggers.exclusion import ExclusionRule
from ros2_memory.triggers.screening import Screening
from tests.support.bags import McapLayout, Msg, boolean, text, write_mcap
from tests.support.memories import shipped_extractor

S = 10**9
T0 = 1_790_000_000 * S
LATCHED = McapLayout(latched=frozenset({"/privacy_mode", "/map"}))


def privacy(**given: object) -> ExclusionRule:
    """A rule on `/privacy_mode` being true, with a margin of a second, unless told otherwise."""
    made: dict[str, object] = {
        "name": "privacy",
        "topic": "/privacy_mode",
        "condition": parse_condition("equals", True, 0.5),
        "margin": S,
        "stale": 3 * S,
    }
    return ExclusionRule(**{**made, **given})  # type: ignore[arg-type]  # of its own fields


def mode(second: float, value: bool, published: float | None = None) -> Msg:
    at = T0 + round(second * S)
    said = boolean(at, value, "/privacy_mode")
    return Msg(said.topic, said.type, at, said.body, T0 + round((published or second) * S))


def on(second: float, published: float | None = None) -> Msg:
    return mode(second, value=True, published=published)


def off(second: float) -> Msg:
    return mode(second, value=False)


def word(second: float, topic: str = "/chatter") -> Msg:
    """A message that says when it was recorded."""
    return text(T0 + round(second * S), f"{topic}@{second:g}", topic)


def words(begin: int, stop: int) -> list[Msg]:
    return [word(n + 0.5) for n in range(begin, stop)]


class ScreenedBags:
    """Writes splits as the recorder does, and has them screened."""

    def __init__(self, bag_dir: Path, *rules: ExclusionRule) -> None:
        bag_dir.mkdir(exist_ok=True)
        self.bag_dir = bag_dir
        self.rules = rules or (privacy(),)
        self.now_s = 0.0
        self.screening = self.new()
        self.live: set[str] = set()
        self._splits: dict[str, int] = {}

    def new(self) -> Screening:
        """The screening of a recorder that starts anew."""
        return Screening(
            self.bag_dir,
            self.rules,
            BagDirReader(McapReader(), self.bag_dir, every_message=True),
            shipped_extractor(),
            McapWriter(),
            split_duration_s=10.0,
            monotonic=lambda: self.now_s,
        )

    def begin(self, second: float) -> str:
        name = f"rec_{utc_stamp(T0 + round(second * S))}"
        while name in self._splits:
            name += "_2"
        self.screening.announce(name)
        if self.live:
            (self.bag_dir / name).mkdir()
            write_handover(self.bag_dir / name, Handover(previous=max(self.live)))
        self._splits[name] = 0
        self.live.add(name)
        return name

    def split(
        self, messages: Iterable[Msg], layout: McapLayout | None = None, *, of: str | None = None
    ) -> Path:
        """Writes and closes a split: of the newest recording, which begins if there is none."""
        name = of or next(reversed(self._splits), None) or self.begin(0)
        path = self.bag_dir / name / f"{name}_{self._splits[name]}.mcap"
        self._splits[name] += 1
        beside = path.with_name(".being_written")
        write_mcap(beside, sorted(messages, key=lambda each: each.log_time), layout or LATCHED)
        return beside.rename(path)

    def step(self) -> None:
        self.now_s += 60
        self.screening.plan(self.live)()

    def end(self, *names: str) -> None:
        """Ends recordings, or all, and screens what is left."""
        self.live -= {*names} or {*self.live}
        for _ in range(4):
            self.step()

    def served(self) -> list[Path]:
        """The bags that are not held back."""
        withheld = read_withheld(self.bag_dir)
        return [
            path
            for path in sorted(self.bag_dir.glob("rec_*/*.mcap"))
            if not withheld.holds(path.parent.name, path.name)
        ]

    def seconds(self, topic: str = "/chatter") -> list[float]:
        """When the messages of a topic that are served were recorded, by plain MCAP."""
        found = []
        for path in self.served():
            with path.open("rb") as stream:
                for _, _, message in make_reader(stream).iter_messages(topics=[topic]):
                    found.append((message.log_time - T0) / S)
        return sorted(found)
