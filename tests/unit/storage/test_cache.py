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
