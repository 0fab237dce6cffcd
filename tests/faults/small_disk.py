"""Disks that a test mounts, fills and takes away, where it may."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest


def mount(path: Path, *arguments: str) -> None:
    subprocess.run(["mount", *arguments, str(path)], check=True, capture_output=True)


def unmount(path: Path) -> None:
    """Takes it away at once, as a disk that is pulled: who has files open keeps them."""
    subprocess.run(["umount", "--lazy", str(path)], check=True, capture_output=True)


@cache
def can_mount() -> bool:
    with TemporaryDirectory() as folder:
        try:
            mount(Path(folder), "-t", "tmpfs", "-o", "size=64k", "tmpfs")
        except (OSError, subprocess.CalledProcessError):
            return False
        unmount(Path(folder))
    return True


needs_mounts = pytest.mark.skipif(
    not can_mount(), reason="mounting a disk needs root and the right to mount"
)


@contextmanager
def small_disk(path: Path, size: str) -> Iterator[Path]:
    """A disk of this size at a folder that is made for it."""
    path.mkdir(parents=True, exist_ok=True)
    mount(path, "-t", "tmpfs", "-o", f"size={size}", "tmpfs")
    try:
        yield path
    finally:
        unmount(path)


@contextmanager
def filled(disk: Path) -> Iterator[None]:
    """Not a byte is free on the disk inside the block."""
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file:
        for piece in (1 << 16, 1 << 12, 1):
            with suppress(OSError):
                while file.write(b"\0" * piece):
                    pass
    try:
        yield
    finally:
        filler.unlink(missing_ok=True)
