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

from rmpa.runtime import kernel_tcp, limits
from rmpa.runtime.kernel_tcp import TcpSocket, destroy_query, dump, dump_query, open_netlink, read_answer

little_endian = pytest.mark.skipif(sys.byteorder != "little", reason="the golden bytes are a little-endian machine's")

BODY: Final = bytes.fromhex(
    "02 01 00 00 b0a9 9c40"
    "0a580001 00000000 00000000 00000000"
    "0a580002 00000000 00000000 00000000"
    "03000000 01100000 07000000"
    "00000000 00000000 00000000 e8030000 4d000000"
)
SOCKET: Final = TcpSocket(
    ("10.88.0.1", 45225), ("10.88.0.2", 40000), "ESTABLISHED", socket.AF_INET, uid=1000, inode=77, id=BODY[4:52]
)
FOUND: Final = bytes.fromhex("58000000 1400 0200 05000000 d2040000") + BODY
DONE: Final = bytes.fromhex("14000000 0300 0200 05000000 d2040000 00000000")
REFUSED: Final = bytes.fromhex("24000000 0200 0000 05000000 d2040000 ffffffff") + bytes(16)
TAKEN: Final = bytes.fromhex("24000000 0200 0001 05000000 d2040000 00000000") + bytes(16)


@little_endian
def test_golden_query_for_a_dump() -> None:
    head, rest = bytes.fromhex("02 06 00 00 02040000 b0a9 9c40"), bytes(36) + b"\xff" * 8
    states = 1 << 10 | 1 << 1
    assert dump_query(socket.AF_INET, states, 45225, 40000) == head + rest
    # linux/inet_diag.h: INET_DIAG_BC_D_COND, family, prefix and port (-1: any) of the condition, and the address.
    program = bytes.fromhex("1400 0100 08 10 1400 02 20 0000 ffffffff 0a580002")
    assert dump_query(socket.AF_INET, states, 45225, 40000, bytes([10, 88, 0, 2])) == head + rest + program


@little_endian
def test_golden_query_to_end_a_socket() -> None:
    assert destroy_query(SOCKET) == bytes.fromhex("02 06 00 00 00000000") + BODY[4:52]


@little_endian
def test_golden_answers() -> None:
    found: list[bytes] = []
    assert read_answer(FOUND + FOUND, found, 5), "more parts follow"
    assert not read_answer(FOUND + DONE, found, 5)
    assert [TcpSocket.parse(body) for body in found] == [SOCKET] * 3
    assert not read_answer(TAKEN, found, 5)
    with pytest.raises(PermissionError):
        read_answer(REFUSED, found, 5)


@little_endian
def test_attributes_behind_a_socket_are_skipped() -> None:
    found: list[bytes] = []
    with_attribute = bytes.fromhex("5d000000") + FOUND[4:] + bytes.fromhex("0500080000")
    assert not read_answer(with_attribute + bytes(3) + DONE, found, 5), (
        "the next message begins at a multiple of four"
    )
    assert found == [BODY]


@little_endian
def test_an_error_ends_a_dump() -> None:
    with pytest.raises(PermissionError):
        read_answer(REFUSED, [], 5)
    with pytest.raises(OSError, match="No buffer space") as raised:
        read_answer(DONE[:-4] + struct.pack("=i", -errno.ENOBUFS), [], 5)
    assert raised.value.errno == errno.ENOBUFS
    assert not read_answer(b"\x10\0\0\0" + DONE[4:16], [], 5), "some kernels give no status"


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
        "an error without its number",
        "a positive number",
        "no number of an error",
        "no number of an error at the end",
    ],
)
def test_malformed_answers_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError):
        read_answer(data, [], 5)


@little_endian
def test_an_answer_to_another_request_is_refused() -> None:
    with pytest.raises(ValueError, match="request 5, not 6"):
        read_answer(FOUND, [], 6)


@little_endian
def test_an_interrupted_dump_is_no_answer() -> None:
    with pytest.raises(InterruptedError):
        read_answer(FOUND[:6] + b"\x12\0" + FOUND[8:], [], 5)


@given(st.binary(min_size=72, max_size=72))
def test_any_body_is_read_and_its_socket_named_as_the_kernel_did(body: bytes) -> None:
    of = TcpSocket.parse(body)
    assert destroy_query(of)[8:] == body[4:52]


class Interrupting:
    """Stands for ``read_answer`` of a kernel whose table changes during the first dumps."""

    def __init__(self, times: int) -> None:
        self.times = times

    def __call__(self, data: bytes, found: list[bytes], sequence: int) -> bool:
        if self.times:
            self.times -= 1
            raise InterruptedError(errno.EINTR, "changed")
        return read_answer(data, found, sequence)


def test_an_interrupted_dump_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening, open_netlink() as kernel:
        query = dump_query(socket.AF_INET, 1 << 10, listening.getsockname()[1])
        monkeypatch.setattr(kernel_tcp, "read_answer", Interrupting(limits.SOCK_DIAG_DUMPS - 1))
        (body,) = dump(kernel, query)
        assert TcpSocket.parse(body).local == listening.getsockname()
        monkeypatch.setattr(kernel_tcp, "read_answer", Interrupting(limits.SOCK_DIAG_DUMPS))
        with pytest.raises(InterruptedError):
            dump(kernel, query)
    with socket.create_server(("127.0.0.1", 0)) as listening, open_netlink() as kernel:
        query = dump_query(socket.AF_INET, 1 << 10, listening.getsockname()[1])
        monkeypatch.setattr(kernel_tcp, "read_answer", Interrupting(1))
        (body,) = dump(kernel, query)
        assert TcpSocket.parse(body).local == listening.getsockname(), "nothing is left of the interrupted dump"
