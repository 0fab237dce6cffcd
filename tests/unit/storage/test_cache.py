from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.storage.cache import ByteLru


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 15))))
def test_what_is_cached_never_passes_the_bound(puts: list[tuple[int, int]]) -> None:
    cache: ByteLru[int] = ByteLru(20)
    for key, size in puts:
        cache.put(key, size, size)
        assert sum(cache.get(each) or 0 for each in range(6)) <= 20


def test_caches_apart_share_a_capacity_and_no_key() -> None:
    cache: ByteLru[str] = ByteLru(10)
    one, other = cache.namespace(), cache.namespace()
    one.put("a", "one's", 6)
    assert (one.get("a"), other.get("a"), cache.get("a")) == ("one's", None, None)
    other.put("a", "other's", 6)
    assert (one.get("a"), other.get("a")) == (None, "other's")
