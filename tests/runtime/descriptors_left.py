"""Leaves this process a few file descriptors, for tests of what happens without them."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator
from pathlib import Path

from rmpa.runtime import limits


@contextlib.contextmanager
def descriptors_left(count: int) -> Iterator[int]:
    """Within this, ``count`` new descriptors can be had: the lowest free numbers, others are taken by duplicates.

    Yields the lowest of these numbers. So many are taken that the reserve is a whole one, however few files the
    process that runs the tests was given.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    top = max(int(entry.name) for entry in Path("/proc/self/fd").iterdir()) + 1
    top = max(top, limits.DESCRIPTORS_RESERVED * limits.DESCRIPTORS_RESERVED_PART)
    filled: list[int] = []
    try:
        while (fd := os.dup(0)) < top:
            filled.append(fd)
        os.close(fd)
        resource.setrlimit(resource.RLIMIT_NOFILE, (fd + count, hard))
        yield fd
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        for fd in filled:
            os.close(fd)
