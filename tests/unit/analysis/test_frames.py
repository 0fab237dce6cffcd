"""Frames in a target frame: tf2's rules, at one time and at many."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp  # type: ignore[import-untyped]

from ros2_memory.analysis.frames import HOLD_NS, TF_CACHE_NS, FrameTree, edges_of
from ros2_memory.core.errors import NoDataError, NoDataReason
from ros2_memory.core.model import StampedTransform, Transform
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, NS_PER_S, ns_from_unix
from tests.support.strategies import transforms

S = NS_PER_S
IDENTITY = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def edge(
    parent: str,
    child: str,
    time: int,
    transform: Transform | float = IDENTITY,
    *,
    static: bool = False,
) -> StampedTransform:
    """An edge stamped at `time`; a number stands for a shift along x."""
    held = transform
    if not isinstance(held, Transform):
        held = Transform((held, 0.0, 0.0), IDENTITY.rotation)
    return StampedTransform(parent, child, time, time, held, static)


@dataclass(frozen=True)
class Tree:
    """Transforms in any order, looked up as for one moment: nothing holds on."""

    transforms: Sequence[StampedTransform]

    def frames(self, target: str, hold_ns: int = AT_OR_BEFORE_SLACK_NS) -> FrameTree:
        static = sorted((e for e in self.transforms if e.static), key=lambda e: e.log_time)
        moving = edges_of(e for e in self.transforms if not e.static)
        return FrameTree(static, moving, target, "stamp", hold_ns)

    def lookup(self, parent: str, child: str, time: int) -> Transform:
        return self.frames(parent).lookup(child, time)


def shift(tree: Tree, parent: str, child: str, time: int) -> float:
    return tree.lookup(parent, child, time).translation[0]


def refusal(tree: Tree, parent: str, child: str, time: int) -> NoDataError:
    with pytest.raises(NoDataError) as refused:
        tree.lookup(parent, child, time)
    return refused.value


def moving(child: str = "base", parent: str = "odom") -> list[StampedTransform]:
    """One metre a second along x, at 100 to 105 s."""
    return [edge(parent, child, (100 + i) * S, float(i)) for i in range(6)]


# Composition


@st.composite
def trees(draw: st.DrawFn) -> list[StampedTransform]:
    """A random tree of static edges: the parent of frame i is some earlier frame."""
    count = draw(st.integers(2, 8))
    return [
        edge(f"f{draw(st.integers(0, i - 1))}", f"f{i}", 0, draw(transforms), static=True)
        for i in range(1, count)
    ]


def matrix(t: Transform) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    homogeneous = np.eye(4)
    homogeneous[:3, :3] = Rotation.from_quat(t.rotation).as_matrix()
    homogeneous[:3, 3] = t.translation
    return homogeneous


@given(trees(), st.data())
def test_a_lookup_is_the_product_of_the_matrices_on_the_way(
    tree: list[StampedTransform], data: st.DataObject
) -> None:
    in_root = {"f0": np.eye(4)}
    for held in tree:
        in_root[held.child] = in_root[held.parent] @ matrix(held.transform)
    names = st.sampled_from(sorted(in_root))
    parent, child = data.draw(names), data.draw(names)
    found = Tree(tree).lookup(parent, child, 5)
    assert np.allclose(matrix(found), np.linalg.inv(in_root[parent]) @ in_root[child], atol=1e-7)


# Interpolation


@given(transforms, transforms, st.integers(0, TF_CACHE_NS))
def test_between_two_messages_translation_is_linear_and_rotation_slerp(
    first: Transform, second: Transform, after: int
) -> None:
    start = 1_700_000_000 * S
    tree = Tree([edge("a", "b", start, first), edge("a", "b", start + TF_CACHE_NS, second)])
    found = tree.lookup("a", "b", start + after)
    ratio = after / TF_CACHE_NS
    ends = Rotation.from_quat([first.rotation, second.rotation])
    line = np.array(first.translation) * (1 - ratio) + np.array(second.translation) * ratio
    assert found.translation == pytest.approx(tuple(line), abs=1e-8)
    if (ends[0].inv() * ends[1]).magnitude() < math.pi - 1e-3:
        expected = Slerp([0, 1], ends)(ratio)
        assert (Rotation.from_quat(found.rotation).inv() * expected).magnitude() < 1e-6


# Parents that change


@pytest.mark.parametrize("static", [True, False])
def test_a_loop_is_an_answer_and_not_an_endless_walk(static: bool) -> None:
    tree = Tree(
        [
            edge("b", "a", 5, 1.0, static=static),
            edge("c", "b", 5, 1.0, static=static),
            edge("b", "c", 5, 1.0, static=static),
            edge("other", "thing", 5, static=static),
        ]
    )
    assert refusal(tree, "thing", "a", 5).reason is NoDataReason.FRAMES_NOT_CONNECTED
    assert shift(tree, "b", "a", 5) == 1.0


def test_a_child_published_both_ways_is_dynamic_where_its_messages_reach() -> None:
    tree = Tree([edge("odom", "base", 0, 9.0, static=True), *moving()])
    assert shift(tree, "odom", "base", 102 * S) == 2.0
    assert shift(tree, "odom", "base", 99 * S) == 9.0


# Refusals


LINKS = Tree([edge("odom", "base_link", 5), edge("base_link", "robot1/camera", 5)])
ARMS = Tree([edge("map", f"{arm}base_link", 5) for arm in ("arm/", "back/", "cart/", "")])
WHEELS = Tree([edge("odom", f"wheel_{i:02}", 5) for i in range(30)])
TWO_TREES = Tree([*moving(), edge("map", "goal", 5), edge("goal", "tip", 5)])
IN_MAP = Tree([*moving(), edge("map", "odom", 0, static=True)])
GAP = Tree([edge("odom", "base", 100 * S, 1.0), edge("odom", "base", 111 * S, 2.0)])
LENT = Tree([*(edge("a", "cup", at * S) for at in (10, 12)), edge("b", "cup", 14 * S)])
HANDED = Tree([edge("a", "cup", 0), edge("b", "cup", 20 * S), edge("c", "cup", 21 * S)])
PICKED_UP = Tree(
    [
        *(edge("map", name, 0, static=True) for name in ("table", "gripper")),
        *(edge("table", "cup", at * S) for at in (10, 12)),
        *(edge("gripper", "cup", at * S) for at in (14, 16)),
    ]
)
LOCALISED = Tree(
    [
        *(edge("map", "odom", at * S) for at in range(1, 30)),
        *(edge("a", "base", at * S) for at in range(1, 11)),
        *(edge("map", "base", at * S) for at in range(11, 30)),
    ]
)
MAST = Tree(
    [
        *(edge("odom", "base", at * S) for at in (10, 12)),
        *(edge("base", "camera", at * S) for at in range(20)),
        *(edge("base", "laser", at * S) for at in (60, 61)),
    ]
)
UNKNOWN, OUTSIDE = NoDataReason.FRAME_UNKNOWN, NoDataReason.OUTSIDE_RANGE
APART = NoDataReason.FRAMES_NOT_CONNECTED
RANGE = "100.000000 to 105.000000 (Unix seconds)"


@pytest.mark.parametrize(
    ("tree", "asked", "time", "reason", "said"),
    [
        (LINKS, ("odom", "bas_link"), 5, UNKNOWN, "'bas_link'; similar: base_link"),
        (LINKS, ("Camera", "odom"), 5, UNKNOWN, "robot1/camera"),
        (ARMS, ("Base_Link", "map"), 5, UNKNOWN, "similar: base_link, arm/base_link"),
        (Tree(moving()), ("odom", "zzz"), 5, UNKNOWN, "there are: base, odom"),
        (WHEELS, ("odom", "zzz"), 5, UNKNOWN, "and 19 more"),
        (Tree(moving()), ("x", "x"), 5, UNKNOWN, "'x'"),
        (Tree([]), ("odom", "base"), 5, UNKNOWN, "no transforms are recorded"),
        (
            TWO_TREES,
            ("tip", "base"),
            102 * S,
            APART,
            "'tip' is in the tree of 'map', 'base' in that of 'odom'",
        ),
        # They are connected later; the roots are those of that time.
        (LENT, ("b", "cup"), 11 * S, APART, "were not connected at 11.000000"),
        (LOCALISED, ("odom", "base"), 5 * S, APART, "their roots were 'map' and 'a';"),
        # Nothing is extrapolated, and the range of the edge is named.
        *(
            (IN_MAP, asked, time, OUTSIDE, f"{RANGE}, {off} the time asked")
            for asked in (("map", "base"), ("base", "map"))
            for time, off in ((90 * S, "10.000 s after"), (107 * S, "2.000 s before"))
        ),
        (IN_MAP, ("map", "base"), 90 * S, OUTSIDE, "no transform of 'base' in 'odom'"),
        (Tree(moving()[:1]), ("odom", "base"), 106 * S, OUTSIDE, "only at 100.000000"),
        (
            GAP,
            ("odom", "base"),
            104 * S,
            NoDataReason.GAP,
            "100.000000 (4.000 s before) and 111.000000 (7.000 s after)",
        ),
        # The parent is that of the nearest message.
        (PICKED_UP, ("map", "cup"), 9 * S, OUTSIDE, "of 'cup' in 'table' at 9.0"),
        (PICKED_UP, ("map", "cup"), 17 * S, OUTSIDE, "of 'cup' in 'gripper' at 17.0"),
        (HANDED, ("a", "cup"), 5 * S, NoDataReason.GAP, "of 'cup' in 'a' at 5.0"),
        # What is above both frames is not asked for.
        (MAST, ("camera", "laser"), 61 * S, OUTSIDE, "of 'camera' in 'base' at 61.0"),
    ],
    ids=count(),
)
def test_a_refusal_says_why_and_what_to_ask(
    tree: Tree, asked: tuple[str, str], time: int, reason: NoDataReason, said: str
) -> None:
    refused = refusal(tree, *asked, time)
    assert refused.reason is reason
    assert said in refused.detail


@given(st.integers(1_600_000_000 * S, 1_800_000_000 * S), st.integers(11 * S, 10**6 * S))
def test_every_time_that_a_refusal_offers_can_be_asked(first: int, width: int) -> None:
    tree = Tree([edge("odom", "base", first), edge("odom", "base", first + width)])
    for asked in (first - 60 * S, first + width // 2, first + width + 60 * S):
        detail = refusal(tree, "odom", "base", asked).detail
        offered = [float(text) for text in re.findall(r"\d{10}\.\d{6}", detail)]
        assert len(offered) == 3  # the time asked, and both of those offered
        for seconds in offered[1:]:
            assert tree.lookup("odom", "base", ns_from_unix(seconds)) == IDENTITY


# Many times at once


def held(tree: Tree, target: str, source: str, times: Sequence[int]) -> list[float | None]:
    """How far along x a frame is at some times; None where it is not known."""
    poses = tree.frames(target, HOLD_NS).poses(source, np.array(times, np.int64))
    assert poses is not None
    places = zip(poses.translation[0].tolist(), poses.valid.tolist(), strict=True)
    return [x if valid else None for x, valid in places]


@pytest.mark.parametrize("parents", [("map", "map"), ("map", "earth")])
def test_a_transform_of_a_track_holds_a_little_into_a_gap(parents: tuple[str, str]) -> None:
    ends = [edge(parent, "odom", at * S, at) for parent, at in zip(parents, (10, 22), strict=True)]
    tree = Tree([*ends, edge("map", "earth", 0, 100.0, static=True)])
    last = 22.0 if parents[1] == "map" else 122.0
    times = [at * S for at in (12, 13, 19, 20)]
    assert held(tree, "map", "odom", times) == [10.0, None, None, last]
