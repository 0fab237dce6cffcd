"""The memory of one question over a small bag of large messages, in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING, Final

from mcap.writer import CompressionType

from tests.support.bags import McapLayout, text, write_mcap
from tests.support.memories import ROOT

if TYPE_CHECKING:
    from pathlib import Path

MB: Final = 1 << 20
PROMISED_MB: Final = 512
"""What docs/security.md states."""
SCRIPT: Final = """
import sys
from pathlib import Path
from ros2_memory import cli

asked = ["find_last_match", "topic=/chatter", "condition_type=contains", f"value={sys.argv[2]}"]
patient = "server.call_timeout_s=600"
cli.main(["ask", "--json", "--bag-dir", sys.argv[1], *asked, patient])
status = Path("/proc/self/status").read_text()
print(int(next(line for line in status.splitlines() if "VmHWM" in line).split()[1]) >> 10)
"""


def test_a_question_over_texts_of_40_mb_takes_less_memory_than_promised(
    tmp_path: Path,
) -> None:
    said = [text(n * 10**9, f"{n:02d}" + "a" * 40 * MB) for n in range(1, 16)]
    layout = McapLayout(chunk_size=MB, compression=CompressionType.ZSTD)
    write_mcap(tmp_path / "rec" / "rec_0.mcap", said, layout)
    command = [sys.executable, "-c", SCRIPT, str(tmp_path), "01"]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    *reply, memory_mb = told.stdout.splitlines()
    assert "1.0" in "".join(reply)
    assert int(memory_mb) < PROMISED_MB
