"""Nothing outside the bag directory is opened or deleted, whatever lies or is asked for inside it.

What a program opens is heard from the interpreter itself (`sys.addaudithook`), so that no way of
opening a file is forgotten here.
"""

import json
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.durable_write import write_durably
from ros2_memory.bag_dir.handover_file import Handover, read_handover, write_handover
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.bag_dir.moment_file import PendingRequest, RequestQueue
from ros2_memory.bootstrap import build_backfill, build_memory, build_repairer, build_server
from ros2_memory.cli.maintenance.recover import recover_files
from ros2_memory.columns.database import open_file
from ros2_memory.config import load_settings
from ros2_memory.core.errors import BagError, RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.index.file_state import ScanContext
from ros2_memory.index.scan import Tree
from ros2_memory.retention.clear import clear_bags, remove_if_empty
from ros2_memory.serving.mcp_server import EpisodicServer
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.bags import boolean, text, write_db3, write_mcap
from tests.support.examples import LONG
from tests.support.handovers import recover_handovers
from tests.support.robot_run import ANSWERED, T0, T0_S, write_run

SECRET = "/outside/secret"  # noqa: S105  the name of a topic
HEARD = {
    "open",
    "os.listdir",
    "os.scandir",
    "sqlite3.connect",
    "os.remove",
    "os.rmdir",
    "os.rename",
}

_heard: list[list[str]] = []


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    if _heard and event in HEARD and isinstance(arguments[0], str | bytes | Path):
        _heard[-1].append(f"{event} {os.fsdecode(arguments[0])}")


sys.addaudithook(_hear)


@contextmanager
def hearing() -> Iterator[list[str]]:
    """What was opened, listed or deleted, by name."""
    _heard.append([])  # a hook cannot be taken away again
    try:
        yield _heard[-1]
    finally:
        _heard.pop()


@contextmanager
def asking(bag_dir: Path, *overrides: str) -> Iterator[EpisodicServer]:
    """A server whose store has all that lies there."""
    wanted = ["recorder=none", "storage=rosbag2", "data.now=latest", *overrides]
    settings = load_settings(wanted, {"MEMORY_BAG_DIR": str(bag_dir)})
    memory = build_memory(settings)
    filler = build_backfill(settings, memory)
    for batch in filler.batches():
        filler.store(batch)
    server = build_server(settings, memory)
    try:
        yield server
    finally:
        server.dispatcher.stop()


async def told(server: EpisodicServer, name: str, given: dict[str, Any]) -> str:
    result = await server.call_tool(name, given)
    return json.dumps([block.model_dump() for block in result.content])


@pytest.fixture
def bags(tmp_path: Path) -> Path:
    write_run(tmp_path / "bags")
    return tmp_path / "bags"


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """Bags elsewhere, of every kind, with a topic that no answer may name."""
    folder = tmp_path / "outside" / "rec"
    secret = [text(T0 + n * NS_PER_S, f"secret {n}", SECRET) for n in range(5)]
    write_mcap(folder / "rec_0.mcap", secret)
    write_db3(folder / "rec_1.db3", secret)
    (folder / "metadata.yaml").write_text("relative_file_paths:\n- rec_0.mcap\n")
    return folder


@contextmanager
def untouched(folder: Path) -> Iterator[None]:
    """Nothing below the folder changes in the block."""

    def contents() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    before = contents()
    yield
    assert contents() == before


LINKS = {
    "run/x.mcap": "rec_0.mcap",
    "x.db3": "rec_1.db3",
    "rec": "",
    "more": "..",
    "one": "",
    "run/metadata.yaml": "metadata.yaml",
    "own.db3-wal": "rec_1.db3",
}
"""From a bag directory to what lies outside."""
RELATIVE_LINKS = {"relative": "../outside/rec", "two": "one", "x.mcap": "two/rec_0.mcap"}


@pytest.fixture(params=["the store's folder", "all others"])
def linked(request: pytest.FixtureRequest, bags: Path, outside: Path) -> None:
    """Links in the bag directory; through that of the store's folder nothing is stored."""
    if request.param == "the store's folder":
        (bags / ".episodic").symlink_to(outside)
        return
    write_db3(bags / "own.db3", [boolean(T0, data=True)])
    for name, target in LINKS.items():
        (bags / name).symlink_to(outside / target)
    for name, target in RELATIVE_LINKS.items():
        (bags / name).symlink_to(target)


@pytest.mark.usefixtures("linked")
async def test_no_tool_reads_what_a_link_leads_to(bags: Path, outside: Path) -> None:
    with untouched(outside):
        with hearing() as heard, asking(bags) as server:
            for name, given, _ in ANSWERED:
                assert SECRET not in await told(server, name, given)
            for name, at in (
                ("get_topic_in_range", {"start": T0_S, "end": T0_S + 9}),
                ("get_topic_at_time", {"timestamp": T0_S + 3}),
            ):
                answer = await told(server, name, {"topic": SECRET, **at})
                assert "secret 1" not in answer
                assert "topic_not_recorded" in answer
        assert [each for each in heard if "outside" in each or "/rec_" in each] == []


async def test_a_directory_that_a_link_replaced_since_it_was_listed_is_not_read(
    bags: Path, outside: Path
) -> None:
    write_mcap(bags / "rec" / "rec_0.mcap", [text(T0, "own", "/own")])
    with asking(bags, "reader.index_refresh_s=1000") as server:
        assert "/own" in await told(server, "list_recorded_topics", {})
        shutil.rmtree(bags / "rec")
        (bags / "rec").symlink_to(outside)
        given = {"topic": SECRET, "start": T0_S, "end": T0_S + 9}
        with hearing() as heard:
            assert "secret 1" not in await told(server, "get_topic_in_range", given)
            answer = await told(server, "get_topic_in_range", given | {"topic": "/own"})
    assert [each for each in heard if "rec_0" in each] == []
    assert "symbolic link" in answer


@pytest.mark.parametrize("reader", [McapReader, Rosbag2Reader])
def test_a_file_that_a_link_replaced_since_it_was_listed_is_not_read(
    bags: Path, outside: Path, reader: type[McapReader | Rosbag2Reader]
) -> None:
    path = bags / "run" / "run_0.mcap"
    path.unlink()
    path.symlink_to(outside / "rec_0.mcap")
    for ask in (reader().summarize, reader().is_finished, reader().channels):
        with pytest.raises(BagError, match="symbolic link, which is not followed"):
            ask(path)


def test_a_folder_that_a_link_replaces_during_a_look_is_not_listed(
    bags: Path, outside: Path
) -> None:
    tree = Tree(bags)
    tree.scan(T0, ())
    (bags / "run").rename(bags / "gone")
    (bags / "run").symlink_to(outside)
    # As if the link had come after the bag directory was listed.
    tree._folders[str(bags)].mtime_ns = bags.stat().st_mtime_ns
    tree._folders[str(bags)].trusted = True
    walked = tree.scan(T0, ())
    assert not [path for path in walked.stamps if "rec_0" in path]
    assert str(bags / "run/run_0.mcap") in walked.gone


@pytest.mark.parametrize(
    "path", ["../outside/rec/rec_0.mcap", "run/../../outside/rec/rec_0.mcap", "/etc/passwd"]
)
def test_the_reader_of_a_bag_directory_opens_nothing_beside_it(
    bags: Path, outside: Path, path: str
) -> None:
    reader = BagDirReader(McapReader(), bags)
    with pytest.raises(BagError, match="is not in the bag directory"):
        reader.summarize(bags / path)
    with pytest.raises(BagError, match="is not in the bag directory"):
        next(reader.records(bags / path, ["/odom"], TimeWindow.everything()))


async def test_the_bag_directory_may_be_a_link_itself(bags: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(bags, target_is_directory=True)
    with asking(tmp_path / "link") as server:
        assert "/odom" in await told(server, "list_recorded_topics", {})
        given = {"topic": "/odom", "timestamp": T0_S + 5}
        assert "position" in await told(server, "get_topic_at_time", given)


# What deletes: retention has its tests beside it (`test_housekeeping.py`).


@pytest.mark.usefixtures("linked")
def test_a_repair_the_next_start_a_wipe_and_recover_leave_what_a_link_leads_to(
    bags: Path, outside: Path
) -> None:
    cut = outside / "rec_0.mcap"
    cut.write_bytes(cut.read_bytes()[:-100])
    (outside / "rec_9.mcap").touch()
    write_handover(outside, Handover(next="rec_2"))
    with untouched(outside):
        recover_files(bags, force=True)
        recover_handovers(bags, McapReader())
        clear_bags(bags)
    # Through a linked directory that is refused, and the path itself named.
    (outside / ".rec_9.mcap.repair").write_bytes(b"kept")
    (bags / "linked").symlink_to(outside)
    with untouched(outside):
        assert not remove_if_empty(bags / "linked")
        for path in (bags / "linked", bags / "linked/rec_0.mcap", bags / "linked/rec_9.mcap"):
            with pytest.raises(RecorderError, match="symbolic link") as refused:
                recover_files(path, force=True)
            assert str(path.resolve()) in str(refused.value)
            if path.suffix:
                with pytest.raises(BagError, match="behind a symbolic link"):
                    build_repairer().repair(path)


def test_a_wipe_leaves_what_takes_a_directory_s_place_meanwhile(
    bags: Path, outside: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_mcap(bags / "rec" / "rec_0.mcap", [text(T0, "own", "/own")])
    real, moved = os.open, bags / "moved"

    def swapping(path: Any, *given: Any, **more: Any) -> int:
        if path == "rec" and not moved.exists():
            (bags / "rec").rename(moved)
            (bags / "rec").symlink_to(outside)
        return real(path, *given, **more)

    monkeypatch.setattr(os, "open", swapping)
    with untouched(outside):
        assert len(clear_bags(bags).faults) == 1
    assert moved.exists()


def test_nothing_is_asked_for_answered_or_stored_behind_a_link(bags: Path, outside: Path) -> None:
    (outside / "requests").mkdir()
    (outside / "requests" / f"{'0' * 32}.json").write_text("{}")
    (outside / "columns.sqlite").write_text("somebody's own")
    (bags / "own").mkdir()
    with untouched(outside):
        (bags / ".episodic").symlink_to(outside)
        with pytest.raises(OSError, match="symbolic link"):
            PendingRequest(bags, "label", 0, 1, 2).post()
        queue = RequestQueue(bags)
        queue.open()
        assert not queue.has_requests()
        assert "symbolic link" in str(open_file([bags / ".episodic" / "columns.sqlite"]))
        for name in ("columns.sqlite", "columns.sqlite-wal", "columns.sqlite-shm"):
            link = bags / "own" / name
            link.symlink_to(outside / "columns.sqlite")
            assert "symbolic link" in str(open_file([bags / "own" / "columns.sqlite"]))
            link.unlink()


def test_no_sidecar_is_read_or_written_through_a_link(bags: Path, outside: Path) -> None:
    kept, other = outside / "metadata.yaml", outside / "other.json"
    other.write_text('{"format": 1}')
    (bags / "run/handover.json").symlink_to(other)
    (bags / "recorder.json").symlink_to(other)
    (bags / "run/metadata.yaml").symlink_to(kept)
    assert "symbolic links" in (read_handover(bags / "run").problem or "")
    assert read_heartbeat(bags).heartbeat is None
    assert not ScanContext(bags, 0, 0).lists(bags / "run/rec_0.mcap")
    with untouched(outside):
        (bags / "recorder.json").unlink()
        (bags / ".recorder.json.tmp").symlink_to(kept)
        with pytest.raises(OSError, match="symbolic links"):
            write_durably(bags / "recorder.json", "{}")
        (bags / "recorder.json").symlink_to(kept)
        write_durably(bags / "recorder.json", "{}")
        (bags / "recorder.lock").symlink_to(outside / "lock")
        with pytest.raises(RecorderError, match="cannot be opened"):
            BagDirLock.acquire(bags)
        (bags / "x.mcap").symlink_to(kept)
        with pytest.raises(BagError, match="File exists"):
            McapWriter().write(bags / "x.mcap", [])


HOSTILE = (
    "/etc/passwd",
    "../../../../../../etc/passwd",
    "../outside/rec/rec_0.mcap",
    "run/run_0.mcap",
    "file:///proc/self/environ",
    "std_msgs/msg/../../../../etc/passwd",
    "*/../../*",
    "~/.ssh/id_rsa",
    "$(cat ${HOME}/secret)",
)


async def test_no_text_of_a_caller_reaches_the_file_system(bags: Path) -> None:
    places = [
        (name, given, key)
        for name, given, _ in ANSWERED
        for key, value in [*given.items(), ("path", "")]
        if isinstance(value, str)
    ]
    # In a short run each place has one of the texts, and each text several places.
    calls = [
        (name, given | {key: hostile})
        for nth, (name, given, key) in enumerate(places)
        for hostile in (HOSTILE if LONG else HOSTILE[nth % len(HOSTILE) :][:1])
    ]
    with asking(bags) as server:
        # Once without being heard: modules are loaded then.
        for name, given, _ in ANSWERED:
            await told(server, name, given)
        with hearing() as heard:
            for name, given in [*calls, *((hostile, {}) for hostile in HOSTILE)]:
                await told(server, name, given)
        assert [each for each in heard if str(bags) not in each and "sqlite3" not in each] == []
        assert [each for each in heard if "passwd" in each or "outside" in each] == []
