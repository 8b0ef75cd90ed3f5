from __future__ import annotations

import pytest

from rmpa.web import limits
from rmpa.web.hub.topics import PayloadBuffers

SIZE = 100_000


def data(byte: bytes, size: int = SIZE) -> memoryview:
    return memoryview(byte * size)


def test_a_copy_stays_as_it_is_while_there_is_a_view_of_it() -> None:
    buffers = PayloadBuffers()
    first = buffers.copy(data(b"a"))
    part = buffers.copy(data(b"b"))[10:20]
    for byte in (b"c", b"d", b"e"):
        assert buffers.copy(data(byte)) == byte * SIZE
    assert first == b"a" * SIZE
    assert part == b"b" * 10
    assert buffers.bytes == 3 * SIZE


def test_a_buffer_is_used_again_when_its_last_view_has_gone() -> None:
    buffers = PayloadBuffers()
    view = buffers.copy(data(b"a"))
    del view
    for size in (SIZE, SIZE // 2, SIZE):
        assert buffers.copy(data(b"b", size)) == b"b" * size
    assert buffers.bytes == SIZE
    assert buffers.copy(data(b"c", 2 * SIZE)) == b"c" * 2 * SIZE
    assert buffers.bytes == 3 * SIZE


def test_a_copy_cannot_be_written_to() -> None:
    for size in (10, SIZE):
        with pytest.raises(TypeError):
            PayloadBuffers().copy(data(b"a", size))[0] = 1


def test_the_bytes_that_are_kept_are_bounded() -> None:
    buffers = PayloadBuffers(10 * SIZE)
    used = [buffers.copy(data(b"a")) for _ in range(30)]
    assert buffers.bytes == 10 * SIZE
    assert all(view == b"a" * SIZE for view in used)
    assert buffers.copy(data(b"b", 11 * SIZE)) == b"b" * 11 * SIZE
    assert buffers.bytes == 0
    small = [buffers.copy(data(b"c", limits.PAYLOAD_BUFFER_MIN)) for _ in range(2 * limits.PAYLOAD_BUFFERS_MAX)]
    assert buffers.bytes <= limits.PAYLOAD_BUFFERS_MAX * limits.PAYLOAD_BUFFER_MIN
    assert all(view[-1] == ord("c") for view in small)
    buffers.clear()
    assert buffers.bytes == 0
