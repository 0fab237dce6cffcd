"""What the repository promises about itself: the wheel, its dependencies, the examples."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.version import Version

from ros2_memory import config, config_sources
from ros2_memory.serving import auth

ROOT = Path(__file__).resolve().parents[2]


def read_yaml(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text())


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


class TestWheel:
    def test_ships_the_whole_configuration(self, wheel: zipfile.ZipFile) -> None:
        prefix = "ros2_memory/_config/"
        shipped = {
            name.removeprefix(prefix) for name in wheel.namelist() if name.startswith(prefix)
        }
        files = (ROOT / "config").rglob("*.yaml")
        assert shipped == {str(path.relative_to(ROOT / "config")) for path in files}

    def test_loads_its_configuration_without_a_checkout(
        self, wheel: zipfile.ZipFile, tmp_path: Path
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

    def test_has_the_typing_marker_and_the_licence(self, wheel: zipfile.ZipFile) -> None:
        names = wheel.namelist()
        assert "ros2_memory/py.typed" in names
        assert any(name.endswith("licenses/LICENSE") for name in names)

    def test_ships_every_file_of_the_package_and_no_other(self, wheel: zipfile.ZipFile) -> None:
        shipped = {name for name in wheel.namelist() if name.startswith("ros2_memory/")}
        tracked = subprocess.run(
            ["git", "ls-files", "src"], cwd=ROOT, check=True, capture_output=True, text=True
        )
        files = {name.removeprefix("src/") for name in tracked.stdout.split()}
        assert {name for name in shipped if "/_config/" not in name} == files

    def test_starts_each_program(self, wheel: zipfile.ZipFile) -> None:
        (name,) = [name for name in wheel.namelist() if name.endswith("entry_points.txt")]
        declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
        starts = wheel.read(name).decode().split("[console_scripts]\n")[1].split()
        assert "".join(starts) == "".join(f"{each}={to}" for each, to in declared.items())


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
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


class TestExamples:
    def test_the_environment_example_names_every_variable_that_is_read(self) -> None:
        readers = (config.__file__, config_sources.__file__, auth.__file__)
        source = "".join(Path(file).read_text() for file in readers)
        read = set(re.findall(r'"((?:MCP|MEMORY|ROS)_[A-Z_]+)"', source))
        text = (ROOT / ".env.example").read_text()
        assert {*re.findall(r"^#([A-Z_]+)=", text, re.MULTILINE)} == read
        for preset in (ROOT / "config" / "deployment").glob("*.yaml"):
            assert re.search(rf"\b{preset.stem}\b", text)

    def test_the_environment_example_sets_nothing(self) -> None:
        # As EnvironmentFile= an empty value overrides what a unit sets.
        lines = (ROOT / ".env.example").read_text().splitlines()
        assert not [line for line in lines if line and line[0] != "#"]

    def test_the_shipped_topics_are_distinct_names(self) -> None:
        topics = read_yaml("config/topics.yaml")["topics"]
        assert len(set(topics)) == len(topics) > 0
        assert all(re.fullmatch(r"(/\w+)+", topic) for topic in topics)
