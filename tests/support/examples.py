"""How much a test tries of what it could try any number of: more with EPISODIC_LONG=1.

Each run draws other examples, so what many short runs try together is what a long one tries.
"""

import os

LONG = os.environ.get("EPISODIC_LONG") == "1"
"""Whether a run may take hours."""
_FEWEST = 5


def examples(full: int) -> int:
    """How many examples of a property are drawn: `full` in a long run, else a fifth, at least 5.

    Of a property that has fewer than 5 in full, all.
    """
    return full if LONG else min(full, max(_FEWEST, full // 5))
