"""The kernel's table of TCP sockets: its bytes, and what it tells and ends."""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.runtime import kernel_tcp, limits
from rmpa.runtime.accept import raise_file_limit
from rmpa.runtime.kernel_tcp import (
    TcpSocket,
    ask_listening_ports,
    connections,
    destroy_query,
    dump,
    dump_query,
    end_connections,
    listening_addresses,
    may_end_connections,
    open_netlink,
    read_answer,
    try_to_end,
)
from tests.runtime.capabilities import NET_ADMIN, without

DEADLINE: Final = 30.0

ends = pytest.mark.skipif(bool(may_end_connections()), reason=f"no SOCK_DESTROY: {may_end_connections()}")


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


@pytest.fixture
def untried() -> Iterator[None]:
    """It is not known, nor afterwards, whether connections can be ended."""
    try_to_end.cache_clear()
    yield
    try_to_end.cache_clear()


def listen(stack: ExitStack, address: str = "127.0.0.1", port: int = 0) -> socket.socket:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    return stack.enter_context(socket.create_server((address, port), family=family, backlog=4096))


def pair(stack: ExitStack, listener: socket.socket) -> tuple[socket.socket, socket.socket]:
    client = stack.enter_context(socket.create_connection(("127.0.0.1", listener.getsockname()[1])))
    return client, stack.enter_context(listener.accept()[0])


def seen(*, local_port: int | None = None, remote: tuple[str, int | None] | None = None) -> list[TcpSocket]:
    found = connections(local_port=local_port, remote=remote)
    assert found is not None
    return found


# --- looking ----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
def test_addresses_where_sockets_listen(stack: ExitStack) -> None:
    one = listen(stack)
    port = one.getsockname()[1]
    assert listening_addresses(port) == frozenset({"127.0.0.1"})
    listen(stack, "127.0.0.2", port)
    client, _ = pair(stack, one)
    assert listening_addresses(port) == frozenset({"127.0.0.1", "127.0.0.2"})
    assert listening_addresses(client.getsockname()[1]) == frozenset(), "a connected socket does not listen"
    everywhere = listen(stack, "0.0.0.0").getsockname()[1]
    assert listening_addresses(everywhere) == frozenset({"0.0.0.0"})
    for impossible in (0, -1, 65536):
        assert listening_addresses(impossible) == frozenset()


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="no IPv6 here")
def test_ipv4_addresses_of_ipv6_sockets_are_told_as_ipv4(stack: ExitStack) -> None:
    both = stack.enter_context(socket.create_server(("::", 0), family=socket.AF_INET6, dualstack_ipv6=True))
    port = both.getsockname()[1]
    assert listening_addresses(port) == frozenset({"::"})
    client, server = pair(stack, both)
    (found,) = seen(remote=client.getsockname())
    assert (found.family, found.local, found.remote) == (socket.AF_INET6, ("127.0.0.1", port), client.getsockname())
    assert found.inode == os.fstat(server.fileno()).st_ino
    mapped = stack.enter_context(socket.socket(socket.AF_INET6))
    mapped.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
    mapped.bind(("::ffff:127.0.0.1", 0))
    mapped.listen()
    assert listening_addresses(mapped.getsockname()[1]) == frozenset({"127.0.0.1"})
    six = stack.enter_context(socket.create_connection(("::1", port)))
    assert [of.remote for of in seen(remote=("::1", port))] == [("::1", port)]
    assert [of.local[1] for of in seen(remote=("::1", None), local_port=six.getsockname()[1])] == [
        six.getsockname()[1]
    ]


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
def test_connections_are_found_by_either_end(stack: ExitStack) -> None:
    listener = listen(stack)
    port = listener.getsockname()[1]
    client, server = pair(stack, listener)
    other, _ = pair(stack, listener)
    (found,) = seen(remote=client.getsockname())
    assert (found.local, found.remote) == (server.getsockname(), client.getsockname())
    assert (found.state, found.uid, found.family) == ("ESTABLISHED", os.getuid(), socket.AF_INET)
    assert found.inode == os.fstat(server.fileno()).st_ino
    at_port = seen(local_port=port)
    assert {of.remote for of in at_port} == {client.getsockname(), other.getsockname()}
    assert {of.local for of in seen(remote=("127.0.0.1", port))} == {
        client.getsockname(),
        other.getsockname(),
    }
    assert len({of.id for of in at_port}) == 2
    assert seen(remote=("127.0.0.9", None)) == []
    assert seen(local_port=port, remote=("127.0.0.9", None)) == []
    every = seen()
    assert {client.getsockname(), server.getsockname()} <= {of.local for of in every}
    for impossible in (0, 65536):
        assert seen(local_port=impossible) == []
        assert seen(remote=("127.0.0.1", impossible)) == []
    with pytest.raises(ValueError, match="is no IP address"):
        seen(remote=("localhost", None))


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
def test_states_while_a_connection_closes(stack: ExitStack) -> None:
    listener = listen(stack)
    port = listener.getsockname()[1]
    client, server = pair(stack, listener)
    client.shutdown(socket.SHUT_WR)
    server.recv(1)
    assert [of.state for of in seen(local_port=port)] == ["CLOSE_WAIT"]
    (found,) = seen(remote=("127.0.0.1", port))
    assert found.state in ("FIN_WAIT1", "FIN_WAIT2"), "1 until the other end has acknowledged"


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
def test_a_dump_of_thousands_is_complete(stack: ExitStack) -> None:
    count = 2000
    if raise_file_limit() < count + 200:
        pytest.skip("this process may not open so many files")
    listeners = [listen(stack) for _ in range(20)]
    clients = [
        stack.enter_context(socket.create_connection(listeners[number % 20].getsockname())) for number in range(count)
    ]
    found = Counter((of.local, of.remote) for of in seen())
    for client in clients:
        assert found[client.getsockname(), client.getpeername()] == 1
        assert found[client.getpeername(), client.getsockname()] == 1, "not accepted yet"
    ports = {listener.getsockname()[1] for listener in listeners}
    assert ports <= (ask_listening_ports() or set())


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
def test_a_kernel_that_does_not_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise OSError(errno.EPROTONOSUPPORT, "Protocol not supported")

    monkeypatch.setattr(kernel_tcp, "open_netlink", refuse)
    assert ask_listening_ports() is None
    assert listening_addresses(11311) is None
    assert connections() is None


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@pytest.mark.usefixtures("untried")
async def test_all_may_be_called_in_the_event_loop(stack: ExitStack) -> None:
    """``no_blocking`` of tests/conftest.py raises where one blocks."""
    port = listen(stack).getsockname()[1]
    may_end_connections()
    assert listening_addresses(port) == frozenset({"127.0.0.1"})
    assert seen(local_port=port) == []
    assert end_connections([]) == 0


# --- ending -----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@ends
def test_only_the_named_connections_are_ended(stack: ExitStack) -> None:
    listener = listen(stack)
    pairs = [pair(stack, listener) for _ in range(3)]
    client, server = pairs[1]
    found = seen(remote=client.getsockname())
    assert len(found) == 1
    assert end_connections(found) == 1
    with pytest.raises(ConnectionAbortedError):
        server.recv(1)
    client.settimeout(DEADLINE)
    with pytest.raises(ConnectionResetError):
        client.recv(1)
    assert end_connections(found) == 0, "it is gone already, which is no error"
    for near, far in (pairs[0], pairs[2]):
        far.send(b"x")
        near.settimeout(DEADLINE)
        assert near.recv(1) == b"x"


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@ends
def test_a_writer_that_waits_for_a_full_socket_is_released(stack: ExitStack) -> None:
    """As a rospy publisher without queue_size waits for the subscriber of a host that vanished."""
    reader, writer = pair(stack, listen(stack))
    with ThreadPoolExecutor(1) as thread:
        sent = thread.submit(writer.sendall, bytes(256 << 20))
        until = time.monotonic() + DEADLINE
        while select.select([], [writer], [], 0)[1]:
            assert time.monotonic() < until, "the socket never became full"
        assert not sent.done()
        assert end_connections(seen(remote=reader.getsockname())) == 1
        with pytest.raises(ConnectionAbortedError):
            sent.result(DEADLINE)


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@ends
@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="no IPv6 here")
def test_connections_of_ipv6_sockets_are_ended(stack: ExitStack) -> None:
    both = stack.enter_context(socket.create_server(("::", 0), family=socket.AF_INET6, dualstack_ipv6=True))
    client, server = pair(stack, both)
    six = stack.enter_context(socket.create_connection(("::1", both.getsockname()[1])))
    server_six = stack.enter_context(both.accept()[0])
    assert end_connections(seen(local_port=both.getsockname()[1])) == 2
    for sock in (server, server_six):
        with pytest.raises(ConnectionAbortedError):
            sock.recv(1)
    for sock in (client, six):
        sock.settimeout(DEADLINE)
        with pytest.raises(ConnectionResetError):
            sock.recv(1)


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@ends
def test_a_connection_to_a_host_that_does_not_answer_is_ended(stack: ExitStack) -> None:
    """SYN_SENT: the listen queue is full, so that the kernel answers nothing."""
    listener = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
    first = stack.enter_context(socket.create_connection(listener.getsockname()))
    waiting = stack.enter_context(socket.socket())
    waiting.setblocking(False)
    waiting.connect_ex(listener.getsockname())
    found = seen(local_port=waiting.getsockname()[1])
    assert [of.state for of in found] == ["SYN_SENT"]
    assert end_connections(found) == 1
    assert waiting.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == errno.ECONNABORTED
    assert first.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0


WAITS = """
import socket, sys
sock = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
print(flush=True)
try:
    sock.sendall(bytes(256 << 20))
except OSError as error:
    print(type(error).__name__, flush=True)
"""


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@ends
def test_without_the_capability_those_of_the_same_user_are_ended(stack: ExitStack) -> None:
    """A node that waits in ``send`` goes on, and what the kernel still had for it is not sent later."""
    listener = listen(stack)
    words = [sys.executable, "-c", WAITS, str(listener.getsockname()[1])]
    node = stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE, text=True))
    assert node.stdout is not None
    node.stdout.readline()
    server = stack.enter_context(listener.accept()[0])
    port = server.getpeername()[1]
    found = seen(local_port=port)
    assert without(NET_ADMIN, lambda: end_connections(found)) == 1
    assert node.stdout.readline() in {"ConnectionResetError\n", "BrokenPipeError\n"}
    assert seen(local_port=port) == []


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@ends
@pytest.mark.usefixtures("untried")
def test_without_the_capability_those_of_others_are_not_ended(stack: ExitStack) -> None:
    client, server = pair(stack, listen(stack))
    found = [replace(of, uid=of.uid + 1) for of in seen(remote=client.getsockname())]
    with pytest.raises(PermissionError):
        without(NET_ADMIN, lambda: end_connections(found))
    problem, _, remedy = without(NET_ADMIN, may_end_connections).partition("; ")
    assert may_end_connections().partition("; ")[0] == problem, "it is tried once"
    assert problem.startswith("this process has no CAP_NET_ADMIN")
    assert "AmbientCapabilities=CAP_NET_ADMIN" in remedy
    assert "setcap" in remedy
    try_to_end.cache_clear()
    assert may_end_connections() == ""
    server.send(b"x")
    assert client.recv(1) == b"x"


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@pytest.mark.parametrize("number", [errno.EOPNOTSUPP, errno.EINVAL])
@pytest.mark.usefixtures("untried")
def test_a_kernel_that_cannot_end_connections(stack: ExitStack, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    client, _ = pair(stack, listen(stack))
    monkeypatch.setattr(kernel_tcp, "destroy", refuse)
    with pytest.raises(OSError, match="CONFIG_INET_DIAG_DESTROY") as raised:
        end_connections(seen(remote=client.getsockname()))
    assert raised.value.errno == errno.EOPNOTSUPP
    assert "CONFIG_INET_DIAG_DESTROY" in may_end_connections()


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@pytest.mark.usefixtures("untried")
def test_a_kernel_that_only_pretends_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_tcp, "end_connections", len)
    assert "did not end a connection" in may_end_connections()


@pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
@pytest.mark.usefixtures("untried")
def test_a_lack_of_file_descriptors_is_not_the_last_word(monkeypatch: pytest.MonkeyPatch) -> None:
    before = may_end_connections()

    def refuse(*_: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    try_to_end.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(socket.socket, "__init__", refuse)
        assert "Too many open files" in may_end_connections()
    assert may_end_connections() == before


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
