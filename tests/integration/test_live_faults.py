"""SIGKILL at random moments, over real DDS: what is closed answers, and little is lost.

Ten kills at each rate; EPISODIC_LONG=1 makes it 50. EPISODIC_SEED chooses other moments.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pytest

from tests.integration.kill_campaign import Campaign, Terms, place_is_right, run_campaign
from tests.support.examples import LONG
from tests.support.real_recorder import RealRecorder
from tests.timing import Watch, driven

KILLS: Final = 50 if LONG else 6
SEED: Final = int(os.environ.get("EPISODIC_SEED", "20261120"))
CHUNK_BYTES: Final = 16384  # recorder.chunk_bytes
PROMISED_S: Final = 2.0
TERMS: Final = {
    "reference": Terms("reference", 50.0, 2, 6, KILLS, 2.5 if KILLS <= 10 else 7.0, SEED),
    "slow": Terms("slow", 1.0, 2, 9, KILLS, 3.5, SEED + 1),
}


@dataclass
class Campaigns:
    """What came of them, and what the machine did to their programs."""

    watch: Watch
    found: dict[str, Campaign]


@pytest.fixture(scope="module")
def campaigns(real_recorder: RealRecorder, tmp_path_factory: pytest.TempPathFactory) -> Campaigns:
    folder = tmp_path_factory.mktemp("faults")
    return driven(lambda watch: _run(folder, watch, real_recorder), _judge)


def _run(folder: Path, watch: Watch, real: RealRecorder) -> Campaigns:
    with ThreadPoolExecutor(len(TERMS)) as pool:
        running = {
            name: pool.submit(run_campaign, terms, folder / name, real)
            for name, terms in TERMS.items()
        }
        found = {name: future.result() for name, future in running.items()}
    for name, campaign in found.items():
        watch.report(f"the robot of {name}", campaign.robot_late_s)
    return Campaigns(watch, found)


def _judge(campaigns: Campaigns) -> None:
    """All that is promised by the clock."""
    for campaign in campaigns.found.values():
        _lost_at_kills_alone(campaign)
    _lost_at_most_2_s(campaigns.found["reference"])
    _lost_at_most_a_split(campaigns.found["slow"])


@pytest.fixture(params=list(TERMS))
def campaign(campaigns: Campaigns, request: pytest.FixtureRequest) -> Campaign:
    return campaigns.found[request.param]


def test_every_closed_split_answers_right_after_the_kill(campaign: Campaign) -> None:
    for fault in campaign.faults:
        counts = {row["topic"]: row["count"] for row in fault.topics.reply if "topic" in row}
        assert counts.get("/odom", 0) >= len(fault.closed)
        assert place_is_right(fault), fault


def test_what_was_closed_before_a_kill_counts_for_good(campaign: Campaign) -> None:
    there = {tick.number for tick in campaign.found}
    assert all(fault.closed <= there for fault in campaign.faults)


def test_the_next_starts_leave_no_file_that_does_not_answer(campaign: Campaign) -> None:
    aside = ("active", "damaged", "incomplete", "unread")
    assert {kind: campaign.after[kind] for kind in aside} == {key: [] for key in aside}


def test_no_message_counts_twice_and_none_is_moved(campaign: Campaign) -> None:
    numbers = [tick.number for tick in campaign.found]
    assert numbers == sorted(set(numbers))
    assert campaign.counted_by_server == len(numbers)


def test_nothing_is_lost_but_at_the_kills(campaigns: Campaigns, campaign: Campaign) -> None:
    with campaigns.watch.excusing():
        _lost_at_kills_alone(campaign)


def _lost_at_kills_alone(campaign: Campaign) -> None:
    assert not any(campaign.holes().values())
    assert campaign.unexplained() == []


def test_whatever_stands_anywhere_counts(campaign: Campaign) -> None:
    standing = {tick.number for held in campaign.held.values() for tick in held}
    assert {tick.number for tick in campaign.found} == standing


def test_at_the_reference_rates_at_most_2_s_are_lost(campaigns: Campaigns) -> None:
    with campaigns.watch.excusing():
        _lost_at_most_2_s(campaigns.found["reference"])


def _lost_at_most_2_s(campaign: Campaign) -> None:
    losses = campaign.losses()
    receiving = [loss.seconds for loss in losses if loss.holds_any]
    # After a kill Fast DDS may hold a topic back from the next recorder for some seconds, while it
    # delivers others. One that holds none of the topic need not have received any.
    assert len(receiving) >= len(losses) / 2
    assert max(receiving) <= PROMISED_S


def test_at_1_hz_at_most_an_open_split_is_lost_and_not_more_than_a_chunk(
    campaigns: Campaigns,
) -> None:
    with campaigns.watch.excusing():
        _lost_at_most_a_split(campaigns.found["slow"])


def _lost_at_most_a_split(campaign: Campaign) -> None:
    losses = campaign.losses()
    assert losses
    most = max(loss.ticks for loss in losses)
    assert most <= campaign.terms.split_s + 1
    assert most * campaign.bytes_of_a_tick <= CHUNK_BYTES
