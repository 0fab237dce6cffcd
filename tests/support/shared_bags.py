"""The recorded and the public bags, on machines that have them."""

from pathlib import Path

import pytest

BAGS = Path(__file__).resolve().parents[3] / "shared" / "bags"
RECORDED = BAGS / "recorded"
REAL = BAGS / "real"

# `tests/conftest.py` skips what is marked so where the path is not there, and counts it.
needs_recorded = pytest.mark.shared(RECORDED)
needs_real = pytest.mark.shared(REAL)
