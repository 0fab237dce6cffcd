"""The reader of a bag directory: what counts elsewhere is left out, the rest is as in the files."""

import random
from pathlib import Path

import pytest

from ros2_memory import queries
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import Handover, Overlap, write_handover
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call, Memory
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, boolean, text, write_mcap
from tests.support.examples import examples
from tests.support.memories import memory_of

T0 = 1_700_000_000 * 10**9
S = 10**9
LATE = 24_000


def taken_over(bag_dir: Path) -> tuple[Path, Path]:
    """Two recordings that both hold what was published in the seconds 6 to 10."""

    def message(n: int, late: int) -> Msg:
        at = T0 + n * S // 2
        return Msg("/bumper", "std_msgs/msg/Bool", at + late, boolean(at, data=True).body, at)

    old = write_mcap(bag_dir / "a" / "a_0.mcap", [message(n, 0) for n in range(20)])
    new = write_mcap(bag_dir / "b" / "b_0.mcap", [message(n, LATE) for n in range(12, 40)])
    return old, new


def cut(bag_dir: Path, at: int) -> None:
    overlap = {"log_from": None, "log_until": None}
    end, begin = Overlap(**overlap, files=("a_0.mcap",)), Overlap(**overlap, files=("b_0.mcap",))
    write_handover(bag_dir / "a", Handover(next="b", counts_until=at, end=end))
    write_handover(bag_dir / "b", Handover(previous="a", counts_from=at, begin=begin))


def counting(bag_dir: Path) -> Memory:
    return memory_of(bag_dir, reader=BagDirReader(McapReader()))


def test_a_latched_message_received_again_is_not_cut_off(tmp_path: Path) -> None:
    docked = text(T0, "docked", "/dock")
    again = Msg(docked.topic, docked.type, T0 + 9 * S, docked.body, docked.log_time)
    layout = McapLayout(latched=frozenset({"/dock"}))
    new = write_mcap(tmp_path / "b" / "b_0.mcap", [again], layout)
    begin = Overlap(None, None, ("b_0.mcap",))
    write_handover(tmp_path / "b", Handover(previous="a", counts_from=T0 + 8 * S, begin=begin))
    assert BagDirReader(McapReader()).summarize(new).count == 1


def test_a_sidecar_that_cannot_be_read_hides_nothing_and_is_named(tmp_path: Path) -> None:
    old, _ = taken_over(tmp_path)
    (tmp_path / "a" / "handover.json").write_text("[")
    summary = BagDirReader(McapReader()).summarize(old)
    assert summary.count == 20
    assert "handover.json" in summary.notes[-1]
    assert "handover.json" in queries.data_time_range(counting(tmp_path), Call()).notes[0]


def test_every_message_is_read_where_counts_are_compared_with_the_files(tmp_path: Path) -> None:
    old, _ = taken_over(tmp_path)
    cut(tmp_path, T0 + 8 * S)
    reader = BagDirReader(McapReader(), tmp_path, every_message=True)
    assert reader.summarize(old).count == 20
    assert len(list(reader.records(old, ["/bumper"], TimeWindow.everything()))) == 20


@pytest.mark.parametrize("seed", range(examples(40)))
def test_a_summary_states_what_a_reading_gives(tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)

    def moment() -> int:
        return T0 + draw.randrange(examples(40)) * S // 4

    def message(topic: str) -> Msg:
        at = moment()
        body = boolean(at, data=True) if draw.random() < 0.7 else text(at, "also of this name")
        return Msg(topic, body.type, at, body.body, at - draw.randrange(-2, 3) * S // 4)

    messages = [message(draw.choice(["/bumper", "/other"])) for _ in range(60)]
    layout = McapLayout(chunk_size=draw.choice([200, 1000, 1 << 20]))
    bag = write_mcap(tmp_path / "a" / "a_0.mcap", messages, layout)

    def overlap() -> Overlap:
        start, stop = sorted((moment(), moment()))
        return Overlap(draw.choice([None, start]), draw.choice([None, stop]), ("a_0.mcap",))

    write_handover(
        tmp_path / "a",
        Handover(
            previous="z",
            counts_from=draw.choice([None, moment(), moment()]),
            begin=overlap(),
            next="b",
            counts_until=draw.choice([None, moment(), moment()]),
            end=overlap(),
        ),
    )
    reader = BagDirReader(McapReader())
    found: dict[tuple[str, str], list[int]] = {}
    for record in reader.records(bag, ["/bumper", "/other"], TimeWindow.everything()):
        found.setdefault((record.channel.topic, record.channel.type), []).append(record.log_time)
    assert {
        (each.topic, each.type): (each.count, each.first, each.last)
        for each in reader.summarize(bag).topics
    } == {key: (len(times), times[0], times[-1]) for key, times in found.items()}
