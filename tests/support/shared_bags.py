"""Where the recorded and the public bags lie, on machines that have them."""

from __future__ import annotations

from pathlib import Path

import pytest

BAGS = Path(__file__).resolve().parents[3] / "shared" / "bags"
RECORDED = BAGS / "recorded"
REAL = BAGS / "real"

needs_recorded = pytest.mark.skipif(
    not RECORDED.is_dir(), reason="the folder of recorded sessions is not beside this checkout"
)
needs_real = pytest.mark.skipif(
    not REAL.is_dir(), reason="the folder of public robots' bags is not beside this checkout"
)
