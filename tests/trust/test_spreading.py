"""Documents reach every module: pairs, and a mesh of 16 that splits and heals, as messages between machines."""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field

import msgspec
import pytest

from rmpa.bridge.messages import Notification, decode, encode
from rmpa.trust.permissions import HAVE, Document, DocumentSpreading, Have


def _have(numbers: dict[Document, int]) -> object:
    return msgspec.to_builtins(Have(numbers[Document.DENY], numbers[Document.KEYS]))


@dataclass
class Module:
    """One module: its documents are their numbers."""

    place: int
    numbers: dict[Document, int] = field(default_factory=lambda: dict.fromkeys(Document, 0))

    def __post_init__(self) -> None:
        self.spreading = DocumentSpreading(self.numbers.__getitem__)


class Mesh:
    """Modules, their links, and messages that are under way, in any order between links."""

    def __init__(self, count: int, seed: int) -> None:
        self.modules = [Module(i) for i in range(count)]
        self.links: set[tuple[int, int]] = set()
        self.queues: dict[tuple[int, int], deque[tuple[str, object]]] = {}
        self.random = random.Random(seed)
        self.sent = 0

    def link(self, a: int, b: int) -> None:
        for one, other in ((a, b), (b, a)):
            self.links.add((one, other))
            self.modules[one].spreading.link_up(other)
            self.send(one, other, HAVE, _have(self.modules[one].numbers))

    def unlink(self, a: int, b: int) -> None:
        for one, other in ((a, b), (b, a)):
            self.links.discard((one, other))
            self.queues.pop((one, other), None)
            self.modules[one].spreading.link_down(other)

    def send(self, a: int, b: int, kind: str, content: object) -> None:
        self.sent += 1
        self.queues.setdefault((a, b), deque()).append((kind, content))

    def issue(self, at: int, kind: Document) -> None:
        self.modules[at].numbers[kind] += 1
        self.spread(at)

    def spread(self, at: int) -> None:
        for peer, kind in self.modules[at].spreading.lacking():
            self.send(at, peer, kind, self.modules[at].numbers[kind])

    def run(self) -> None:
        while waiting := [pair for pair, queue in self.queues.items() if queue]:
            sender, receiver = self.random.choice(waiting)
            kind, content = self.queues[sender, receiver].popleft()
            module = self.modules[receiver]
            if kind == HAVE:
                module.spreading.has(sender, msgspec.convert(content, Have).numbers)
                self.spread(receiver)
                continue
            document = Document(kind)
            if isinstance(content, int) and content > module.numbers[document]:
                module.numbers[document] = content
                module.spreading.has(sender, {document: content})
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
    mesh.issue(0, Document.DENY)
    mesh.issue(0, Document.KEYS)
    mesh.run()
    assert [module.numbers[Document.DENY] for module in mesh.modules] == [1] * 8 + [0] * 8
    mesh.link(3, 12)  # one cable is back
    mesh.run()
    assert all(module.numbers == {Document.DENY: 1, Document.KEYS: 1} for module in mesh.modules)


def test_a_change_costs_a_message_or_two_for_each_link() -> None:
    mesh = Mesh(16, 1)
    for a in range(16):
        for b in range(a):
            mesh.link(a, b)
    mesh.run()
    before = mesh.sent
    mesh.issue(0, Document.DENY)
    mesh.run()
    assert all(module.numbers[Document.DENY] == 1 for module in mesh.modules)
    assert mesh.sent - before <= 16 * 15
    before = mesh.sent
    mesh.spread(5)
    assert mesh.sent == before  # all have it


def test_a_deny_list_goes_before_the_keys() -> None:
    arm = Module(0, {Document.DENY: 3, Document.KEYS: 2})
    arm.spreading.link_up(7)
    arm.spreading.has(7, {Document.DENY: 0, Document.KEYS: 0})
    assert arm.spreading.lacking() == [(7, Document.DENY), (7, Document.KEYS)]
    arm.spreading.has(7, {Document.DENY: 0, Document.KEYS: 0})
    assert arm.spreading.lacking() == []  # they are under way
    arm.spreading.has(8, {Document.DENY: 0, Document.KEYS: 0})
    assert arm.spreading.lacking() == []  # not linked any more


def test_golden_bytes_of_the_notifications() -> None:
    for have, golden in (
        (Have(7, 3), b'{"op":"tell","what":"trust.have","args":{"deny":7,"keys":3}}'),
        (Have(7, 3, True), b'{"op":"tell","what":"trust.have","args":{"deny":7,"keys":3,"authority":true}}'),
    ):
        assert encode(Notification(HAVE, msgspec.to_builtins(have))) == golden
        message = decode(golden)
        assert isinstance(message, Notification)
        assert msgspec.convert(message.args, Have) == have
    golden = b'{"op":"tell","what":"trust.deny","args":{"document":"{}"}}'
    assert encode(Notification(Document.DENY.notice, {"document": "{}"})) == golden


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
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(args, Have)
