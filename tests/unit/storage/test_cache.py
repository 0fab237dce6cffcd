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


def test_thousands_of_small_values_take_room_for_their_keys() -> None:
    cache: ByteLru[int] = ByteLru(100_000)
    for key in range(10_000):
        cache.put(key, key, 1)
    assert sum(cache.get(key) is not None for key in range(10_000)) < 1000
