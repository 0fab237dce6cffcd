"""What is told of a topic over a window: where the robot stood, and what came, went and flipped.

Whole bags by what is kept of them, the others message by message; see `portions`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.errors import UndecodableError
from ros2_memory.motion import is_place
from ros2_memory.packing import packed_rests, packed_story, unpacked_rests, unpacked_story
from ros2_memory.portions import Kept, Kind, is_whole
from ros2_memory.rests import RestBuilder, RestCollector, RestDigest
from ros2_memory.sights import Sights
from ros2_memory.stories import MOST_TOLD, QUIET, Story, StoryBuilder, state_of
from ros2_memory.ways import add_poses

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ros2_memory.copies import Found
    from ros2_memory.history import View
    from ros2_memory.model import Pose, TimeWindow
    from ros2_memory.rests import Rest
    from ros2_memory.timebase import Ns

_RESTS: Final = Kind(
    "rests",
    ask=lambda notes, topic, among: notes.rests(topic, among),
    packed=lambda digest: packed_rests(digest).hex(),
    unpacked=lambda text: unpacked_rests(bytes.fromhex(text)),
)
_STORIES: Final = Kind(
    "story",
    ask=lambda notes, topic, among: notes.stories(topic, among),
    packed=lambda story: "" if story is None else packed_story(story).hex(),
    unpacked=lambda text: unpacked_story(bytes.fromhex(text)) if text else None,
)


class _Standing:
    """Takes poses for what only asks where they are."""

    def __init__(self, to: RestBuilder | RestCollector) -> None:
        self._to = to

    def add(self, time: Ns, pose: Pose, _speed_mps: float | None = None) -> None:
        """Takes the next pose, if it is one."""
        if is_place(pose.position):
            self._to.add(time, pose.position)


def rests_in(view: View, topic: str, window: TimeWindow) -> tuple[Rest, ...]:
    """Where the poses of a topic stand still in a window, in order.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
    """
    builder = RestBuilder()
    kept: Kept[RestDigest] = Kept(view, topic, _RESTS, window)
    sights = Sights(view.memory.reader, view.memory.extractor)
    for group in view.groups(topic, window):
        failures: list[UndecodableError] = []
        if not is_whole(group, window):
            add_poses(view, _Standing(builder), sights, group.once(), failures)
        elif (known := kept.of(group)) is not None:
            builder.join(known[0])
        else:
            collector = RestCollector()
            span = add_poses(view, _Standing(collector), sights, group.once(), failures)
            digest = collector.digest()
            if digest is not None:
                builder.join(digest)
                if span is not None and not failures:
                    kept.keep(group, digest, span)
    return builder.rests()


def story_in(view: View, topic: str, window: TimeWindow) -> Story | None:
    """What the messages of a topic say in a window; None where there is no message."""
    builder = StoryBuilder()
    kept: Kept[Story | None] = Kept(view, topic, _STORIES, window)
    for group in view.groups(topic, window):
        if not is_whole(group, window):
            _hear(view, builder, group.once())
            continue
        known = kept.of(group)
        if known is None:
            collector = StoryBuilder()
            _hear(view, collector, group.once())
            story = collector.story(MOST_TOLD)
            if story is not None:
                kept.keep(group, story, (story.first, story.last))
        else:
            story, span = known
            story = Story(*span) if story is QUIET else story
        if story is not None:
            builder.join(story)
    return builder.story()


def _hear(view: View, builder: StoryBuilder, messages: Iterable[Found]) -> None:
    """Adds what messages say."""
    for found in messages:
        channel = found.record.channel
        try:
            message = view.memory.reader.decode(found.record)
        except UndecodableError:
            builder.miss()
            continue
        value = view.memory.extractor.exact(message, channel.type)
        builder.add(found.time, state_of(value, channel.type))
