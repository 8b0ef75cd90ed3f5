"""The kernel's TCP sockets, with real ones: where they listen, what is connected, and how it is ended."""

from __future__ import annotations

import errno
import os
import select
import socket
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.runtime import kernel_tcp
from rmpa.runtime.accept import raise_file_limit
from rmpa.runtime.kernel_tcp import (
    TcpSocket,
    ask_listening_ports,
    connections,
    end_connections,
    listening_addresses,
    may_end_connections,
    try_to_end,
)
from tests.runtime.capabilities import NET_ADMIN, without

if TYPE_CHECKING:
    from collections.abc import Iterator

DEADLINE: Final = 30.0

pytestmark = pytest.mark.skipif(ask_listening_ports() is None, reason="this kernel does not report its sockets")
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


def test_states_while_a_connection_closes(stack: ExitStack) -> None:
    listener = listen(stack)
    port = listener.getsockname()[1]
    client, server = pair(stack, listener)
    client.shutdown(socket.SHUT_WR)
    server.recv(1)
    assert [of.state for of in seen(local_port=port)] == ["CLOSE_WAIT"]
    (found,) = seen(remote=("127.0.0.1", port))
    assert found.state in ("FIN_WAIT1", "FIN_WAIT2"), "1 until the other end has acknowledged"


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


def test_a_kernel_that_does_not_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise OSError(errno.EPROTONOSUPPORT, "Protocol not supported")

    monkeypatch.setattr(kernel_tcp, "open_netlink", refuse)
    assert ask_listening_ports() is None
    assert listening_addresses(11311) is None
    assert connections() is None


@pytest.mark.usefixtures("untried")
async def test_all_may_be_called_in_the_event_loop(stack: ExitStack) -> None:
    """``no_blocking`` of tests/conftest.py raises where one blocks."""
    port = listen(stack).getsockname()[1]
    may_end_connections()
    assert listening_addresses(port) == frozenset({"127.0.0.1"})
    assert seen(local_port=port) == []
    assert end_connections([]) == 0


# --- ending -----------------------------------------------------------------------------------------------------


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


@pytest.mark.usefixtures("untried")
def test_a_kernel_that_only_pretends_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_tcp, "end_connections", len)
    assert "did not end a connection" in may_end_connections()


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
