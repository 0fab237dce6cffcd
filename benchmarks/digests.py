"""What the catalogue keeps of a bag: what making it costs, and the same bag as of another time."""

from __future__ import annotations

import statistics
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from benchmarks import ours
from benchmarks.bags import ODOM
from benchmarks.report import Figure
from ros2_memory.analysis.intervals import moved_rows
from ros2_memory.analysis.motion.standstills import (
    BLOCK_NS,
    ChainDigest,
    decode_blocks,
    decode_positions,
    encode_blocks,
    encode_positions,
)
from ros2_memory.analysis.sights import Look, Spot, Unplaced, decode_sights, encode_sights
from ros2_memory.bootstrap import build_backfill, build_digester
from ros2_memory.cli.maintenance.index import fill_catalogue
from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from ros2_memory.places.bag_statics import BagStatics

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from benchmarks.questions import Case
    from ros2_memory.analysis.motion.odometry import Leg, PoseDigest, TimedPosition
    from ros2_memory.analysis.motion.standstills import StandstillDigest
    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.catalogue.digest import Digest
    from ros2_memory.catalogue.map_digest import MapDigest
    from ros2_memory.catalogue.topic_digest import TopicDigest
    from ros2_memory.config import Settings
    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.history.context import Memory

_MAX_MS = 10.0


def digesting(memory: Memory) -> Callable[[Path], Digest]:
    """Returns what digests the bags of a memory as the server does, but stores nothing."""
    digester = build_digester(memory)
    view = View(memory, Call())
    statics, bags = BagStatics(view), {each.path: each for each in view.snapshot.bags}
    return lambda path: digester.digest(path, statics.of(bags[path]))


def made_known(memory: Memory, settings: Settings) -> None:
    """Has the memory's catalogue know every bag, as `ros2-memory index` does."""
    fill_catalogue(build_backfill(settings, memory))


def cost(case: Case, runs: int) -> Figure:
    """The processor time of digesting one bag that was not read before, as a median."""
    spent = []
    for _ in range(runs):
        unread = ours.forgetful(case.memory, case.settings, case.splits[0], ODOM.name)
        digest = digesting(unread)
        # The first one compiles the other topics' decoders, as it does once in a server's life.
        for nth, (split, _) in enumerate(case.moments(10)):
            begun = time.process_time()
            digest(split.path)
            if nth:
                spent.append(time.process_time() - begun)
    words = "processor time of digesting one fresh bag"
    return Figure("digest", words, statistics.median(spent) * 1e3, "ms", _MAX_MS)


def moved(digest: Digest, by: int) -> Digest:
    """The digest of the same bag recorded so many nanoseconds later; whole hours keep it exact."""
    return replace(
        digest,
        summary=_moved_summary(digest.summary, by),
        topics=tuple(_moved_topic(each, by) for each in digest.topics),
        in_map=None if digest.in_map is None else _moved_map(digest.in_map, by),
    )


def _moved_map(digest: MapDigest, by: int) -> MapDigest:
    sights = decode_sights(digest.sights)
    times = ((Spot.FIRST, Spot.LAST), (Look.FIRST, Look.LAST), (Unplaced.FIRST, Unplaced.LAST))
    for table, columns in zip((sights.spots, sights.looks, sights.unplaced), times, strict=True):
        table[:, columns] += by
    track = replace(digest.track, times=digest.track.times + by)
    return replace(digest, track=track, sights=encode_sights(sights))


def _moved_summary(summary: BagSummary, by: int) -> BagSummary:
    topics = (replace(each, first=each.first + by, last=each.last + by) for each in summary.topics)
    return summary.replaced(topics=tuple(topics))


def _moved_topic(topic: TopicDigest, by: int) -> TopicDigest:
    edges, kept = topic.edges, topic.kept
    if edges is not None and edges.first_stamp is not None and edges.last_stamp is not None:
        edges = replace(edges, first_stamp=edges.first_stamp + by, last_stamp=edges.last_stamp + by)
    if kept is not None:
        kept = tuple(
            each._replace(log_time=each.log_time + by, publish_time=each.publish_time + by)
            for each in kept
        )
    poses = None if topic.poses is None else _moved_poses(topic.poses, by)
    standstills = None if topic.standstills is None else _moved_standstills(topic.standstills, by)
    events = None if topic.events is None else _moved_events(topic.events, by)
    return replace(
        topic, poses=poses, standstills=standstills, events=events, edges=edges, kept=kept
    )


def _moved_standstills(digest: StandstillDigest, by: int) -> StandstillDigest:
    def later(moment: int | None) -> int | None:
        return None if moment is None else moment + by

    return replace(
        digest,
        head=encode_positions(_later(decode_positions(digest.head), by)),
        head_until=digest.head_until + by,
        tail=encode_positions(_later(decode_positions(digest.tail), by)),
        tail_since=digest.tail_since + by,
        chains=tuple(
            ChainDigest(
                later(each.start),
                later(each.end),
                encode_blocks(
                    block._replace(
                        number=block.number + by // BLOCK_NS,
                        first=block.first + by,
                        last=block.last + by,
                    )
                    for block in decode_blocks(each.blocks)
                ),
            )
            for each in digest.chains
        ),
    )


def _later(poses: list[TimedPosition], by: int) -> list[TimedPosition]:
    return [pose._replace(time=pose.time + by) for pose in poses]


def _moved_events(story: TopicEvents, by: int) -> TopicEvents:
    return replace(
        story,
        first=story.first + by,
        last=story.last + by,
        visible=story.visible._replace(rows=moved_rows(story.visible.rows, by)),
        known=tuple(each._replace(at=each.at + by) for each in story.known),
        toggles=tuple(each._replace(time=each.time + by) for each in story.toggles),
        errors=tuple(
            each._replace(first=each.first + by, last=each.last + by) for each in story.errors
        ),
    )


def _moved_poses(poses: PoseDigest, by: int) -> PoseDigest:
    def later(stop: TimedPosition) -> TimedPosition:
        return stop._replace(time=stop.time + by)

    def leg(one: Leg | None) -> Leg | None:
        return one and one._replace(first=later(one.first), last=later(one.last))

    totals = replace(
        poses.totals,
        head=leg(poses.totals.head),
        tail=leg(poses.totals.tail),
        resets=tuple(moment + by for moment in poses.totals.resets),
    )
    return replace(
        poses,
        totals=totals,
        vertices=tuple((moment + by, place, turn) for moment, place, turn in poses.vertices),
    )
