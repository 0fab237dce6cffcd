"""Disks that take no more, or fail."""

import errno
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Never
from unittest.mock import patch

import pytest


@contextmanager
def files_limited_to(size: int) -> Iterator[None]:
    """Within the block writing past so many bytes of a file fails, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def failing(number: int = errno.ENOSPC) -> Callable[..., Never]:
    """What stands for a function of the system: a full disk, unless another error is given."""

    def fails(*_: object, **__: object) -> Never:
        raise OSError(number, os.strerror(number))

    return fails


@contextmanager
def broken(
    owner: object,
    name: str,
    number: int = errno.ENOSPC,
    *,
    where: Callable[..., bool] = lambda *_: True,
) -> Iterator[None]:
    """Within the block a function fails, as on a full disk, unless another error is given.

    Of a function that fails for some arguments alone, `where` tells for which.
    """
    work, fails = getattr(owner, name), failing(number)

    def call(*given: Any, **how: Any) -> Any:
        return (fails if where(*given) else work)(*given, **how)

    with patch.object(owner, name, call):
        yield


@contextmanager
def killed_at(owner: object, name: str, nth: int = 1) -> Iterator[None]:
    """The program is killed when it calls a function for the nth time, which ends the block."""
    work, before = getattr(owner, name), iter(range(1, nth))

    def call(*given: Any, **how: Any) -> Any:
        if next(before, None) is None:
            raise KeyboardInterrupt
        return work(*given, **how)

    with patch.object(owner, name, call), pytest.raises(KeyboardInterrupt):
        yield
