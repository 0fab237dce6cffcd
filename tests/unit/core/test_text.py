from fnmatch import fnmatchcase

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.text import abbreviate, caseless, match_topics
from tests.support.hostile_arguments import DEEP, nested, values

globs = st.text(st.sampled_from("/ab*?[]!-AB\n"), max_size=12)
names = st.lists(st.text(st.sampled_from("/abAB\n"), max_size=12), max_size=8)


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ([1, {"a": "b"}], '[1, {"a": "b"}]'),
        (nested(DEEP), '[[["…"]]]'),
        ([[[[], {}, [0]]]], '[[[[], {}, "…"]]]'),
        (nested(DEEP, kind="object"), '{"x": {"x": {"x": "…"}}}'),
        (list(range(100)), '[0, 1, 2, 3, 4, 5, 6, 7, "…"]'),
        (10**4000, '"a number of 4000 digits"'),
        ("\ud800", '"\\ud800"'),
        ("a\x00b", '"a\\u0000b"'),
        (object(), '"a object"'),
    ],
)
def test_a_value_is_shown_in_a_few_words(value: object, shown: str) -> None:
    assert abbreviate(value) == shown


@given(value=values)
def test_nothing_is_shown_longer_than_asked_or_as_something_that_is_not_text(value: object) -> None:
    shown = abbreviate(value, 60)
    assert len(shown) <= 60
    shown.encode()


@given(names=names, glob=globs)
def test_a_glob_matches_what_it_matches_in_a_shell(names: list[str], glob: str) -> None:
    assert match_topics(names, glob) == [
        name for name in names if name == glob or fnmatchcase(name, glob)
    ]


def test_a_glob_of_many_stars_takes_no_long_search() -> None:
    assert match_topics(["/" + "a" * 200, "/b"], "*a" * 200 + "*") == ["/" + "a" * 200]
    assert match_topics(["a" * 250], "*a" * 249 + "*b") == []


def test_escapes_of_a_string_that_does_not_end_take_no_long_search() -> None:
    hostile = '{"' + '\\"' * 200_000
    assert caseless(hostile) == hostile
    assert caseless(f'["\\u00c4", {hostile}') == f'["a", {hostile}'
