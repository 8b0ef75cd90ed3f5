"""What ``rmpa why`` is made of: stages with their evidence, and what either side knows of a topic."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import msgspec

from rmpa.observe.check import FAIL, Check

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.observe.snapshot import Snapshot


class Diagnosis(msgspec.Struct, frozen=True, kw_only=True):
    """One way from a publisher (or server) in one module to those who use it in another.

    Attributes:
        kind: ``topic`` or ``service``.
        name: The name in the graph of the module that diagnoses.
        peer: The module that it comes from.
        to: The module that it goes to.
        node: The publisher (server), by its name over there; empty where there is none.
        flows: Whether it gets through.
        stages: From the peer to the reader, up to the first that fails.
    """

    kind: str = "topic"
    name: str
    peer: str
    to: str
    node: str = ""
    flows: bool
    stages: tuple[Check, ...]

    @property
    def failed(self) -> Check | None:
        """The first stage that fails."""
        return next((stage for stage in self.stages if stage.level is FAIL), None)


class FarSource(msgspec.Struct, frozen=True, kw_only=True):
    """One publisher, as its own agent sees it.

    Attributes:
        node: Its name.
        topic: The topic's name in its own graph.
        type: Its message type; ``*`` where nobody has told it.
        crosses: Whether policy over there lets it cross to the one that asks.
        rule: The rule that says so.
        offered: Whether peers are told of it.
        route: What goes to the one that asks: empty (nothing), ``opening`` (its publisher has not answered) or
            ``open``.
        messages: That the agent has had of it since it connected.
        dropped: Of these, those given up because a link was too slow.
        lost: Messages of a reliable route to the one that asks that were given up, because it was away for too long.
        oversized: Messages that are too long, and were left out.
        oversized_bytes: The last one's.
        beyond: That module's ``limits.topics``, if it is not offered because there are more; else 0.
        unreachable: Why its agent cannot connect to its node, ready to read; empty where it can.
    """

    node: str
    topic: str = ""
    type: str = ""
    crosses: bool = True
    rule: str = ""
    offered: bool = True
    route: str = ""
    messages: int = 0
    dropped: int = 0
    lost: int = 0
    oversized: int = 0
    oversized_bytes: int = 0
    beyond: int = 0
    unreachable: str = ""


class FarTopic(msgspec.Struct, frozen=True, kw_only=True):
    """What the publishing side's agent answers.

    Attributes:
        sources: Its module's own publishers of the topic.
        subscribers: Its module's own subscribers.
        near: A topic over there of nearly this name, or empty.
        awaited: Nodes that published it before its agent was restarted, with their addresses, and do not answer now.
        path_problem: What is wrong with the path from there to the one that asks, ready to read; empty if nothing is
            known.
        path_remedy: What to do about that.
    """

    sources: tuple[FarSource, ...] = ()
    subscribers: tuple[str, ...] = ()
    near: str = ""
    awaited: tuple[str, ...] = ()
    path_problem: str = ""
    path_remedy: str = ""


class Reader(msgspec.Struct, frozen=True, kw_only=True):
    """A local subscriber that is connected to a proxy.

    Attributes:
        number: The proxy's own number for its connection.
        node: Its name.
        held: Whether it waits for the header: the route is not open yet.
        messages: Handed to its connection, dropped ones included.
        waiting: Bytes that wait for it to read.
        dropped: Messages given up because it read too slowly.
    """

    number: int
    node: str
    held: bool = False
    messages: int = 0
    waiting: int = 0
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class NearTopic:
    """What this side knows of one topic of one peer.

    Args:
        snapshot: The agent's, of this topic at least.
        topic: The topic's name here.
        carrier: The peer whose link brings it; another one where a relay passes it on.
        only: The carrier's nodes that are the peer's; ``None`` for all.
        proxies: What stands here for each node.
        registered: Nodes of the peer whose proxies are in the local graph as publishers of it.
        conflict: Nodes of the peer whose type is another one than that of the local publishers.
        readers: Who is connected to the proxy of each node of the peer.
        mismatches: Who was refused there or here, ready to read, by node of the peer.
    """

    snapshot: Snapshot
    topic: str
    carrier: str = ""
    only: frozenset[str] | None = None
    proxies: Mapping[str, str] = field(default_factory=dict)
    registered: frozenset[str] = frozenset()
    conflict: frozenset[str] = frozenset()
    readers: Mapping[str, tuple[Reader, ...]] = field(default_factory=dict)
    mismatches: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class BothSides:
    """Both sides at one moment.

    Args:
        near: This side.
        far: What the peer's agent answered; ``None`` if it did not.
        refusal: Why it did not.
    """

    near: NearTopic
    far: FarTopic | None = None
    refusal: str = ""
