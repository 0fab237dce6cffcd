from __future__ import annotations

from fnmatch import fnmatchcase

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.globs import match_topics

globs = st.text(st.sampled_from("/ab*?[]!-AB\n"), max_size=12)
names = st.lists(st.text(st.sampled_from("/abAB\n"), max_size=12), max_size=8)


@given(names=names, glob=globs)
def test_a_glob_matches_what_it_matches_in_a_shell(names: list[str], glob: str) -> None:
    assert match_topics(names, glob) == [name for name in names if fnmatchcase(name, glob)]


def test_a_glob_of_many_stars_takes_no_long_search() -> None:
    assert match_topics(["/" + "a" * 200, "/b"], "*a" * 200 + "*") == ["/" + "a" * 200]
    assert match_topics(["a" * 250], "*a" * 249 + "*b") == []
