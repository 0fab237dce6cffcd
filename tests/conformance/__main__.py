"""Runs the conformance suite and the official clients against a server of its own.

Exit code 0: all that applies passed; 1: something did not; 3: not evaluated, and why.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from tests.support.robot_run import write_run
from tests.support.served import PROGRAM, Served, serving

HERE: Final = Path(__file__).parent
HOME: Final = HERE.parents[1] / "build" / "conformance"
MODULES: Final = HOME / "node_modules"
NODE: Final = MODULES / ".bin" / "node"
SUITE: Final = MODULES / "@modelcontextprotocol" / "conformance" / "dist" / "index.js"
INSPECTOR: Final = MODULES / ".bin" / "mcp-inspector"
NOT_EVALUATED: Final = 3
ANSWERS_WITHIN_S: Final = 20
INSTALLS_WITHIN_S: Final = 300
ENDS_WITHIN_S: Final = 90
TOKEN: Final = "conformance-0123456789"  # noqa: S105  of a server that lives for seconds

APPLYING: Final = (
    "server-initialize",
    "ping",
    "tools-list",
    "tools-call-simple-text",
    "tools-call-error",
    "server-sse-multiple-streams",
    "resources-list",
    "prompts-list",
    "dns-rebinding-protection",
)
"""The others call tools and prompts of the suite's own, or what a server may leave out."""


def main(arguments: Sequence[str] = ()) -> int:
    """Prints a line for each scenario and client; `--prepare` only installs what it needs."""
    missing = _installed()
    if missing is not None:
        sys.stdout.write(f"conformance: not evaluated ({missing})\n")
        return NOT_EVALUATED
    if "--prepare" in arguments:
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        write_run(folder / "bags")
        failed = 0
        with serving(folder / "bags", folder / "log", program=PROGRAM) as served:
            for name in APPLYING:
                failed += _told(name, _scenario(name, served, folder / name))
            failed += _clients(served, ())
        token = {"MEMORY_API_TOKEN": TOKEN}
        with serving(folder / "bags", folder / "log", program=PROGRAM, **token) as served:
            failed += _clients(served, (TOKEN,))
    return 1 if failed else 0


def _told(name: str, fault: str | None) -> int:
    sys.stdout.write(f"{name:<40} {'passed' if fault is None else f'FAILED: {fault}'}\n")
    sys.stdout.flush()
    return 0 if fault is None else 1


def _installed() -> str | None:
    """Installs what package.json names; why that cannot be done, or None."""
    wanted = (HERE / "package.json").read_text(encoding="utf-8")
    have = HOME / "installed.json"
    if have.is_file() and have.read_text(encoding="utf-8") == wanted and NODE.exists():
        return None
    npm = shutil.which("npm")
    if npm is None:
        return "npm is not on this machine"
    HOME.mkdir(parents=True, exist_ok=True)
    have.unlink(missing_ok=True)
    try:
        ran = _run([npm, "ping", "--fetch-retries=0"], ANSWERS_WITHIN_S)
        if ran.returncode:
            return "npm's registry cannot be reached"
        (HOME / "package.json").write_text(wanted, encoding="utf-8")
        ran = _run(
            [npm, "install", "--no-audit", "--no-fund", "--loglevel=error"], INSTALLS_WITHIN_S
        )
    except subprocess.TimeoutExpired:
        ran = None
    if ran is None or ran.returncode:
        return "npm install failed" + (f": {ran.stderr.strip()[-300:]}" if ran else " in time")
    # Last: what was broken off is begun anew.
    have.write_text(wanted, encoding="utf-8")
    return None


def _run(argv: list[str], within_s: float) -> subprocess.CompletedProcess[str]:
    env = os.environ | {
        "PATH": f"{NODE.parent}{os.pathsep}{os.environ['PATH']}",
        "MCP_CATALOG_PATH": str(HOME / "catalog.json"),  # and not in the user's home
    }
    return subprocess.run(
        argv, cwd=HOME, env=env, capture_output=True, text=True, check=False, timeout=within_s
    )


def _scenario(name: str, served: Served, out: Path) -> str | None:
    """What is wrong, or None. A check that warns is no pass, nor a scenario without one."""
    argv = [str(NODE), str(SUITE), "server", "--url", served.url("/mcp"), "--scenario", name]
    ran = _run([*argv, "-o", str(out)], ENDS_WITHIN_S)
    checks: list[dict[str, Any]] = [
        check
        for file in out.rglob("checks.json")
        for check in json.loads(file.read_text(encoding="utf-8"))
    ]
    wrong = [check for check in checks if check["status"] in {"FAILURE", "WARNING"}]
    if wrong:
        return "; ".join(f"{each['id']} {each.get('errorMessage', '')}" for each in wrong)
    if not any(check["status"] == "SUCCESS" for check in checks):
        return f"nothing was checked: {ran.stdout[-200:]}{ran.stderr[-200:]}"
    return None


def _clients(served: Served, token: tuple[str, ...]) -> int:
    how = " with a token" if token else ""
    failed = 0
    for kind, path in (("sse", "/sse"), ("http", "/mcp")):
        argv = [str(NODE), "ask.mjs", kind, served.url(path), *token]
        shutil.copy(HERE / "ask.mjs", HOME)
        failed += _told(f"TypeScript client, {path}{how}", _ask(argv))
        header = ["--header", f"Authorization: Bearer {token[0]}"] if token else []
        argv = [str(INSPECTOR), "--cli", served.url(path), "--transport", kind]
        failed += _told(f"inspector --cli, {path}{how}", _inspect(argv, header))
    return failed


def _ask(argv: list[str]) -> str | None:
    ran = _run(argv, ENDS_WITHIN_S)
    if ran.returncode:
        return ran.stderr[-300:]
    told = json.loads(ran.stdout)
    sound = (
        told["server"] == "episodic"
        and told["tools"] > 0
        and not told["answer"]["isError"]
        and told["answer"]["bags"] == 1
        and told["refusal"]["isError"]
        and told["refusal"]["error"] == "invalid_arguments"
    )
    return None if sound else ran.stdout[-300:]


def _inspect(argv: list[str], header: list[str]) -> str | None:
    call = ["--method", "tools/call", "--tool-name", "data_time_range"]
    listed = _run([*argv, "--method", "tools/list", *header], ENDS_WITHIN_S)
    called = _run([*argv, *call, *header], ENDS_WITHIN_S)
    if listed.returncode or called.returncode:
        return (listed.stderr + called.stderr)[-300:]
    tools = [tool["name"] for tool in json.loads(listed.stdout)["tools"]]
    answer = json.loads(json.loads(called.stdout)["content"][0]["text"])
    return None if "data_time_range" in tools and answer["bags"] == 1 else called.stdout[-300:]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
