"""Canonical labels: one name for what detectors call `Mug`, `mugs` and `coffee_mug`.

Case, spacing (also `_` and `-`) and a simple English plural are of no matter; other spellings are
declared by the owner.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import TYPE_CHECKING, Final

from ros2_memory.core.text import MAX_LABEL_CHARS, caseless, shortened

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

_SPACING: Final = re.compile(r"[\s_\-]+")
_IRREGULAR: Final = {
    "people": "person",
    "men": "man",
    "women": "woman",
    "children": "child",
    "mice": "mouse",
    "geese": "goose",
    "feet": "foot",
    "teeth": "tooth",
    "knives": "knife",
    "shelves": "shelf",
    "loaves": "loaf",
    "leaves": "leaf",
    "scarves": "scarf",
    "wolves": "wolf",
    "bookshelves": "bookshelf",
    "buses": "bus",
    "gases": "gas",
    "lenses": "lens",
    "canvases": "canvas",
    "cookies": "cookie",
    "brownies": "brownie",
    "smoothies": "smoothie",
    "hoodies": "hoodie",
    "movies": "movie",
    **{word: word for word in ("gas", "canvas", "atlas", "christmas", "chaos", "thermos", "lens")},
}
_NO_SINGULARS: Final = (
    "binoculars",
    "clothes",
    "earphones",
    "goggles",
    "headphones",
    "jeans",
    "leggings",
    "pants",
    "pliers",
    "scissors",
    "shears",
    "shorts",
    "sunglasses",
    "tongs",
    "trousers",
    "tweezers",
)
"""Names of one thing in the plural: nobody asks for a scissor."""
_MOVES_BY_ITSELF: Final = frozenset(
    {
        "person",
        "human",
        "pedestrian",
        "man",
        "woman",
        "child",
        "boy",
        "girl",
        "baby",
        "dog",
        "cat",
        "pet",
        "bird",
        "boar",
        "cattle",
        "cow",
        "deer",
        "diver",
        "fish",
        "fish school",
        "fox",
        "goat",
        "horse",
        "sheep",
        "shoal",
        "swimmer",
        "wolf",
    }
)
_NO_ANIMALS: Final = frozenset({"hot dog", "corn dog", "rocking horse"})
"""Keys that end in a word for an animal, and name a thing."""
STATES: Final = frozenset(
    {
        "ajar",
        "closed",
        "down",
        "empty",
        "full",
        "locked",
        "off",
        "on",
        "open",
        "opened",
        "shut",
        "unlocked",
        "up",
    }
)
"""Last words of labels that say how a thing is: "door open"."""
_NO_PLURALS: Final = ("ss", "us", "is")
_SIBILANTS: Final = ("sses", "shes", "ches", "xes", "zzes")


def plain(label: str) -> str:
    """Returns a label without case and accents, with single spaces."""
    return caseless(_SPACING.sub(" ", label).strip())


def singular(label: str) -> str:
    """Returns a label as `plain`, with its last word in the singular by simple English rules."""
    before, space, word = plain(label).rpartition(" ")
    return before + space + _singular(word)


def last_word(key: str) -> str:
    """Returns the kind that a key names: "mug" for "coffee mug"."""
    return key.rpartition(" ")[2]


def unspaced(key: str) -> str:
    """Returns a key as one word: "forklift" for "fork lift"."""
    return key.replace(" ", "")


def moves_by_itself(key: str) -> bool:
    """Returns whether a key names people, pets, or animals of fields, woods and waters."""
    return key not in _NO_ANIMALS and not _MOVES_BY_ITSELF.isdisjoint((key, last_word(key)))


def _singular(word: str) -> str:
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if len(word) > 4 and word.endswith("ies"):
        return word[:-3] + "y"
    if word.endswith(_SIBILANTS) or (len(word) > 5 and word.endswith("oes")):
        return word[:-2]
    if len(word) > 3 and word.endswith("s") and not word.endswith(_NO_PLURALS):
        return word[:-1]
    return word


_PLURALS: Final = {_singular(word): word for word in _NO_SINGULARS}


def _key_of(label: str) -> str:
    """Returns a label as `singular`, but in the plural if that names one thing."""
    before, space, word = singular(label).rpartition(" ")
    return before + space + _PLURALS.get(word, word)


class Labels:
    """Maps labels as detectors write them to keys, which are equal for equal things.

    Args:
        spellings: other spellings of each name to show.
    """

    def __init__(self, spellings: Mapping[str, Iterable[str]]) -> None:
        self._keys: dict[str, str] = {}
        self._shown: dict[str, str] = {}
        for name, variants in spellings.items():
            key = _key_of(name)
            self._shown[key] = name
            for spelling in (name, *variants):
                self._keys[_key_of(spelling)] = key

    def key(self, label: str) -> str:
        """Returns the key of a label as a detector writes it."""
        plain_key = _key_of(shortened(label, MAX_LABEL_CHARS))
        return self._keys.get(plain_key, plain_key)

    def one_spelling(self, counts: Mapping[str, float]) -> Callable[[str], str]:
        """Returns what maps a label, or its key, to the spelling that `counts` has most often."""
        by_count = sorted(counts, key=lambda label: (counts[label], label))
        names = {self.key(label): label for label in by_count}
        return lambda label: names.get(self.key(label), label)

    def are_apart(self, one: str, other: str) -> bool:
        """Returns whether the owner declared two keys as different things."""
        return one in self._shown and other in self._shown

    def name(self, key: str, counts: Mapping[str, int]) -> str:
        """Returns the name to show for a key: as declared, or the plain label seen most often."""
        declared = self._shown.get(key)
        if declared is not None or not counts:
            return declared or key
        by_name = Counter[str]()
        for label, count in counts.items():
            by_name[plain(label)] += count
        # A plural is not what one thing is called, unless no detector writes anything else.
        return min(by_name, key=lambda name: (name != key, -by_name[name], name))
