from __future__ import annotations

import os

import pytest

from rmpa.runtime import limits
from rmpa.runtime.free_memory import FreeMemory, resident_memory, trim


class Process:
    """A process whose memory a test sets."""

    def __init__(self, resident: int, *, can_trim: bool = True) -> None:
        self.resident = resident
        self.free = 0
        self.blocks = 100_000
        self.trims = 0
        self._can_trim = can_trim

    def trim(self) -> bool:
        self.trims += 1
        if self._can_trim:
            self.resident -= self.free
            self.free = 0
        return self._can_trim

    def memory(self) -> FreeMemory:
        made = FreeMemory(lambda: self.resident, self.trim, lambda: self.blocks)
        made.start()
        return made


def test_free_memory_is_returned_once_after_growth() -> None:
    process = Process(50_000_000)
    memory = process.memory()
    assert memory.release() is None
    process.resident += limits.TRIM_GROWTH - 1
    assert memory.release() is None
    process.resident, process.free = 200_000_000, 60_000_000
    assert memory.release() == 60_000_000
    assert memory.release() is None, "nothing has grown since"
    process.resident += limits.TRIM_GROWTH
    assert memory.release() == 0
    assert process.trims == 2


def test_what_is_freed_after_a_rest_among_links_is_returned_at_a_later_one() -> None:
    process = Process(50_000_000)
    memory = process.memory()
    process.resident, process.blocks = 200_000_000, 1_000_000
    assert memory.release() == 0, "all links of the start stand"
    process.free, process.blocks = 60_000_000, 1_000_000 - limits.TRIM_FREED
    assert memory.release() == 60_000_000
    process.blocks -= limits.TRIM_FREED - 1
    assert memory.release() is None


def test_growth_counts_from_the_least_since_the_last_time() -> None:
    process = Process(200_000_000)
    memory = process.memory()
    process.resident = 100_000_000
    assert memory.release() is None
    process.resident = 100_000_000 + limits.TRIM_GROWTH
    assert memory.release() == 0


def test_a_c_library_that_cannot_is_asked_once() -> None:
    process = Process(50_000_000, can_trim=False)
    memory = process.memory()
    for _ in range(3):
        process.resident += limits.TRIM_GROWTH
        assert memory.release() is None
    assert process.trims == 1


def test_free_memory_between_used_memory_goes_back_to_the_kernel() -> None:
    if not (os.confstr("CS_GNU_LIBC_VERSION") or "").startswith("glibc"):
        pytest.skip("glibc only")
    blocks = [bytearray(20_000) for _ in range(3000)]
    used = resident_memory()
    del blocks[:-1]
    assert trim()
    assert used - resident_memory() > 40_000_000
    assert len(blocks) == 1


def test_memory_that_the_kernel_does_not_tell_is_never_trimmed() -> None:
    process = Process(0)
    memory = process.memory()
    assert memory.release() is None
    assert process.trims == 0
