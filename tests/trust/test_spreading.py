"""Documents reach every module: pairs, and a mesh of 16 that splits and heals, as messages between machines."""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field

import pytest

from rmpa.bridge.messages import Notification, decode, encode
from rmpa.core.errors import RemoteProtocolError
from rmpa.trust.permissions import DOCUMENTS, DocumentSpreading, Notice, have_args, read_document, read_have


@dataclass
class Module:
    """One module: its documents are their numbers."""

    place: int
    numbers: dict[Notice, int] = field(default_factory=lambda: dict.fromkeys(DOCUMENTS, 0))

    def __post_init__(self) -> None:
        self.spreading = DocumentSpreading(self.numbers.__getitem__)


class Mesh:
    """Modules, their links, and messages that are under way, in any order between links."""

    def __init__(self, count: int, seed: int) -> None:
        self.modules = [Module(i) for i in range(count)]
        self.links: set[tuple[int, int]] = set()
        self.queues: dict[tuple[int, int], deque[tuple[Notice, object]]] = {}
        self.random = random.Random(seed)
        self.sent = 0

    def link(self, a: int, b: int) -> None:
        for one, other in ((a, b), (b, a)):
            self.links.add((one, other))
            self.modules[one].spreading.link_up(other)
            self.send(one, other, Notice.HAVE, have_args(self.modules[one].numbers.__getitem__, is_authority=False))

    def unlink(self, a: int, b: int) -> None:
        for one, other in ((a, b), (b, a)):
            self.links.discard((one, other))
            self.queues.pop((one, other), None)
            self.modules[one].spreading.link_down(other)

    def send(self, a: int, b: int, kind: Notice, content: object) -> None:
        self.sent += 1
        self.queues.setdefault((a, b), deque()).append((kind, content))

    def issue(self, at: int, kind: Notice) -> None:
        self.modules[at].numbers[kind] += 1
        self.spread(at)

    def spread(self, at: int) -> None:
        for peer, kinds in self.modules[at].spreading.changed():
            for kind in kinds:
                self.send(at, peer, kind, self.modules[at].numbers[kind])

    def run(self) -> None:
        while waiting := [pair for pair, queue in self.queues.items() if queue]:
            sender, receiver = self.random.choice(waiting)
            kind, content = self.queues[sender, receiver].popleft()
            module = self.modules[receiver]
            if kind is Notice.HAVE:
                assert isinstance(content, dict)
                for lacking in module.spreading.have(sender, read_have(content)[0]):
                    self.send(receiver, sender, lacking, module.numbers[lacking])
            elif isinstance(content, int) and content > module.numbers[kind]:
                module.numbers[kind] = content
                module.spreading.received(sender, kind, content)
                self.spread(receiver)


@pytest.mark.parametrize("seed", range(20))
def test_a_mesh_that_was_split_agrees_once_it_is_whole(seed: int) -> None:
    mesh = Mesh(16, seed)
    half = range(8)
    for a in range(16):
        for b in range(a):
            mesh.link(a, b)
    mesh.run()
    for a in half:
        for b in range(8, 16):
            mesh.unlink(a, b)
    mesh.issue(0, Notice.DENY)
    mesh.issue(0, Notice.KEYS)
    mesh.run()
    assert [module.numbers[Notice.DENY] for module in mesh.modules] == [1] * 8 + [0] * 8
    mesh.link(3, 12)  # one cable is back
    mesh.run()
    assert all(module.numbers == {Notice.DENY: 1, Notice.KEYS: 1} for module in mesh.modules)


def test_a_change_costs_a_message_or_two_for_each_link() -> None:
    mesh = Mesh(16, 1)
    for a in range(16):
        for b in range(a):
            mesh.link(a, b)
    mesh.run()
    before = mesh.sent
    mesh.issue(0, Notice.DENY)
    mesh.run()
    assert all(module.numbers[Notice.DENY] == 1 for module in mesh.modules)
    assert mesh.sent - before <= 16 * 15
    before = mesh.sent
    mesh.spread(5)
    assert mesh.sent == before  # all have it


def test_a_deny_list_goes_before_the_keys() -> None:
    arm = Module(0, {Notice.DENY: 3, Notice.KEYS: 2})
    arm.spreading.link_up(7)
    assert arm.spreading.have(7, {Notice.DENY: 0, Notice.KEYS: 0}) == (Notice.DENY, Notice.KEYS)
    assert arm.spreading.have(7, {Notice.DENY: 0, Notice.KEYS: 0}) == ()  # they are under way
    assert arm.spreading.have(8, {Notice.DENY: 0, Notice.KEYS: 0}) == ()  # not linked any more


def test_golden_bytes_of_the_notifications() -> None:
    numbers = {Notice.DENY: 7, Notice.KEYS: 3}
    for args, golden in (
        (
            have_args(numbers.__getitem__, is_authority=False),
            b'{"op":"tell","what":"trust.have","args":{"deny":7,"keys":3}}',
        ),
        (
            have_args(numbers.__getitem__, is_authority=True),
            b'{"op":"tell","what":"trust.have","args":{"deny":7,"keys":3,"authority":true}}',
        ),
    ):
        assert encode(Notification(Notice.HAVE, args)) == golden
        message = decode(golden)
        assert isinstance(message, Notification)
        assert read_have(message.args) == (numbers, "authority" in args)
    golden = b'{"op":"tell","what":"trust.deny","args":{"document":"{}"}}'
    assert encode(Notification(Notice.DENY, {"document": "{}"})) == golden
    assert read_document({"document": "{}"}) == b"{}"


@pytest.mark.parametrize(
    "args",
    [
        {},
        {"deny": 1},
        {"deny": -1, "keys": 1},
        {"deny": True, "keys": 1},
        {"deny": "1", "keys": 1},
        {"deny": 1 << 32, "keys": 1},
    ],
)
def test_malformed_notifications_are_refused(args: dict[str, object]) -> None:
    with pytest.raises(RemoteProtocolError):
        read_have(args)
    with pytest.raises(RemoteProtocolError):
        read_document(args)
