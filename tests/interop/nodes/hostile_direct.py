"""Be a hostile peer of direct transport: false endpoints, floods of requests, storms of notifications.

hostile_direct.py ADDRESS GUID — ADDRESS is this host's, GUID that of the agent under test, which has a subscriber of
/evil and a publisher /speaker of /to_b. Run by the interpreter that rmpa is installed for. Event: ``done``.
"""

import json
import socket
import sys
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import msgspec
from hostile_peer import Link, say

from rmpa.bridge.direct.conditions import DirectAsk
from rmpa.bridge.messages import Advertise, TopicOffer, encode
from rmpa.core.contract import Contract, Transport
from rmpa.core.identity import Guid
from rmpa.mesh.frames import Frame, FrameKind

AUTO = Contract(transport=Transport.AUTO)
EVIL = {"name": "/evil", "node": "/eve", "user": "/gullible"}
OPEN = msgspec.to_builtins(DirectAsk("/to_b", "/speaker", "/viewer", AUTO))


def tell(link: Link, what: str, args: dict[str, Any]) -> None:
    """Send a notification."""
    link.send(FrameKind.CONTROL, json.dumps({"op": "tell", "what": what, "args": args}).encode())


def ask(link: Link, number: int, args: dict[str, Any]) -> bytes:
    """The frame of a ``direct.topic``."""
    message = {"op": "ask", "number": number, "what": "direct.topic", "args": args}
    return Frame(FrameKind.CONTROL, json.dumps(message).encode(), 0, 1, 1).serialize()


def controls(link: Link, seconds: float) -> Iterator[dict[str, Any]]:
    """The control messages that come, for so many seconds."""
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0:
        link.sock.settimeout(left)
        try:
            frame = link.frame()
        except TimeoutError:
            return
        finally:
            link.sock.settimeout(20.0)  # what is sent next may wait for a busy agent
        if frame.kind is FrameKind.CONTROL:
            yield json.loads(frame.payload)
        elif frame.kind is FrameKind.PING:
            link.send(FrameKind.PONG, frame.stamp_ns.to_bytes(8, "big") * 2)


def offer(link: Link) -> None:
    """Offer the topic that a node of the agent under test subscribes to."""
    link.send(FrameKind.CONTROL, encode(Advertise((TopicOffer("/evil", "/eve", "std_msgs/String"),), full=True)))


def false_endpoints(here: str, victim: Guid) -> int:
    """Grant what is no endpoint; return how often the subscriber was relayed all the same."""
    with socket.create_server((here, 0)) as program:
        port = program.getsockname()[1]
        service = "/eve/get_loggers"
        answers: list[Any] = [
            *({"port": port, "probe": service} for port in (0, -1, 65536, 1 << 70, "45225", True, None, 45225.5)),
            {"port": 11311, "probe": service},
            {"port": 11311, "probe": service, "address": "127.0.0.1", "host": victim.endpoint[0]},
            {"port": port, "probe": service},  # a program that says nothing
            {"port": 1, "probe": service},
            {"why": "\x1b[2J\n", "text": "\x1b[31mred\n" * 10_000},
            {},
            [],
            "x" * 100_000,
        ]
        relayed = 0
        for number, answer in enumerate(answers):
            link = Link(here, victim, 21_000 + number)
            offer(link)
            asked = False
            for message in controls(link, 15.0):
                if message["op"] == "ask" and message["what"] == "direct.topic":
                    asked = True
                    reply = {"op": "answer", "number": message["number"], "ok": True, "value": answer}
                    link.send(FrameKind.CONTROL, json.dumps(reply).encode())
                elif message["op"] == "open" and asked:
                    relayed += 1
                    break
            link.sock.close()
        program.setblocking(False)
        return relayed if len(answers) == 16 else -1


def flood(here: str, victim: Guid) -> Counter[str]:
    """Ask for more than a peer may have, for what is not there, and with names that are none."""
    link, found, number = Link(here, victim, 22_000), Counter[str](), 0
    offer(link)

    def asked(many: list[dict[str, Any]], key: str) -> None:
        nonlocal number
        link.sock.sendall(b"".join(ask(link, number + k, args) for k, args in enumerate(many, 1)))
        number += len(many)
        waits = len(many)
        for message in controls(link, 20.0):
            if message["op"] == "answer":
                waits -= 1
                value = message["value"] or {}
                found[f"{key} {'granted' if 'port' in value else value.get('why', 'error')}"] += 1
                if not waits:
                    return

    for start in range(0, 1500, 30):
        asked([OPEN | {"user": f"/s{start + k}"} for k in range(30)], "many")
    for start in range(0, 3000, 30):
        asked([OPEN | {"name": f"/none{start + k}"} for k in range(30)], "none")
    asked([OPEN | {"user": f"/q{k}"} for k in range(2000)], "at once")
    asked(
        [OPEN | bad for bad in ({"user": "/a\n"}, {"name": "/\x1b[2J"}, {"contract": 5}, {"node": None})],
        "bad",
    )
    for k in range(3000):
        tell(link, "direct.topic_release", {"name": "/to_b", "node": "/speaker", "user": f"/s{k}"})
    found["lived"] = link.outlives()
    link.sock.close()
    return found


def storm(here: str, victim: Guid) -> int:
    """Thousands of notifications; return how often the agent under test asked in some seconds."""
    link = Link(here, victim, 23_000)
    offer(link)
    asks = 0
    ends = time.monotonic() + 4.0
    while time.monotonic() < ends:
        for _ in range(150):
            tell(link, "direct.topic_again", EVIL)
        for message in controls(link, 0.02):
            if message["op"] == "ask" and message["what"] == "direct.topic":
                asks += 1
                answer = {"why": "caller_id", "text": "another"}
                reply = {"op": "answer", "number": message["number"], "ok": True, "value": answer}
                link.send(FrameKind.CONTROL, json.dumps(reply).encode())
    link.sock.settimeout(5.0)
    assert link.outlives()
    link.sock.close()
    return asks


def malformed(here: str, victim: Guid) -> int:
    """Notifications that no agent sends, each on a link of its own; return how many of them ended their link."""
    bad: list[tuple[str, dict[str, Any]]] = [
        ("direct.topic_again", {}),
        ("direct.topic_again", EVIL | {"user": "/a\n"}),
        ("direct.topic_again", EVIL | {"name": "/" + "x" * 1_000_000}),
        ("direct.topic_again", EVIL | {"name": "evil"}),
        ("direct.topic_release", {"name": 1, "node": 2, "user": 3}),
    ]
    ended = 0
    for number, (what, args) in enumerate(bad):
        link = Link(here, victim, 24_000 + number)
        tell(link, what, args)
        deadline = time.monotonic() + 5.0
        while link.outlives():
            if time.monotonic() > deadline:
                break
        else:
            ended += 1
        link.sock.close()
    return ended


def main() -> None:
    here, guid = sys.argv[1:]
    victim = Guid.parse(guid)
    relayed = false_endpoints(here, victim)
    answers = flood(here, victim)
    asks = storm(here, victim)
    say(relayed=relayed, asks=asks, ended=malformed(here, victim), **answers)


if __name__ == "__main__":
    main()
