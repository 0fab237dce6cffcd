from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.storage.cache import ByteLru


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 15_000))))
def test_what_is_cached_never_passes_the_bound(puts: list[tuple[int, int]]) -> None:
    cache: ByteLru[int] = ByteLru(20_000)
    for key, size in puts:
        cache.put(key, size, size)
        assert sum(cache.get(each) or 0 for each in range(6)) <= 20_000


def test_caches_apart_share_a_capacity_and_no_key() -> None:
    cache: ByteLru[str] = ByteLru(10_500)
    one, other = cache.namespace(), cache.namespace()
    one.put("a", "one's", 6000)
    assert (one.get("a"), other.get("a"), cache.get("a")) == ("one's", None, None)
    other.put("a", "other's", 6000)
    assert (one.get("a"), other.get("a")) == (None, "other's")


def test_most_of_a_circle_that_is_a_little_larger_than_the_cache_is_found() -> None:
    cache: ByteLru[int] = ByteLru(100_000)
    found = 0
    for key in [*range(110)] * 4:
        if cache.get(key) is None:
            cache.put(key, key, 800)
        else:
            found += 1
    assert found > 3 * 110 * 0.6


def test_thousands_of_small_values_take_room_for_their_keys() -> None:
    cache: ByteLru[int] = ByteLru(100_000)
    for key in range(10_000):
        cache.put(key, key, 1)
    assert sum(cache.get(key) is not None for key in range(10_000)) < 1000
