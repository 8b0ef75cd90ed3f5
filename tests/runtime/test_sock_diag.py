"""Requests to the kernel and its answers, as bytes; and a table that changes while it is read."""

from __future__ import annotations

import errno
import socket
import struct
import sys
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.runtime import limits, sock_diag
from rmpa.runtime.sock_diag import (
    FOUND_SIZE,
    InetSocket,
    InterruptedDump,
    MalformedAnswer,
    SockDiag,
    destroy_request,
    dump_request,
    read_dump,
    read_status,
)

little_endian = pytest.mark.skipif(sys.byteorder != "little", reason="the golden bytes are a little-endian machine's")

SOCKET: Final = InetSocket(
    family=socket.AF_INET,
    state=1,
    source=socket.inet_aton("10.88.0.1") + bytes(12),
    source_port=45225,
    destination=socket.inet_aton("10.88.0.2") + bytes(12),
    destination_port=40000,
    interface=3,
    cookie=(0x1001, 7),
    uid=1000,
    inode=77,
)
BODY: Final = bytes.fromhex(
    "02 01 00 00 b0a9 9c40"
    "0a580001 00000000 00000000 00000000"
    "0a580002 00000000 00000000 00000000"
    "03000000 01100000 07000000"
    "00000000 00000000 00000000 e8030000 4d000000"
)
FOUND: Final = bytes.fromhex("58000000 1400 0200 05000000 d2040000") + BODY
DONE: Final = bytes.fromhex("14000000 0300 0200 05000000 d2040000 00000000")
REFUSED: Final = bytes.fromhex("24000000 0200 0000 05000000 d2040000 ffffffff") + bytes(16)
TAKEN: Final = bytes.fromhex("24000000 0200 0001 05000000 d2040000 00000000") + bytes(16)


@little_endian
def test_golden_request_for_a_dump() -> None:
    head = "14000103 05000000 00000000 02 06 00 00 02040000 b0a9 9c40"
    rest = bytes(32) + bytes.fromhex("00000000 ffffffff ffffffff")
    asked = dump_request(socket.AF_INET, 1 << 10 | 1 << 1, source_port=45225, destination_port=40000, sequence=5)
    assert asked == bytes.fromhex("48000000" + head) + rest
    asked = dump_request(
        socket.AF_INET,
        1 << 10 | 1 << 1,
        source_port=45225,
        destination_port=40000,
        destination=bytes([10, 88, 0, 2]),
        sequence=5,
    )
    # linux/inet_diag.h: INET_DIAG_BC_D_COND, family, prefix and port (-1: any) of the condition, and the address.
    program = "1400 0100 08 10 1400 02 20 0000 ffffffff 0a580002"
    assert asked == bytes.fromhex("5c000000" + head) + rest + bytes.fromhex(program)


@little_endian
def test_golden_request_to_end_a_socket() -> None:
    head = bytes.fromhex("48000000 1500 0500 05000000 00000000 02 06 00 00 00000000")
    assert destroy_request(SOCKET, 5) == head + BODY[4:52]


@little_endian
def test_golden_answers() -> None:
    found: list[bytes] = []
    assert read_dump(FOUND + FOUND, found, 5), "more parts follow"
    assert not read_dump(FOUND + DONE, found, 5)
    assert [InetSocket.parse(body) for body in found] == [SOCKET] * 3
    assert read_status(TAKEN, 5) == 0
    assert read_status(REFUSED, 5) == errno.EPERM


@little_endian
def test_attributes_behind_a_socket_are_skipped() -> None:
    found: list[bytes] = []
    with_attribute = bytes.fromhex("5d000000") + FOUND[4:] + bytes.fromhex("0500080000")
    assert not read_dump(with_attribute + bytes(3) + DONE, found, 5), "the next message begins at a multiple of four"
    assert found == [BODY]


@little_endian
def test_an_error_ends_a_dump() -> None:
    with pytest.raises(PermissionError):
        read_dump(REFUSED, [], 5)
    with pytest.raises(OSError, match="No buffer space") as raised:
        read_dump(DONE[:-4] + struct.pack("=i", -errno.ENOBUFS), [], 5)
    assert raised.value.errno == errno.ENOBUFS
    assert not read_dump(b"\x10\0\0\0" + DONE[4:16], [], 5), "some kernels give no status"


@little_endian
@pytest.mark.parametrize(
    "data",
    [
        FOUND[:15],
        FOUND[:-1],
        FOUND + DONE[:7],
        b"\x0f" + FOUND[1:],
        b"\x54" + FOUND[1:],
        FOUND[:4] + b"\x15" + FOUND[5:],
        TAKEN,
        b"\x12\0\0\0" + TAKEN[4:20],
        REFUSED[:16] + b"\1\0\0\0" + REFUSED[20:],
        REFUSED[:16] + b"\0\0\0\x80" + REFUSED[20:],
        DONE[:-4] + b"\0\0\0\x80",
    ],
    ids=[
        "half a header",
        "cut off",
        "half a second header",
        "shorter than its header",
        "shorter than a socket",
        "another kind",
        "a mere acknowledgement",
        "an error without its number",
        "a positive number",
        "no number of an error",
        "no number of an error at the end",
    ],
)
def test_malformed_answers_are_refused(data: bytes) -> None:
    with pytest.raises(MalformedAnswer):
        read_dump(data, [], 5)


@little_endian
def test_an_answer_to_another_request_is_refused() -> None:
    with pytest.raises(MalformedAnswer, match="request 5, not 6"):
        read_dump(FOUND, [], 6)
    with pytest.raises(MalformedAnswer, match="request 5, not 6"):
        read_status(TAKEN, 6)
    for data in (b"", FOUND):
        with pytest.raises(MalformedAnswer):
            read_status(data, 5)


@little_endian
def test_an_interrupted_dump_is_no_answer() -> None:
    with pytest.raises(InterruptedDump):
        read_dump(FOUND[:6] + b"\x12\0" + FOUND[8:], [], 5)


words = st.integers(0, 0xFFFFFFFF)
ports = st.integers(0, 0xFFFF)
addresses = st.binary(min_size=16, max_size=16)


@given(
    st.builds(
        InetSocket,
        family=st.integers(0, 255),
        state=st.just(0),
        source=addresses,
        source_port=ports,
        destination=addresses,
        destination_port=ports,
        interface=words,
        cookie=st.tuples(words, words),
    )
)
def test_what_an_answer_tells_is_what_a_request_names(of: InetSocket) -> None:
    """The kernel's request and answer have the same identity of a socket (``struct inet_diag_sockid``)."""
    identity = destroy_request(of)[24:72]
    body = bytes([of.family, of.state, 0, 0]) + identity
    assert InetSocket.parse(body.ljust(FOUND_SIZE, b"\0")) == of


class Interrupting:
    """Stands for ``read_dump`` of a kernel whose table changes during the first dumps."""

    def __init__(self, times: int) -> None:
        self.times = times

    def __call__(self, data: bytes, found: list[bytes], sequence: int) -> bool:
        if self.times:
            self.times -= 1
            raise InterruptedDump(errno.EINTR, "changed")
        return read_dump(data, found, sequence)


def test_an_interrupted_dump_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening, SockDiag() as kernel:
        port = listening.getsockname()[1]
        monkeypatch.setattr(sock_diag, "read_dump", Interrupting(limits.SOCK_DIAG_DUMPS - 1))
        (body,) = kernel.dump(socket.AF_INET, 1 << 10, source_port=port)
        assert InetSocket.parse(body).source_port == port
        monkeypatch.setattr(sock_diag, "read_dump", Interrupting(limits.SOCK_DIAG_DUMPS))
        with pytest.raises(InterruptedDump):
            kernel.dump(socket.AF_INET, 1 << 10, source_port=port)
        (body,) = kernel.dump(socket.AF_INET, 1 << 10, source_port=port)
        assert InetSocket.parse(body).source_port == port, "nothing is left of the interrupted dump"
