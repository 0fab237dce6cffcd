"""`python -m tests.soak --minutes N`: the soak by hand, for as long as there is time."""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from tests.soak.rounds import soaked
from tests.soak.server import Held, serving
from tests.support.robot_run import write_run

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Runs, prints a table, and gives 1 where something grew."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0)
    minutes: float = parser.parse_args(argv).minutes
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder) / "bags"
        write_run(bag_dir)
        with serving(bag_dir, Path(folder) / "log") as served:
            _tell(f"{'second':>8}{'RSS MB':>10}{'threads':>10}{'files':>8}")
            soak = asyncio.run(soaked(served, minutes * 60, _row))
            faults = Counter(
                str(each.get("event"))[:90]
                for each in served.events()
                if each["level"] in {"error", "critical"}
            )
    assert soak.end is not None
    assert soak.most is not None
    for name, held in (("start", soak.start), ("most", soak.most), ("end", soak.end)):
        _tell(f"{name:>8}{held.rss_mb:>10.1f}{held.threads:>10}{held.files:>8}")
    _tell(f"\n{len(soak.rounds)} rounds; growth of the second half: {soak.growth_mb:+.1f} MB")
    for name, seen in sorted(soak.seen.items()):
        _tell(f"{name:>22}  {', '.join(f'{what}: {n}' for what, n in sorted(seen.items()))}")
    _tell(f"errors logged: {dict(faults) or 'none'}")
    return int(soak.growth_mb > 0.1 * soak.start.rss_mb)


def _tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _row(second: float, held: Held) -> None:
    _tell(f"{second:>8.0f}{held.rss_mb:>10.1f}{held.threads:>10}{held.files:>8}")


if __name__ == "__main__":
    sys.exit(main())
