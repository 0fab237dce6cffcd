"""Moments, through both programs: a planner asks the server, and the recorder's daemon keeps."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.bag_dir.layout import REQUESTS_FOLDER
from ros2_memory.bag_dir.moment_file import StoredMoment, stored_moments_in
from tests.integration.test_recorder_daemon import Site, sited
from tests.support.live_recorder import answer
from tests.support.processes import until
from tests.support.served import Served, serving
from tests.timing import each_in_time


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with sited(tmp_path) as site:
        yield site


@pytest.fixture
def served(site: Site) -> Iterator[Served]:
    with asked_about(site) as served:
        yield served


@contextmanager
def asked_about(site: Site) -> Iterator[Served]:
    """A server over the same directory, that may ask for moments to be kept."""
    site.bag_dir.mkdir()
    overrides = ("data.now=wall", "server.write_tools=true", "reader.index_refresh_s=0.2")
    with serving(site.bag_dir, site.folder / "server.log", *overrides) as served:
        yield served


def complete(bag_dir: Path) -> StoredMoment:
    """The one moment that is kept, when nothing of it is waited for any more."""

    def is_complete() -> StoredMoment | None:
        [held] = stored_moments_in(bag_dir)
        return None if held.moment.pending else held

    return until(is_complete)


def originals(held: StoredMoment, bag_dir: Path) -> list[Path]:
    """Where the bags of a moment were recorded."""
    return [bag_dir / path.relative_to(held.folder) for path in held.folder.rglob("*.mcap")]


def about(served: Served, reply: dict[str, Any]) -> list[Any]:
    """Answers about the time of a moment; without the notes, which say what is open just now."""
    given = {"topic": "/odom", "start": reply["start"], "end": reply["end"], "max_samples": 7}
    middle = (reply["start"] + reply["end"]) / 2
    answers = [
        answer(served, "get_topic_in_range", **given),
        answer(served, "get_topic_at_time", topic="/tf", timestamp=middle),
    ]
    return [{key: each[key] for key in each if key != "notes"} for each in answers]


@each_in_time
def test_a_moment_is_answered_from_when_its_bags_have_long_been_deleted(tmp_path: Path) -> None:
    """They are deleted after 11 s, and until then the moment must be kept and looked at."""
    with sited(tmp_path) as site, asked_about(site) as served:
        keeps_a_moment(site, served)


def keeps_a_moment(site: Site, served: Served) -> None:
    daemon = site.run("retention.max_age_h=0.003")
    daemon.wait_for("split_closed", 4)
    reply = answer(served, "remember_moment", label="Küche", seconds_before=2.5)
    assert (reply["label"], reply["bags"] >= 2) == ("Küche", True), reply
    held = complete(site.bag_dir)
    assert (held.folder.name, held.moment.missing) == (reply["moment"], ())
    recorded = originals(held, site.bag_dir)
    assert len(recorded) >= 3
    before = until(lambda: _whole(about(served, reply)))
    assert all(path.exists() for path in recorded)
    until(lambda: not any(path.exists() for path in recorded))
    assert about(served, reply) == before
    [listed] = answer(served, "memory_status")["moments"]
    assert (listed["label"], listed["bags"], listed["complete"]) == ("Küche", len(recorded), True)
    assert list((site.bag_dir / REQUESTS_FOLDER).iterdir()) == []
    daemon.stop()


def test_a_recorder_that_is_killed_while_a_moment_waits_goes_on_with_it_when_it_is_back(
    site: Site, served: Served
) -> None:
    daemon = site.run()
    daemon.wait_for("split_closed", 2)
    reply = answer(served, "remember_moment", label="fall", seconds_before=1, seconds_after=1)
    assert reply["pending"], reply
    daemon.kill(with_children=False)
    refused = answer(served, "remember_moment", label="later")
    assert refused["error"] == "refused", refused
    following = site.run()
    held = complete(site.bag_dir)
    assert held.moment.missing == ()
    kept = {path.name for path in held.folder.rglob("*.mcap")}
    assert len(kept) == len(held.files) > reply["bags"]
    following.stop()


RULES = """
rules:
  said: {topic: /odom, condition_type: contains, value: "1", before_s: 1, after_s: 1}
  restarted: {kind: recorder_restart, before_s: 1, after_s: 1}
"""


def test_rules_save_moments_over_a_rotation_and_a_kill(site: Site) -> None:
    rules = site.folder / "triggers.yaml"
    rules.write_text(RULES)
    given = (f"recording.keep_when={rules}", "recording.session_duration_s=3")
    daemon = site.run(*given)
    daemon.wait_for("trigger_fired", rule="said")
    daemon.wait_for("rotated")
    daemon.kill(with_children=True)
    following = site.run(*given)
    following.wait_for("trigger_fired", rule="restarted")

    def complete() -> bool:
        moments = [held.moment for held in stored_moments_in(site.bag_dir)]
        return {each.rule for each in moments if not each.pending} == {"said", "restarted"}

    until(complete)
    following.stop()


def _whole(answers: list[Any]) -> list[Any] | None:
    """Answers in which the newest split has its part, too."""
    return answers if "total" in answers[0] and answers[0]["total"] >= 240 else None
