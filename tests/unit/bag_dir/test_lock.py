"""One recorder for one bag directory."""

import errno
import fcntl
import json
import os
import socket
from pathlib import Path

import pytest

from ros2_memory.bag_dir.layout import LOCK_FILE
from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.core.errors import RecorderError
from tests.faults.small_disk import needs_mounts, small_disk
from tests.support.fakes import broken


def held_by(bag_dir: Path, text: str) -> int:
    """A lock that somebody holds who left this text; the descriptor to let go of it with."""
    descriptor = os.open(bag_dir / LOCK_FILE, os.O_RDWR | os.O_CREAT)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    os.pwrite(descriptor, text.encode(), 0)
    return descriptor


def refusal(bag_dir: Path, patience_s: float = 0.0) -> str:
    with pytest.raises(RecorderError) as caught:
        BagDirLock.acquire(bag_dir, patience_s)
    return str(caught.value)


def test_a_holder_on_another_machine_counts_as_alive(tmp_path: Path) -> None:
    descriptor = held_by(tmp_path, json.dumps({"pid": 1, "host": "another-robot"}))
    assert "process 1 on another-robot" in refusal(tmp_path, patience_s=3600)
    os.close(descriptor)


def test_the_child_of_a_recorder_that_died_is_waited_for_and_then_named(tmp_path: Path) -> None:
    # A process of the same number as ours that is not ours: a container that was started anew.
    holder = {"pid": os.getpid(), "host": socket.gethostname()}
    descriptor = held_by(tmp_path, json.dumps(holder))
    assert "ros2 bag record of its that still runs" in refusal(tmp_path)
    os.close(descriptor)


def test_a_directory_that_cannot_be_written_into_is_refused_with_its_key(tmp_path: Path) -> None:
    assert "recording.bag_dir" in refusal(tmp_path / "nowhere")


def test_a_full_disk_keeps_nobody_from_taking_it(tmp_path: Path) -> None:
    with broken(os, "pwrite"):
        lock = BagDirLock.acquire(tmp_path)
    assert "left no name" in refusal(tmp_path)
    lock.release()


def test_a_lock_whose_file_was_deleted_keeps_others_out_again(tmp_path: Path) -> None:
    lock = BagDirLock.acquire(tmp_path)
    number = lock.descriptor
    (tmp_path / LOCK_FILE).unlink()
    assert lock.renew()
    assert lock.descriptor == number
    assert not os.get_inheritable(number)
    assert not lock.renew()
    # Nor is it given up where the disk does not show it.
    with broken(os, "stat", errno.EIO):
        assert not lock.renew()
    assert f"process {os.getpid()} on" in refusal(tmp_path)
    lock.release()
    BagDirLock.acquire(tmp_path).release()


def test_a_directory_that_has_gone_is_locked_once_it_is_there_again(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    bag_dir.mkdir()
    lock = BagDirLock.acquire(bag_dir)
    bag_dir.rename(tmp_path / "elsewhere")
    assert not lock.renew()
    bag_dir.mkdir()
    assert lock.renew()
    lock.release()


def test_what_another_has_taken_since_is_not_recorded_into(tmp_path: Path) -> None:
    lock = BagDirLock.acquire(tmp_path)
    (tmp_path / LOCK_FILE).unlink()
    descriptor = held_by(tmp_path, json.dumps({"pid": 1, "host": socket.gethostname()}))
    with pytest.raises(RecorderError, match="process 1 on"):
        lock.renew()
    os.close(descriptor)
    lock.release()


@needs_mounts
def test_below_an_unmounted_disk_no_lock_is_made(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    with small_disk(bag_dir, "128k"):
        lock = BagDirLock.acquire(bag_dir)
        with small_disk(bag_dir, "64k"):
            assert not lock.renew()
            assert list(bag_dir.iterdir()) == []
            # The same disk under another number has the file, which is then locked.
            (bag_dir / LOCK_FILE).touch()
            assert lock.renew()
        lock.release()
