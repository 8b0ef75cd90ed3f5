"""Gives memory that the C library keeps after it was freed back to the kernel (glibc's ``malloc_trim``).

When a thousand modules start at once, an agent has a link to each of them for some seconds, and then none. glibc
keeps the freed memory between what is still in use: it returns by itself only what lies at the end of its heap.

``ctypes`` is imported when it is first needed: that takes 3 ms, and most agents never need it.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.runtime import limits

if TYPE_CHECKING:
    from collections.abc import Callable

_STATM: Final = Path("/proc/self/statm")


def resident_memory() -> int:
    """Resident memory of this process in bytes; 0 where the kernel does not tell it."""
    try:
        return int(_STATM.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGESIZE")
    except (OSError, ValueError, IndexError):
        return 0


def trim() -> bool:
    """Return free memory to the kernel.

    Returns:
        Whether the C library can do this; musl and macOS cannot.
    """
    import ctypes  # noqa: PLC0415 - 3 ms of the start

    try:
        malloc_trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError):
        return False
    malloc_trim(0)
    return True


class FreeMemory:
    """Decides when free memory is returned: at rest, after resident memory has grown, or much of the heap was freed.

    Growth alone does not tell it: an agent may rest once while the links of a start still stand. What they take is
    freed later, in the midst of the heap, and resident memory stays as it is.

    Args:
        resident: Returns resident memory in bytes.
        trim: Returns free memory to the kernel, and whether it can.
        blocks: Returns the number of memory blocks in use.
    """

    def __init__(
        self,
        resident: Callable[[], int] = resident_memory,
        trim: Callable[[], bool] = trim,
        blocks: Callable[[], int] = sys.getallocatedblocks,
    ) -> None:
        self._resident = resident
        self._trim = trim
        self._can = True
        self._blocks = blocks
        self._most_blocks = 0
        """The most blocks in use that were seen since the start or the last trim."""
        self._kept = 0
        """Resident memory after the start or the last trim, the smaller one of what was seen since."""

    def start(self) -> None:
        """Measure growth from now on."""
        self._kept = self._resident()
        self._most_blocks = self._blocks()

    def release(self) -> int | None:
        """Return free memory if there may be some.

        Returns:
            The bytes by which resident memory shrank; ``None``: it was not tried.
        """
        before, blocks = self._resident(), self._blocks()
        self._kept = min(self._kept, before)
        self._most_blocks = max(self._most_blocks, blocks)
        grown, freed = before - self._kept, self._most_blocks - blocks
        if not self._can or (grown < limits.TRIM_GROWTH and freed < limits.TRIM_FREED):
            return None
        self._can = self._trim()
        if not self._can:
            return None
        self._kept, self._most_blocks = self._resident(), blocks
        return before - self._kept
