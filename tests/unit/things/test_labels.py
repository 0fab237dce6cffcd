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
    assert Labels({}).key(one) == Labels({}).key(other)


@pytest.mark.parametrize(
    ("key", "moves"), [("dog", True), ("small dog", True), ("hot dog", False), ("dog bed", False)]
)
def test_people_and_pets_move_by_themselves_and_food_does_not(key: str, *, moves: bool) -> None:
    assert moves_by_itself(key) == moves
