"""Be a hostile peer: of the multicast group, or of a mesh port behind a handshake that it completed.

hostile_peer.py group ADDRESS GUID… — beacons to the group, sent from every address of this host; ADDRESS is the
victim's and the GUIDs are those of real peers. hostile_peer.py mesh ADDRESS GUID — links to the agent with this
GUID, breaks the protocol in one way a link. Run by the interpreter that rmpa is installed for. Event: ``done``.
"""

import contextlib
import json
import os
import random
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator

import psutil

from rmpa.bridge.messages import Advertise, Description, OpenRoute, RouteOpened, TopicOffer, encode
from rmpa.config import limits as config_limits
from rmpa.core import limits as core_limits
from rmpa.core.identity import Guid, Identity
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.frames import Frame, FrameKind, Hello

RNG = random.Random(7)
MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"


def say(**fields: object) -> None:
    """Tell the test."""
    print("@ " + json.dumps({"event": "done", **fields}), flush=True)


# --- the group --------------------------------------------------------------------------------------------------


def beacon(guid: Guid, name: str, kind: BeaconKind = BeaconKind.ANNOUNCE, domain: int = 0) -> bytes:
    """A valid beacon of an invented agent."""
    gossip = tuple(Guid.of(f"10.77.9.{RNG.randrange(1, 255)}", RNG.randrange(1, 65536)) for _ in range(8))
    identity = Identity(guid, RNG.randbytes(core_limits.INSTANCE_ID_BYTES), name, domain)
    return Beacon(kind, identity, 120_000, RNG.getrandbits(32), gossip).serialize()


def packets(real: list[Guid]) -> Iterator[bytes]:
    """Garbage, then lies about real peers, then 10,000 peers that do not exist."""
    good = beacon(Guid.of("10.77.0.200", 4000), "eve")
    for _ in range(50):
        yield RNG.randbytes(RNG.randrange(1400))
    for end in range(len(good)):
        yield good[:end]
    for size in (1201, 1400, 9000, 60_000):
        yield good + bytes(size - len(good))
    for version in (0, 3, 255):
        yield good[:4] + bytes([version]) + good[5:]
    yield beacon(Guid.of("10.77.0.200", 4000), "eve", domain=1)
    for guid in real:
        for kind in BeaconKind:
            yield beacon(guid, "eve", kind)
            yield beacon(Guid(guid.value + 1), "a", kind)
    for number in range(10_000):
        guid = Guid.of(f"10.77.{RNG.randrange(1, 9)}.{RNG.randrange(1, 255)}", RNG.randrange(1, 65536), number)
        yield beacon(guid, f"forged{number}")


def group(real: list[Guid]) -> None:
    """Send everything, each packet from the next of our addresses: a limit for each source is not enough."""
    found = psutil.net_if_addrs()
    mine = [a.address for a in found["eth0"] if a.family is socket.AF_INET]
    senders = []
    for address in mine:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((address, 0))
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(mine[0]))
        senders.append(sock)
    count = 0
    for data in packets(real):
        count += 1
        senders[count % len(senders)].sendto(data, (config_limits.MULTICAST_GROUP, config_limits.MULTICAST_PORT))
        if count % 100 == 0:
            time.sleep(0.03)
    say(packets=count, senders=len(senders))


# --- the mesh ---------------------------------------------------------------------------------------------------


class Link:
    """A link whose handshake was completed."""

    def __init__(self, here: str, there: Guid, port: int) -> None:
        self.sock = socket.create_connection(there.endpoint, 5.0)
        self.sock.settimeout(5.0)
        self.data = b""
        identity = Identity(Guid.of(here, port), os.urandom(core_limits.INSTANCE_ID_BYTES), "eve", 0)
        self.send(FrameKind.HELLO, Hello.of(identity, lease=60.0, expected=there).serialize())
        answer = self.frame()
        assert answer.kind is FrameKind.WELCOME, answer.payload

    def send(self, kind: FrameKind, payload: bytes, route: int = 0) -> None:
        """Send one frame."""
        self.sock.sendall(Frame(kind, payload, route, 1, 1).serialize())

    def frame(self) -> Frame:
        """The next frame that comes."""
        while (found := Frame.parse(self.data)) is None:
            chunk = self.sock.recv(1 << 16)
            if not chunk:
                raise EOFError
            self.data += chunk
        frame, end = found
        self.data = self.data[end:]
        return frame

    def outlives(self) -> bool:
        """Whether the other side still answers; reads away what came before."""
        with contextlib.suppress(OSError, EOFError):
            self.send(FrameKind.PING, b"")
            while self.frame().kind is not FrameKind.PONG:
                pass
            return True
        return False


def garbage(link: Link) -> None:
    link.sock.sendall(RNG.randbytes(100_000))


def unknown_routes(link: Link) -> None:
    for route in range(1, 10_000):  # 0 carries large requests
        link.send(FrameKind.DATA, struct.pack("<I", 3) + b"abc", route)


def no_request(link: Link) -> None:
    link.send(FrameKind.DATA, struct.pack("<I", 3) + b"abc", 0)


def wrong_length(link: Link) -> None:
    """Offer a topic that the agent under test subscribes to, and send on its route what is not a message."""
    link.send(FrameKind.CONTROL, encode(Advertise((TopicOffer("/evil", "/eve", "std_msgs/String"),), full=True)))
    while True:
        frame = link.frame()
        if frame.kind is FrameKind.CONTROL and json.loads(frame.payload)["op"] == "open":
            break
        if frame.kind is FrameKind.PING:
            link.send(FrameKind.PONG, struct.pack(">QQ", frame.stamp_ns, frame.stamp_ns))
    route = json.loads(frame.payload)["route"]
    link.send(
        FrameKind.CONTROL, encode(RouteOpened(route, Description("std_msgs/String", MD5, "string data\n", False)))
    )
    link.send(FrameKind.DATA, struct.pack("<I", 6) + struct.pack("<I", 2) + b"ok", route)
    link.send(FrameKind.DATA, struct.pack("<I", 0xFFFFFF) + b"short", route)


def control(text: bytes) -> Callable[[Link], None]:
    def send(link: Link) -> None:
        link.send(FrameKind.CONTROL, text)

    return send


def offer(topic: str, node: str = "/n", kind: str = "a/B") -> Callable[[Link], None]:
    return control(encode(Advertise((TopicOffer(topic, node, kind),), full=True)))


def huge_frame(link: Link) -> None:
    link.sock.sendall(struct.pack(">IBBHIIQ", 0xFFFFFFFF, FrameKind.DATA, 3, 0, 1, 1, 1))


def opens_of_nothing(link: Link) -> None:
    """100,000 requests whose answers are not read."""
    one = [Frame(FrameKind.CONTROL, encode(OpenRoute(n, "/none", "/none"))).serialize() for n in range(1, 1001)]
    for _ in range(100):
        link.sock.sendall(b"".join(one))


def opens_of_one(link: Link) -> None:
    """100,000 requests for one real source: it must not be sent 100,000 times."""
    for start in range(1, 100_001, 1000):
        many = (OpenRoute(n, "/to_b", "/speaker") for n in range(start, start + 1000))
        link.sock.sendall(b"".join(Frame(FrameKind.CONTROL, encode(o)).serialize() for o in many))
    link.sock.settimeout(20.0)


def many_nodes(link: Link) -> None:
    """Offer more nodes than a peer may have. They are taken in a little at a time, while the link is alive."""
    link.send(
        FrameKind.CONTROL, encode(Advertise(tuple(TopicOffer("/many", f"/n{n}", "a/B") for n in range(16_000))))
    )


# Each with whether the link survives; ``None``: that depends on how fast it is.
ATTACKS: tuple[tuple[Callable[[Link], None], bool | None], ...] = (
    (garbage, False),
    (unknown_routes, True),
    (no_request, False),
    (wrong_length, False),
    (control(b"[" * 100_000), False),
    (control(b"{" + RNG.randbytes(100_000)), False),
    (control(b'"' + b"x" * (mesh_limits.CONTROL_PAYLOAD_MAX - 2) + b'"'), False),
    (offer("/" + "x" * 1_000_000), False),
    (offer("no_slash"), False),
    (offer("/a//b"), False),
    (offer("/t", "/n\n"), False),
    (offer("/t", "/n", "not a type"), False),
    (huge_frame, False),
    (opens_of_nothing, None),
    (opens_of_one, None),
    (many_nodes, True),
)


def mesh(here: str, victim: Guid) -> None:
    """Break each rule once, on a link of its own; the last link stays open until the test ends this process."""
    for number, (attack, survives) in enumerate(ATTACKS):
        link = Link(here, victim, 20_000 + number)
        with contextlib.suppress(ConnectionError):
            attack(link)
        lived = link.outlives()
        deadline = time.monotonic() + 5.0
        while survives is False and lived and time.monotonic() < deadline:
            lived = link.outlives()  # long control frames are read between other things, not at once
        assert survives in (None, lived), f"attack {number}: the link {'lives' if lived else 'is closed'}"
        if number == len(ATTACKS) - 1:
            say(attacks=len(ATTACKS))
            while link.outlives():  # how long it takes to take the last one in depends on the machine
                time.sleep(0.05)
        link.sock.close()


def main() -> None:
    what, here, *guids = sys.argv[1:]
    real = [Guid.parse(text) for text in guids]
    if what == "group":
        group(real)
    else:
        mesh(here, real[0])


if __name__ == "__main__":
    main()
