"""What is installed with this package: its licences, and how far its versions may move."""

from __future__ import annotations

import tomllib
from email.message import Message
from importlib.metadata import distribution, version
from importlib.util import find_spec
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from tests.project.licences import UnknownLicenceError, closure, permitted, said, stated

PROJECT = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text())
RUNTIME = [Requirement(line) for line in PROJECT["project"]["dependencies"]]
ELSEWHERE = frozenset() if find_spec("daft") else frozenset({"ray"})
"""Extras that no environment of development needs: a cluster's engine of hundreds of megabytes."""
EXTRAS = {
    extra: [Requirement(line) for line in lines]
    for extra, lines in PROJECT["project"]["optional-dependencies"].items()
    if extra not in ELSEWHERE
}
PERMISSIVE = frozenset(
    {
        "0BSD",
        "Apache-2.0",
        "BSD-2-Clause",
        "BSD-3-Clause",
        "CC0-1.0",
        "ISC",
        "MIT",
        "MIT-0",
        "MIT-CMU",
        "PSF-2.0",
        "Zlib",
    }
)
"""What may be shipped with a product, closed ones included, for no more than a notice."""
TOOLS = PERMISSIVE | {"MPL-2.0"}
"""Tools are shipped to nobody, and what MPL-2.0 asks for concerns changed files of theirs alone."""
UNCHANGED = {
    # Mozilla's list of certificates, which its licence has nobody open more than.
    "certifi": "MPL-2.0",
    # Progress bars, of which some files are under either.
    "tqdm": "MPL-2.0 AND MIT",
}
"""What comes along with an extra: shipped unchanged, it requires its notice alone."""
READ_BY_HAND = {
    # Its LICENSE file: any licence that the Open Source Initiative approved, at one's choice.
    "apsw": "any-OSI",
    # Its metadata says nothing; its LICENSE file is Apache-2.0.
    "daft": "",
}


def refused(names: set[str], allowed: frozenset[str]) -> dict[str, str]:
    """The packages that may not be here, with what they say of their licence."""
    found = {}
    for name in sorted(names):
        metadata = distribution(name).metadata
        if said(metadata, "License") == READ_BY_HAND.get(name):
            continue
        try:
            expression = stated(metadata)
        except UnknownLicenceError as error:
            found[name] = str(error)
            continue
        if not permitted(expression, allowed):
            found[name] = expression
    return found


def saying(**fields: str | list[str]) -> Message:
    """Metadata of a package: fields as keywords, `License_Expression="MIT"`."""
    metadata = Message()
    for name, values in fields.items():
        for value in [values] if isinstance(values, str) else values:
            metadata[name.replace("_", "-")] = value
    return metadata


class TestLicences:
    def test_whatever_is_installed_with_this_package_is_permissive(self) -> None:
        assert refused(closure(["ros2-memory"]), PERMISSIVE) == {}

    @pytest.mark.parametrize("extra", EXTRAS)
    def test_whatever_an_extra_installs_is_too_but_for_what_stays_unchanged(
        self, extra: str
    ) -> None:
        found = refused(closure([str(each) for each in EXTRAS[extra]]), PERMISSIVE)
        assert found.items() <= UNCHANGED.items()

    def test_the_tools_of_development_are_too_or_ask_for_nothing_of_the_product(self) -> None:
        tools = closure(PROJECT["dependency-groups"]["dev"])
        assert refused(tools, TOOLS) == {}

    def test_dependencies_of_dependencies_and_of_their_extras_are_among_them(self) -> None:
        names = closure(["ros2-memory"])
        assert {requirement.name for requirement in RUNTIME} <= names
        assert {"antlr4-python3-runtime", "pydantic-core", "ros2-memory", "ruamel-yaml"} <= names
        assert "cachecontrol" in closure(["pip-audit"])
        assert "msgpack" in closure(["CacheControl"])
        assert "filelock" not in closure(["CacheControl"])
        assert "filelock" in closure(["CacheControl[filecache]"])

    @pytest.mark.parametrize(
        "metadata",
        [
            saying(License_Expression="GPL-3.0-or-later"),
            saying(License_Expression="LGPL-2.1-only"),
            saying(License_Expression="MIT AND AGPL-3.0-only"),
            saying(License_Expression="GPL-2.0-only WITH Classpath-exception-2.0"),
            saying(License_Expression="MPL-2.0"),
            saying(License="GPL-3.0-only", Classifier=["Typing :: Typed"]),
        ],
    )
    def test_what_passes_its_terms_on_is_not_permissive(self, metadata: Message) -> None:
        assert not permitted(stated(metadata), PERMISSIVE)

    @pytest.mark.parametrize(
        ("metadata", "words"),
        [
            (saying(), "no licence at all"),
            (saying(License="ask us"), "ask us"),
            (saying(License_Expression="Mine-1.0"), "Mine-1.0"),
            (
                saying(
                    License="MIT",
                    Classifier=[
                        "License :: OSI Approved :: MIT License",
                        "License :: OSI Approved :: GNU General Public License v3 (GPLv3)",
                    ],
                ),
                "GPLv3",
            ),
        ],
    )
    def test_what_is_not_known_is_refused_in_its_words(self, metadata: Message, words: str) -> None:
        with pytest.raises(UnknownLicenceError, match=words):
            stated(metadata)

    @pytest.mark.parametrize(
        ("metadata", "expression"),
        [
            (saying(License_Expression="mit OR apache-2.0"), "MIT OR Apache-2.0"),
            (saying(Classifier=["License :: OSI Approved :: MIT License"]), "MIT"),
            (saying(License="BSD"), "BSD-3-Clause"),
            (saying(License="Apache-2.0"), "Apache-2.0"),
        ],
    )
    def test_each_way_to_state_one_is_read(self, metadata: Message, expression: str) -> None:
        assert stated(metadata) == expression

    @pytest.mark.parametrize(
        ("expression", "is_permitted"),
        [
            ("MIT OR GPL-3.0-only", True),
            ("GPL-3.0-only OR MIT", True),
            ("MIT AND GPL-3.0-only", False),
            ("(GPL-3.0-only OR MIT) AND BSD-3-Clause", True),
            ("(GPL-3.0-only AND MIT) OR LGPL-3.0-only", False),
            ("GPL-3.0-only OR MIT AND LGPL-3.0-only", False),
            ("((GPL-3.0-only OR ISC) AND MIT) OR LGPL-3.0-only", True),
        ],
    )
    def test_of_a_choice_one_suffices_of_a_sum_all_are_needed(
        self, expression: str, is_permitted: bool
    ) -> None:
        assert permitted(expression, PERMISSIVE) is is_permitted

    def test_what_was_read_by_hand_still_says_the_same(self) -> None:
        here = {name for name in READ_BY_HAND if name != "daft" or "ray" in EXTRAS}
        found = {name: said(distribution(name).metadata, "License") for name in here}
        assert found.items() <= READ_BY_HAND.items()


@pytest.mark.parametrize(
    "requirement",
    [*RUNTIME, *(each for extra in EXTRAS.values() for each in extra)],
    ids=lambda requirement: requirement.name,
)
def test_no_dependency_may_reach_a_major_release_that_nobody_tried(
    requirement: Requirement,
) -> None:
    tried = Version(version(requirement.name)).major
    assert any(each.operator == "<" for each in requirement.specifier), "it has no upper bound"
    assert not requirement.specifier.contains(f"{tried + 1}.0")
    assert not requirement.specifier.contains(f"{tried + 1}.7.1")
