"""What the repository promises about itself: the wheel, the gates, the units, the examples."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
import yaml

from ros2_memory import config, config_sources
from ros2_memory.serving import auth

ROOT = Path(__file__).resolve().parents[2]
GATES = (
    "uv sync --locked",
    ".ci/browser",
    "uv run ruff check",
    "uv run ruff format --check",
    "uv run mypy",
    "uv run lint-imports",
    "uv run pytest --cov",
    "uv run pytest -n0 --no-cov tests/project/test_first_commands.py",
    "uv run pip-audit --strict",
)
SERVER_UNIT = ROOT / "deploy/ros2-memory-server.service"
UNITS = sorted((ROOT / "deploy").glob("*.service"))


def systemd_version() -> int:
    if shutil.which("systemd-analyze") is None:
        return 0
    ran = subprocess.run(["systemd-analyze", "--version"], check=True, capture_output=True)
    found = re.match(rb"systemd (\d+)", ran.stdout)
    return int(found[1]) if found else 0


needs_systemd = pytest.mark.skipif(
    systemd_version() < 250, reason="systemd-analyze 250 or newer is not on this machine"
)


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

    def test_ships_the_page(self, wheel: zipfile.ZipFile) -> None:
        page = ROOT / "src/ros2_memory/serving/page/index.html"
        assert wheel.read("ros2_memory/serving/page/index.html") == page.read_bytes()

    def test_has_nothing_but_the_package(self, wheel: zipfile.ZipFile) -> None:
        tops = {name.split("/")[0] for name in wheel.namelist()}
        assert {re.sub(r"-.*\.", ".", top) for top in tops} == {
            "ros2_memory",
            "ros2_memory.dist-info",
        }


class TestGates:
    def test_the_script_runs_each(self) -> None:
        script = (ROOT / ".ci/run").read_text()
        assert [gate for gate in GATES if gate not in script] == []

    def test_readme_the_script_and_the_workflow_test_with_one_command(self) -> None:
        (command,) = re.findall(
            r"\.venv/bin/pip install uv && \.venv/bin/(.+)\n", (ROOT / "README.md").read_text()
        )
        assert command in GATES
        assert f"\ngate pytest {command}\n" in (ROOT / ".ci/run").read_text()
        steps = read_yaml(".github/workflows/ci.yml")["jobs"]["gates"]["steps"]
        assert [step["run"] for step in steps if "pytest" in step.get("run", "")] == [command]

    def test_the_workflow_runs_each_on_every_python_for_every_change(self) -> None:
        workflow = read_yaml(".github/workflows/ci.yml")
        job = workflow["jobs"]["gates"]
        steps = [*job["steps"], *workflow["jobs"]["bare"]["steps"]]
        commands = "\n".join(step.get("run", "") for step in steps)
        assert [gate for gate in GATES if gate not in commands] == []
        assert job["strategy"]["matrix"]["python"] == ["3.11", "3.12", "3.13", "3.14"]
        assert set(workflow[True]) == {"pull_request", "push"}  # YAML 1.1 reads the key "on" so

    def test_the_workflow_tries_every_python_that_the_package_claims(self) -> None:
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        claimed = re.findall(r"Python :: (3\.\d+)", "\n".join(project["classifiers"]))
        tried = read_yaml(".github/workflows/ci.yml")["jobs"]["gates"]["strategy"]["matrix"]
        assert project["requires-python"] == f">={claimed[0]}"
        assert set(claimed) <= set(tried["python"])

    @pytest.mark.parametrize("gates", [".ci/run", ".github/workflows/ci.yml"])
    def test_what_every_extra_installs_is_audited(self, gates: str) -> None:
        assert "--all-extras" in (ROOT / gates).read_text()
        assert "pip-audit --strict" in (ROOT / gates).read_text()

    def test_no_text_file_of_ours_ends_without_a_newline(self) -> None:
        (hook,) = [
            hook
            for repo in read_yaml(".pre-commit-config.yaml")["repos"]
            for hook in repo["hooks"]
            if hook["id"] == "end-of-file-fixer"
        ]
        tracked = subprocess.run(
            ["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True
        )
        wrong = []
        for name in tracked.stdout.split():
            path = ROOT / name
            if re.search(hook["exclude"], name) or path.is_symlink() or not path.is_file():
                continue
            content = path.read_bytes()
            if b"\0" not in content and content and not re.search(rb"[^\n]\n\Z", content):
                wrong.append(name)
        assert wrong == []

    def test_every_room_stands_in_the_import_contracts(self) -> None:
        contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
        (layers,) = [each for each in contracts["contracts"] if each["type"] == "layers"]
        assert layers["exhaustive"] is True
        assert layers["containers"] == ["ros2_memory"]


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

    def test_every_key_of_the_configuration_is_explained(self) -> None:
        lines = (ROOT / "config/config.yaml").read_text().splitlines()
        keys = [line for line in lines if re.match(r"  \w+: ", line)]
        assert len(keys) > 25
        assert [line for line in keys if " # " not in line] == []

    def test_the_shipped_topics_are_distinct_names(self) -> None:
        topics = read_yaml("config/topics.yaml")["topics"]
        assert len(set(topics)) == len(topics) > 0
        assert all(re.fullmatch(r"(/\w+)+", topic) for topic in topics)


class TestUnits:
    HARDENING = (
        "NoNewPrivileges=yes",
        "PrivateTmp=yes",
        "ProtectSystem=strict",
        "User=ros2-memory",
        "StandardError=journal",
        "RestartPreventExitStatus=2",
    )

    @pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
    def test_each_is_hardened(self, unit: Path) -> None:
        lines = unit.read_text().splitlines()
        assert [each for each in self.HARDENING if each not in lines] == []

    @needs_systemd
    @pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
    def test_each_is_understood_by_systemd(self, unit: Path, tmp_path: Path) -> None:
        copy = tmp_path / unit.name
        # The program is not installed here, and its absence is no fault of the unit.
        copy.write_text(re.sub(r"(?m)^(Exec\w+)=.*", r"\1=/bin/true", unit.read_text()))
        ran = subprocess.run(
            ["systemd-analyze", "verify", "--man=no", copy],
            check=False,
            capture_output=True,
            text=True,
        )
        complaints = [line for line in ran.stderr.splitlines() if unit.name in line]
        assert complaints == []

    @needs_systemd
    def test_the_server_is_exposed_by_less_than_two_of_ten(self) -> None:
        ran = subprocess.run(
            ["systemd-analyze", "security", "--offline=true", "--threshold=20", SERVER_UNIT],
            check=False,
            capture_output=True,
            text=True,
        )
        assert ran.returncode == 0, ran.stdout[-200:] + ran.stderr
