"""Runs a function without a capability of this process."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, TypeVar

T = TypeVar("T")

NET_ADMIN: Final = 12
_VERSION_3: Final = 0x20080522


def without(capability: int, run: Callable[[], T]) -> T:
    """Call in a thread that lacks the capability (capset(2) is for one thread)."""
    with ThreadPoolExecutor(1) as thread:
        thread.submit(_drop, capability).result()
        return thread.submit(run).result()


def _drop(capability: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(_VERSION_3, 0)
    sets = (ctypes.c_uint32 * 6)()
    for call in (libc.capget, libc.capset):
        if call(header, sets):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        sets[0] &= ~(1 << capability)  # the effective set, of the lower 32 capabilities
