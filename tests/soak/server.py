"""What a server holds of the system."""

from pathlib import Path
from typing import NamedTuple

from tests.support.processes import until
from tests.support.served import Served


class Held(NamedTuple):
    """What a process holds at one moment."""

    rss_mb: float
    threads: int
    files: int


def held(served: Served) -> Held:
    """Resident memory in MB, threads and file descriptors, as the kernel counts them."""
    proc = Path("/proc") / str(served.process.pid)
    status = (proc / "status").read_text(encoding="ascii", errors="replace")
    [rss] = [line.split()[1] for line in status.splitlines() if line.startswith("VmRSS:")]
    threads, files = (sum(1 for _ in (proc / name).iterdir()) for name in ("task", "fd"))
    return Held(int(rss) / 1024, threads, files)


def came_back_to(served: Served, start: Held) -> Held:
    """Waits until there are no more files and threads than there were at the start."""

    def back() -> Held | None:
        now = held(served)
        return now if now.files <= start.files and now.threads <= start.threads else None

    return until(back, f"{start}, as at the start")
