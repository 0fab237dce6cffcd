from __future__ import annotations

import pytest

from ros2_memory.things.labels import Labels, moves_by_itself


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("mug", "Mug"),
        ("mug", "mugs"),
        ("Potted_Plant", "potted plants"),
        ("cell-phone", " cell  phone "),
        ("dish", "dishes"),
        ("box", "boxes"),
        ("battery", "batteries"),
        ("person", "People"),
        ("bookshelf", "bookshelves"),
        ("potato", "potatoes"),
        ("glass", "glasses"),
        ("banana", "bananas"),
        ("photo", "photos"),
        ("cookie", "Cookies"),
        ("bus", "buses"),
        ("caf\u00e9", "cafe\u0301"),
    ],
)
def test_case_spacing_and_a_plural_do_not_matter(one: str, other: str) -> None:
    assert Labels().key(one) == Labels().key(other)


@pytest.mark.parametrize(
    ("one", "other"),
    [("mug", "cup"), ("phone", "headphones"), ("bus", "bu"), ("gas", "ga"), ("lens", "len")],
)
def test_other_words_are_other_labels(one: str, other: str) -> None:
    assert Labels().key(one) != Labels().key(other)


@pytest.mark.parametrize(
    ("key", "moves"), [("dog", True), ("small dog", True), ("hot dog", False), ("dog bed", False)]
)
def test_people_and_pets_move_by_themselves_and_food_does_not(key: str, *, moves: bool) -> None:
    assert moves_by_itself(key) == moves


def test_declared_spellings_are_one_label_in_any_case_and_number() -> None:
    labels = Labels({"Mug": ["coffee mug", "beaker"]})
    assert {labels.key(each) for each in ("mug", "COFFEE_MUGS", "beakers", "Mugs")} == {"mug"}
    assert labels.name("mug", {"coffee mug": 9}) == "Mug"


def test_the_name_shown_is_the_singular_where_it_was_seen_else_the_commonest() -> None:
    assert Labels().name("chair", {"chairs": 9, "Chair": 1}) == "chair"
    assert Labels().name("headphone", {"headphones": 3, "Headphones": 4}) == "headphones"
    assert Labels().name("chair", {}) == "chair"
