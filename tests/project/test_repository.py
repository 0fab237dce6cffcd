"""What the repository promises about itself: the wheel, its dependencies, its registration.

`server.json`, by which the MCP registry lists the server, is validated against the registry's
schema (2025-12-11, in tests/data/mcp_registry), and by what it demands of packages of PyPI.
"""

import json
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from ros2_memory import config, config_sources
from ros2_memory.serving import given_tokens
from tests.support.memories import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    built = subprocess.run(
        # The source distribution, and the wheel that is made of it.
        ["uv", "build", "--quiet", "--out-dir", folder, ROOT],
        check=False,
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("*.whl")
    assert len([*folder.glob("*.tar.gz")]) == 1
    return zipfile.ZipFile(path)


def test_the_wheel_ships_the_package_its_configuration_and_the_licence(
    wheel: zipfile.ZipFile,
) -> None:
    tracked = subprocess.run(
        ["git", "ls-files", "src", "config"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    files = {
        name.replace("src/", "", 1).replace("config/", "ros2_memory/_config/", 1)
        for name in tracked.stdout.split()
    }
    assert "ros2_memory/py.typed" in files
    names = wheel.namelist()
    assert {name for name in names if name.startswith("ros2_memory/")} == files
    assert any(name.endswith("licenses/LICENSE") for name in names)
    (starts,) = [name for name in names if name.endswith("entry_points.txt")]
    declared = [f"{name} = {to}" for name, to in PROJECT["scripts"].items()]
    assert wheel.read(starts).decode().split("\n")[1:-1] == declared


def test_the_wheel_loads_its_configuration_without_a_checkout(
    wheel: zipfile.ZipFile, tmp_path: Path
) -> None:
    wheel.extractall(tmp_path / "installed")
    program = (
        "from ros2_memory.config import config_dir, load_settings, load_message_schemas\n"
        "settings = load_settings((), {'MEMORY_DEPLOYMENT': 'replay'})\n"
        "print(config_dir({}), settings.server.name, bool(load_message_schemas(settings)))\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program],
        check=True,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path / "installed")},
    )
    folder = tmp_path / "installed/ros2_memory/_config"
    assert ran.stdout.split() == [str(folder), "episodic", "True"]


DEPENDENCIES = [
    Requirement(line)
    for lines in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
    for line in lines
]


@pytest.mark.parametrize("requirement", DEPENDENCIES, ids=lambda requirement: requirement.name)
def test_no_dependency_may_reach_a_major_release_that_nobody_tried(
    requirement: Requirement,
) -> None:
    tried = Version(version(requirement.name)).major
    assert any(each.operator == "<" for each in requirement.specifier), "it has no upper bound"
    assert not requirement.specifier.contains(f"{tried + 1}.0")


def test_the_environment_example_names_every_variable_that_is_read_and_sets_none() -> None:
    readers = (config.__file__, config_sources.__file__, given_tokens.__file__)
    source = "".join(Path(file).read_text() for file in readers)
    lines = (ROOT / ".env.example").read_text().splitlines()
    named = {found[1] for line in lines if (found := re.match(r"#([A-Z_]+)=", line))}
    assert named == set(re.findall(r'"((?:MCP|MEMORY|ROS)_[A-Z_]+)"', source))
    # As EnvironmentFile= an empty value overrides what a unit sets.
    assert not [line for line in lines if line and line[0] != "#"]


SERVER: Any = json.loads((ROOT / "server.json").read_text())
[PACKAGE] = SERVER["packages"]
SCHEMA = "https://static.modelcontextprotocol.io/schemas/2025-12-11/server.schema.json"
VALID = jsonschema.Draft7Validator(
    json.loads((ROOT / "tests/data/mcp_registry/server.schema.json").read_text())
)


def test_it_is_valid_by_the_schema_that_it_names() -> None:
    assert VALID.schema["$id"] == SERVER["$schema"] == SCHEMA
    assert [each.message for each in VALID.iter_errors(SERVER)] == []


def test_it_names_this_release_of_this_package_on_pypi_whose_readme_names_it() -> None:
    assert (PACKAGE["registryType"], PACKAGE["identifier"]) == ("pypi", PROJECT["name"])
    assert SERVER["version"] == PACKAGE["version"] == PROJECT["version"]
    readme = (ROOT / PROJECT["readme"]).read_text()
    assert re.findall(r"mcp-name: (\S+)", readme) == [SERVER["name"]]


def test_every_variable_is_one_that_the_programs_read() -> None:
    example = (ROOT / ".env.example").read_text()
    known = set(re.findall(r"^#([A-Z_]+)=", example, re.MULTILINE))
    assert {variable["name"] for variable in PACKAGE["environmentVariables"]} <= known
