"""`server.json`, by which the MCP registry lists the server.

It is validated against the registry's schema (2025-12-11, in tests/data/mcp_registry), and checked
for what the registry demands of packages of PyPI.
"""

import json
import re
import tomllib
from typing import Any

import jsonschema

from tests.support.memories import ROOT

SERVER: Any = json.loads((ROOT / "server.json").read_text(encoding="utf-8"))
[PACKAGE] = SERVER["packages"]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
SCHEMA = "https://static.modelcontextprotocol.io/schemas/2025-12-11/server.schema.json"
VALID = jsonschema.Draft7Validator(
    json.loads((ROOT / "tests/data/mcp_registry/server.schema.json").read_text(encoding="utf-8"))
)


def test_it_is_valid_by_the_schema_that_it_names() -> None:
    assert VALID.schema["$id"] == SERVER["$schema"] == SCHEMA
    assert [each.message for each in VALID.iter_errors(SERVER)] == []


def test_it_names_this_release_of_this_package_on_pypi_whose_readme_names_it() -> None:
    assert (PACKAGE["registryType"], PACKAGE["identifier"]) == ("pypi", PROJECT["name"])
    assert SERVER["version"] == PACKAGE["version"] == PROJECT["version"]
    readme = (ROOT / PROJECT["readme"]).read_text(encoding="utf-8")
    assert re.findall(r"mcp-name: (\S+)", readme) == [SERVER["name"]]


def test_every_variable_is_one_that_the_programs_read() -> None:
    example = (ROOT / ".env.example").read_text(encoding="utf-8")
    known = set(re.findall(r"^#([A-Z_]+)=", example, re.MULTILINE))
    assert {variable["name"] for variable in PACKAGE["environmentVariables"]} <= known
