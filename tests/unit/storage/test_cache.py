from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.storage.base import Channel, Schema
from ros2_memory.storage.cache import ByteLru, shared


def test_what_was_used_last_is_kept() -> None:
    cache: ByteLru[str] = ByteLru(10)
    cache.put("a", "A", 4)
    cache.put("b", "B", 4)
    assert cache.get("a") == "A"
    cache.put("c", "C", 4)
    assert (cache.get("a"), cache.get("b"), cache.get("c")) == ("A", None, "C")


def test_a_replaced_value_counts_once() -> None:
    cache: ByteLru[str] = ByteLru(10)
    cache.put("a", "old", 6)
    cache.put("a", "new", 8)
    cache.put("b", "small", 2)
    assert (cache.get("a"), cache.get("b")) == ("new", "small")
    cache.put("a", "too large", 11)
    cache.put("c", "large", 8)
    assert [cache.get(key) for key in "abc"] == [None, "small", "large"]


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 15))))
def test_what_is_cached_never_passes_the_bound(puts: list[tuple[int, int]]) -> None:
    cache: ByteLru[int] = ByteLru(20)
    for key, size in puts:
        cache.put(key, size, size)
        assert sum(cache.get(each) or 0 for each in range(6)) <= 20


def channel(topic: str, text: bytes = b"") -> Channel:
    return Channel(topic, "cdr", Schema("a/msg/A", "ros2msg", text))


def test_equal_channels_become_one() -> None:
    first = shared(channel("/a"))
    assert shared(channel("/a")) is first
    assert shared(channel("/b")) == channel("/b")


def test_caches_apart_share_a_capacity_and_no_key() -> None:
    cache: ByteLru[str] = ByteLru(10)
    one, other = cache.namespace(), cache.namespace()
    one.put("a", "one's", 6)
    assert (one.get("a"), other.get("a"), cache.get("a")) == ("one's", None, None)
    other.put("a", "other's", 6)
    assert (one.get("a"), other.get("a")) == (None, "other's")
