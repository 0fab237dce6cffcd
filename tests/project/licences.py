"""Under which licences the packages of this environment are, by their own metadata.

A package states an SPDX expression (`License-Expression`, PEP 639), or what came before it: trove
classifiers, else a free text (`License`).
"""

from __future__ import annotations

import re
from importlib.metadata import distribution
from typing import TYPE_CHECKING, Final

from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable
    from email.message import Message
    from importlib.metadata import PackageMetadata

_CLASSIFIER: Final = "License :: "
_CLASSIFIED: Final = {
    "License :: OSI Approved :: Apache Software License": "Apache-2.0",
    "License :: OSI Approved :: BSD License": "BSD-3-Clause",  # which of them, it does not tell
    "License :: OSI Approved :: ISC License (ISCL)": "ISC",
    "License :: OSI Approved :: MIT License": "MIT",
    "License :: OSI Approved :: Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "License :: OSI Approved :: Python Software Foundation License": "PSF-2.0",
}
_SPOKEN: Final = {
    "BSD": "BSD-3-Clause",
    "3-Clause BSD License": "BSD-3-Clause",
    "Apache 2.0": "Apache-2.0",
}
_MET: Final = "met"
_UNMET: Final = "unmet"


class UnknownLicenceError(Exception):
    """A package does not state its licence, or in words that are not known here."""


def closure(roots: Iterable[str]) -> set[str]:
    """Names of the packages that are installed for these requirements, at any depth.

    Extras that a requirement asks for are followed; requirements whose marker does not hold in this
    environment are not.
    """
    found: dict[str, set[str]] = {}
    todo = [Requirement(root) for root in roots]
    while todo:
        requirement = todo.pop()
        name, extras = canonicalize_name(requirement.name), {"", *requirement.extras}
        if name in found and extras <= found[name]:
            continue
        found.setdefault(name, set()).update(extras)
        for line in distribution(name).requires or ():
            needed = Requirement(line)
            if needed.marker is None or any(
                needed.marker.evaluate({"extra": extra}) for extra in extras
            ):
                todo.append(needed)
    return set(found)


def stated(metadata: PackageMetadata | Message) -> str:
    """The SPDX expression of what a package's metadata says.

    Several classifiers are taken together (AND): which of them one may choose, they do not tell.

    Raises:
        UnknownLicenceError: it says nothing, or nothing that is known here.
    """
    text = said(metadata, "License-Expression")
    if not text:
        classifiers = metadata.get_all("Classifier", [])
        names = [each for each in classifiers if each.startswith(_CLASSIFIER)]
        if names:
            unknown = [name for name in names if name not in _CLASSIFIED]
            if unknown:
                raise UnknownLicenceError(", ".join(unknown))
            text = " AND ".join(_CLASSIFIED[name] for name in names)
        else:
            text = said(metadata, "License") or "no licence at all"
    try:
        return canonicalize_license_expression(_SPOKEN.get(text, text))
    except InvalidLicenseExpression as error:
        raise UnknownLicenceError(text.strip()[:80]) from error


def said(metadata: PackageMetadata | Message, field: str) -> str:
    """The text of one field, empty where there is none."""
    texts = metadata.get_all(field, [])
    return str(texts[0]) if texts else ""


def permitted(expression: str, allowed: Collection[str]) -> bool:
    """Whether a canonical SPDX expression can be met with these licences alone.

    Of an OR one side must be among them, of an AND both. A licence WITH an exception is one of its
    own.
    """
    while "(" in expression:
        expression = re.sub(
            r"\(([^()]*)\)",
            lambda inner: _MET if permitted(inner[1], allowed) else _UNMET,
            expression,
        )
    met = {*allowed, _MET}
    return any(
        all(name.strip() in met for name in choice.split(" AND "))
        for choice in expression.split(" OR ")
    )
