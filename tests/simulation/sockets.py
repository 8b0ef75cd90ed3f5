"""Simulated TCP: sockets that the real ``Stream`` and ``Mesh`` take for real ones.

Bytes arrive in order and in other pieces, each socket with a delay and room of its own, so that the lanes of one
link overtake each other. A parting stalls them as TCP would; what nobody acknowledges for too long ends a connection;
a packet for a socket that is closed is answered by a reset.
"""

from __future__ import annotations

import errno
from collections import deque
from itertools import count
from typing import TYPE_CHECKING, Final

from rmpa.core.limits import KIB
from rmpa.mesh.io.lane import LINK_UNACKED

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tests.simulation.network import Address, Network
    from tests.simulation.process import Process

Buffer = bytes | bytearray | memoryview

_RETRY: Final = 0.2
"""Seconds between two looks whether stalled bytes may go on, like TCP's retransmissions."""
_FIN: Final = b"FIN"
"""Which bytes object means the end, not which bytes."""
_descriptors = count(1000)


class SimSocket:
    """One end of a connection.

    Args:
        network: What it travels through.
        host: Whose it is.
        process: Who reads and writes it; ``None`` until it is accepted.
    """

    other: SimSocket

    def __init__(self, network: Network, host: str, process: Process | None) -> None:
        self.host = host
        self.process = process
        self.lane = 0
        """What it was dialled for."""
        self.closed = False
        self.in_flight = 0
        """Bytes that the other end has not got."""
        self._network = network
        self._fd = next(_descriptors)
        self._window = network.world.rng.choice([16 * KIB, 64 * KIB, 400 * KIB])
        self._slower = network.world.rng.choice(network.slowness)
        self._packets: deque[tuple[float, bytes]] = deque()
        self._pumping = False
        self._stalled: float | None = None
        self._got = bytearray()
        self._ended = False
        self._shut = False
        self._error: OSError | None = None
        self._black_hole = False
        self._mine()

    def give(self, process: Process) -> None:
        """It was accepted."""
        self.process = process
        self._mine()

    def _mine(self) -> None:
        if self.process is not None:
            self.process.on_reader[self._fd] = lambda: self._soon(self._wake_reader)
            self.process.on_writer[self._fd] = lambda: self._soon(self._wake_writer)

    # --- what a socket is asked ------------------------------------------------------------------------------

    def fileno(self) -> int:
        return self._fd

    def getsockname(self) -> tuple[str, int]:
        return self.host, 0

    def setblocking(self, _flag: bool) -> None:
        pass

    def setsockopt(self, *_: object) -> None:
        pass

    def getsockopt(self, *_: object) -> bytes:
        raise OSError(errno.ENOPROTOOPT, "this kernel does not say")

    def sendmsg(self, parts: Sequence[Buffer]) -> int:
        if self._error is not None:
            raise self._error
        if self.closed or self._shut:
            raise OSError(errno.EPIPE, "Broken pipe")
        room = self._window - self.in_flight
        if room <= 0:
            raise BlockingIOError
        taken = b"".join(parts)[:room]
        if taken:
            self.in_flight += len(taken)
            self._split(taken)
        return len(taken)

    def recv_into(self, view: memoryview) -> int:
        if self._got:
            size = min(len(view), len(self._got))
            view[:size] = self._got[:size]
            del self._got[:size]
            return size
        if self._error is not None:
            raise self._error
        if self._ended:
            return 0
        raise BlockingIOError

    def shutdown(self, _how: int) -> None:
        if not self._shut:
            self._shut = True
            self._push(_FIN)

    def close(self) -> None:
        if self.closed:
            return
        self.closed = True
        if self._got:
            self._reset_other()
        elif not self._shut:
            self._push(_FIN)
        if self.process is not None:
            self.process.on_reader.pop(self._fd, None)
            self.process.on_writer.pop(self._fd, None)
            self.process.readers.pop(self._fd, None)
            self.process.writers.pop(self._fd, None)
        self._network.connections.pop(self._fd, None)

    # --- what happens to it ----------------------------------------------------------------------------------

    def fail(self, code: int) -> None:
        """The connection is over for this end."""
        if self.closed or self._error is not None:
            return
        self._error = OSError(code, errno.errorcode[code])
        self._packets.clear()
        self._got.clear()
        self._soon(self._wake_reader)

    def kill(self) -> None:
        """Its process is gone; its kernel resets the connection."""
        if not self.closed:
            self.closed = True
            self._packets.clear()
            self._reset_other()
            self._network.connections.pop(self._fd, None)

    def kill_both(self) -> None:
        """Both ends are told that the connection is over."""
        self.fail(errno.ECONNRESET)
        self.other.fail(errno.ECONNRESET)

    def swallow(self) -> None:
        """Something on the way has forgotten this connection: nothing arrives any more, in either direction."""
        self._black_hole = self.other._black_hole = True

    def reaches(self) -> bool:
        """Whether packets to the other end arrive."""
        return not self._black_hole and self._network.reaches(self.host, self.other.host)

    # --- inside ----------------------------------------------------------------------------------------------

    def _split(self, data: bytes) -> None:
        rng = self._network.world.rng
        while data:
            size = len(data) if rng.random() < 0.7 else rng.randint(1, len(data))
            self._push(data[:size])
            data = data[size:]

    def _push(self, item: bytes) -> None:
        network = self._network
        when = network.world.now + network.delay() * self._slower
        while network.world.rng.random() < network.weather.loss:
            when += _RETRY
        if self._packets:
            when = max(when, self._packets[-1][0])
        self._packets.append((when, item))
        if not self._pumping:
            self._pumping = True
            network.world.at(when, self._pump)

    def _pump(self) -> None:
        world = self._network.world
        while self._packets and self._packets[0][0] <= world.now:
            if not self.reaches():
                self._stall()
                return
            self._stalled = None
            item = self._packets.popleft()[1]
            self.in_flight -= len(item) if item is not _FIN else 0
            if self.other.closed:
                self._packets.clear()
                world.after(self._network.delay(), lambda: self.fail(errno.ECONNRESET))
                break
            self.other._arrive(item)
        self._pumping = bool(self._packets)
        if self._pumping:
            world.at(self._packets[0][0], self._pump)
        self._wake_writer()

    def _stall(self) -> None:
        """TCP tries again; the socket's options say for how long."""
        world = self._network.world
        if self._stalled is None:
            self._stalled = world.now
        if world.now - self._stalled >= LINK_UNACKED:
            self._packets.clear()
            self._pumping = False
            self.fail(errno.ETIMEDOUT)
            return
        world.after(_RETRY, self._pump)

    def _arrive(self, item: bytes) -> None:
        if self._error is not None:
            return
        if item is _FIN:
            self._ended = True
        else:
            self._got += item
        self._wake_reader()

    def _reset_other(self) -> None:
        """Tell the other end, as soon as packets get there."""
        world, other = self._network.world, self.other

        def try_now() -> None:
            if other.closed:
                return
            if self.reaches():
                other.fail(errno.ECONNRESET)
            elif not self._black_hole:
                world.after(_RETRY, try_now)

        world.after(self._network.delay(), try_now)

    def _soon(self, action: Callable[[], None]) -> None:
        self._network.world.after(0.0, action)

    def _wake_reader(self) -> None:
        process = self.process
        while process is not None and (self._got or self._ended or self._error is not None):
            reader = process.readers.get(self._fd)
            if reader is None or process.dead or self.closed:
                return
            over = not self._got
            process.run(reader)
            if over:
                return

    def _wake_writer(self) -> None:
        process = self.process
        while process is not None and (self._error is not None or self.in_flight < self._window):
            writer = process.writers.get(self._fd)
            if writer is None or process.dead or self.closed:
                return
            process.run(writer)


class SimListener:
    """Where one agent accepts connections.

    Args:
        network: Where it is registered.
        address: Its own.
        process: Who accepts.
    """

    def __init__(self, network: Network, address: Address, process: Process) -> None:
        self.closed = False
        self._network = network
        self._address = address
        self._process = process
        self._fd = next(_descriptors)
        self._queue: deque[SimSocket] = deque()
        network.tcp[address] = self
        process.on_reader[self._fd] = self._wake

    def fileno(self) -> int:
        return self._fd

    def setblocking(self, _flag: bool) -> None:
        pass

    def accept(self) -> tuple[SimSocket, Address]:
        if not self._queue:
            raise BlockingIOError
        sock = self._queue.popleft()
        sock.give(self._process)
        return sock, (sock.other.host, 1)

    def close(self) -> None:
        self.closed = True
        if self._network.tcp.get(self._address) is self:
            del self._network.tcp[self._address]
        for sock in self._queue:
            sock.kill()

    def arrive(self, sock: SimSocket) -> None:
        """Somebody has connected."""
        self._queue.append(sock)
        self._wake()

    def _wake(self) -> None:
        reader = self._process.readers.get(self._fd)
        if self._queue and reader is not None:
            self._process.run(reader)


def connect(
    network: Network, process: Process, host: str, to: Address, on_done: Callable[[SimSocket | None], None]
) -> None:
    """Connect; ``on_done(None)`` if no process listens there, nothing at all while parted or walled off."""
    world = network.world

    def arrive() -> None:
        if to[0] in network.walled or not network.reaches(host, to[0]):
            return
        listener = network.tcp.get(to)
        if listener is None:
            world.after(network.delay(), lambda: on_done(None))
            return
        near, far = SimSocket(network, host, process), SimSocket(network, to[0], None)
        near.other, far.other = far, near
        network.connections[near.fileno()] = near
        network.connections[far.fileno()] = far
        listener.arrive(far)
        world.after(network.delay(), lambda: on_done(near))

    world.after(network.delay(), arrive)
