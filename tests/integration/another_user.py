"""Programs of another user, in a network of their own, for tests that root runs."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import pytest

NOBODY: Final = "65534"
needs_another_user = pytest.mark.skipif(
    os.geteuid() != 0 or not all(map(shutil.which, ("setpriv", "nsenter", "unshare", "ip"))),
    reason="root alone may run the recorder as another user (with util-linux and iproute2)",
)


@contextmanager
def own_network() -> Iterator[list[str]]:
    """A machine's network without a way out; what to start programs through to be on it."""
    hold = "ip link set lo up && echo up && exec sleep infinity"
    holder = subprocess.Popen(["unshare", "--net", "sh", "-c", hold], stdout=subprocess.PIPE)
    try:
        assert holder.stdout is not None
        if holder.stdout.readline() != b"up\n":
            pytest.skip("this user may not make a network of its own")
        yield ["nsenter", f"--net=/proc/{holder.pid}/ns/net"]
    finally:
        holder.kill()
        holder.communicate()


def as_nobody() -> list[str]:
    """What becomes another user's program.

    Interpreter and checkout may lie where only their owner may look, so it may look everywhere, and
    write nowhere; without that bit access(2) denies what open(2) allows.
    """
    become = ["setpriv", "--reuid", NOBODY, "--regid", NOBODY, "--clear-groups"]
    become += [f"--{which}-caps=+dac_read_search" for which in ("inh", "ambient")]
    # The folder for logs is not its own, nor is the one for what was covered.
    ours = ["ROS_LOG_DIR", *(name for name in os.environ if name.startswith("COVERAGE_"))]
    return [*become, "--securebits=+no_setuid_fixup", "env", *(f"--unset={n}" for n in ours)]
