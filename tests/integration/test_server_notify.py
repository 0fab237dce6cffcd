"""The query server tells the service manager when it listens, and when it stops."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.support.processes import PATIENCE_S, service_manager


def test_it_is_ready_when_it_listens_and_says_when_it_stops(tmp_path: Path) -> None:
    with service_manager(tmp_path / "notify") as manager:
        env = {
            **os.environ,
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "MEMORY_BAG_DIR": str(tmp_path),
            "MCP_TRANSPORT": "sse",
            "MCP_PORT": "0",
        }
        argv = [sys.executable, "-m", "ros2_memory.server", "recorder=none"]
        with subprocess.Popen(argv, env=env, stderr=subprocess.DEVNULL) as server:
            assert manager.recv(100) == b"READY=1"
            server.send_signal(signal.SIGTERM)
            assert manager.recv(100) == b"STOPPING=1"
            assert server.wait(PATIENCE_S) == 0
