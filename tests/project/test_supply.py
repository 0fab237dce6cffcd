"""What is installed with this package: its licences, and how far its versions may move."""

from __future__ import annotations

import tomllib
from importlib.metadata import distribution, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from tests.project.licences import UnknownLicenceError, closure, permitted, said, stated

PROJECT = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text())
RUNTIME = [Requirement(line) for line in PROJECT["project"]["dependencies"]]
EXTRAS = {
    extra: [Requirement(line) for line in lines]
    for extra, lines in PROJECT["project"]["optional-dependencies"].items()
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
