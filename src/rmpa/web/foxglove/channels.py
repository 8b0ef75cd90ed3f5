"""The channels and services that Foxglove clients are offered, from the graph and the definitions of its types.

One table serves all clients. A topic has one channel for each of its types, and for each version of a type that its
messages have (by the md5 sum): where publishers disagree there are several, which differ in their schema. A channel
or a service is offered once its definition is known, and has an id that is never used again.
"""

from __future__ import annotations

import itertools
import secrets
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Generic, TypeAlias, TypeVar

from rmpa.core.identity import is_type_name
from rmpa.web import limits as web_limits
from rmpa.web.foxglove import limits
from rmpa.web.foxglove.protocol import ENCODING, SCHEMA_ENCODING, WARNING, message, status
from rmpa.web.hub.hub import Hub, HubClient
from rmpa.web.hub.node_link import READ_ONLY, Follower

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.core.errors import RmpaError
    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.types.messages import MessageType
    from rmpa.web.hub.connection import Session
    from rmpa.web.hub.frame_writer import OutFrame

_SEPARATOR: Final = "=" * 80
# A type's name, whether it is a service's, and the md5 sum of its version; "" for the one that is known best.
_TypeKey: TypeAlias = tuple[str, bool, str]
_Key: TypeAlias = tuple[str, str, str]
_Offer = TypeVar("_Offer", "Channel", "FoxgloveService")
_Nodes: TypeAlias = "Mapping[str, tuple[str, ...]]"


class Channel:
    """A topic with one type that clients may subscribe to."""

    op, items = "advertise", "channels"

    def __init__(self, number: int, key: _Key, kind: Any) -> None:
        self.id = number
        self.topic, self.type, _ = key
        self.md5sum, self.schema = kind.md5sum, _schema(kind)
        self.size = len(self.schema)
        # Whether messages of its version have come.
        self.delivered = False

    def json(self) -> dict[str, object]:
        """Its part of ``advertise``."""
        head = {"id": self.id, "topic": self.topic, "encoding": ENCODING, "schemaName": self.type}
        return {**head, "schemaEncoding": SCHEMA_ENCODING, "schema": self.schema}


class FoxgloveService:
    """A service that clients may call."""

    op, items = "advertiseServices", "services"

    def __init__(self, number: int, key: _Key, kind: Any) -> None:
        self.id, self.name, self.kind = number, key[0], kind
        self.size = len(kind.request.definition) + len(kind.response.definition)

    def json(self) -> dict[str, object]:
        """Its part of ``advertiseServices``."""
        halves = {"request": self.kind.request, "response": self.kind.response}
        schemas = {
            half: {
                "encoding": ENCODING,
                "schemaName": f"{self.kind.name}{half.capitalize()}",
                "schemaEncoding": SCHEMA_ENCODING,
                "schema": _schema(kind),
            }
            for half, kind in halves.items()
        }
        return {"id": self.id, "name": self.name, "type": self.kind.name, **schemas}


class Offers(Generic[_Offer]):
    """What clients are offered of one kind, each with an id that is never used again.

    Args:
        make: ``(id, key, kind)``: makes an offer.
    """

    def __init__(self, make: type[_Offer]) -> None:
        self._make: type[_Offer] = make
        self._numbers = itertools.count(1)
        # By the name of the topic or service, its type, and the md5 sum of that; "" for the one that is known best.
        self.by_key: dict[_Key, _Offer] = {}
        self.by_id: dict[int, _Offer] = {}

    def update(self, wanted: Mapping[_Key, MessageType | ServiceType | None]) -> tuple[list[int], list[OutFrame]]:
        """Withdraw what is not wanted, and offer what is and has a known type: ids that are gone, and messages."""
        gone = [self.by_key.pop(key).id for key in [*self.by_key] if key not in wanted]
        for each in gone:
            del self.by_id[each]
        ids = {f"{self._make.items[:-1]}Ids": gone}
        news: list[OutFrame] = [message(f"un{self._make.op}", **ids)] if gone else []
        made: list[_Offer] = []
        for key, kind in wanted.items():
            if kind is not None and key not in self.by_key:
                offer = self._make(next(self._numbers), key, kind)
                self.by_key[key] = self.by_id[offer.id] = offer
                made.append(offer)
        return gone, [*news, *self.parted(made)]

    def parted(self, offers: Iterable[_Offer]) -> Iterator[OutFrame]:
        """Messages that offer these, each with up to ``limits.ADVERTISE_BYTES`` of schemas, or one of them."""
        part: list[dict[str, object]] = []
        total = 0
        for offer in offers:
            if part and total + offer.size > limits.ADVERTISE_BYTES:
                yield message(self._make.op, **{self._make.items: part})
                part, total = [], 0
            part.append(offer.json())
            total += offer.size
        if part:
            yield message(self._make.op, **{self._make.items: part})


class ChannelTable:
    """What all clients are offered.

    Args:
        hub: Has the graph and the types.
        server: The server's name, for users.
        services: Whether clients may call services; else they are offered none.
    """

    # More than 12 fields: what is offered, what is known of its types, and the sessions that follow.
    def __init__(self, hub: Hub, server: str, *, services: bool) -> None:
        self.server = server
        # The id of this run of the server.
        self.run = secrets.token_hex(8)
        self.channels = Offers(Channel)
        self.services = Offers(FoxgloveService)
        self._hub = hub
        self._with_services = services
        self._client = HubClient(hub, "channels of Foxglove", READ_ONLY)
        # With what is called when channels have ended.
        self._sessions: dict[Session, Callable[[Iterable[int]], None]] = {}
        self._graph_followers: set[Session] = set()
        self._follower: Follower | None = None
        # All that were asked for; ``None``: not known yet.
        self._types: dict[_TypeKey, MessageType | ServiceType | None] = {}
        self._searched: set[str] = set()
        self._versions: dict[tuple[str, str], dict[str, None]] = {}
        self._warnings: dict[str, str] = {}
        # As those know it who follow it: publishers, subscribers and providers.
        self._graph: tuple[_Nodes, _Nodes, _Nodes] = ({}, {}, {})
        hub.types.on_learnt = self._learnt

    def join(self, session: Session, withdrawn: Callable[[Iterable[int]], None]) -> None:
        """Show a client all, and each change from now on; ``withdrawn`` gets the ids of channels that end."""
        if self._follower is None:
            self._follower = self._hub.graph.follow(self._update)
        session.connection.push(
            *self.channels.parted(self.channels.by_id.values()),
            *self.services.parted(self.services.by_id.values()),
            *(status(WARNING, text, identity) for identity, text in self._warnings.items()),
        )
        self._sessions[session] = withdrawn

    def leave(self, session: Session) -> None:
        """The client has gone."""
        self._sessions.pop(session, None)
        self.unfollow_graph(session)
        if not self._sessions and self._follower is not None:
            self._follower.close()
            self._follower = None

    def follow_graph(self, session: Session) -> None:
        """Tell a client the graph, as the others know it, and then its changes."""
        if not self._graph_followers:
            self._graph = self._nodes()
        self._graph_followers.add(session)
        session.connection.push(*graph_update(({}, {}, {}), self._graph))

    def unfollow_graph(self, session: Session) -> None:
        """Tell it no more of the graph."""
        self._graph_followers.discard(session)

    def close(self) -> None:
        """End what is asked for."""
        self._client.end_all()

    def other_version(self, channel: Channel, md5sum: str) -> None:
        """A message for a channel has another version of the type than its schema; it must not be sent there.

        The version gets a channel of its own. The channel is withdrawn if no message of its own version has come.
        """
        pair = channel.topic, channel.type
        versions = self._versions.setdefault(pair, {})
        if md5sum in versions or len(versions) >= web_limits.SEEN_TYPES_MAX:
            return
        if not versions and channel.delivered:
            versions[channel.md5sum] = None
            self.channels.by_key[*pair, channel.md5sum] = self.channels.by_key.pop((*pair, ""))
        versions[md5sum] = None
        if len(versions) > 1:
            text = (
                f"publishers of {channel.topic} have {len(versions)} versions of {channel.type} (md5 sums "
                f"{', '.join(versions)}): each has a channel of its own; build all modules with one version"
            )
            self._warn(_versions_id(pair), text)
        self._update()

    def _update(self) -> None:
        """Offer what the graph has and whose type is known, withdraw all else, and ask for types."""
        graph = self._hub.graph
        pairs = [
            (topic.name, type_)
            for topic in graph.topics.values()
            if topic.publishers
            for type_ in topic.types
            if is_type_name(type_)
        ]
        for pair in self._versions.keys() - {*pairs}:
            del self._versions[pair]
            self._clear(_versions_id(pair))
        channels = [(*pair, md5sum) for pair in pairs for md5sum in self._versions.get(pair) or ("",)]
        services: list[_Key] = []
        if self._with_services:
            services = [(each.name, each.type, "") for each in graph.services.values() if is_type_name(each.type)]
            self._search({each.name for each in graph.services.values() if not each.type})
        self._ask(
            {(type_, False, md5sum) for _, type_, md5sum in channels} | {(each, True, "") for _, each, _ in services}
        )
        gone, news = self.channels.update({key: self._types[key[1], False, key[2]] for key in channels})
        _, more = self.services.update({key: self._types[key[1], True, ""] for key in services})
        self._tell(*news, *more)
        for withdrawn in self._sessions.values() if gone else ():
            withdrawn(gone)
        if self._graph_followers:
            before, self._graph = self._graph, self._nodes()
            update = graph_update(before, self._graph)
            for session in self._graph_followers:
                session.connection.push(*update)

    def _search(self, unknown: set[str]) -> None:
        """Find the types of services, each once; the graph has them then, and tells."""
        for name in sorted(unknown - self._searched):
            self._client.run(self._hub.graph.find(name), lambda _: None, lambda _: None)
        self._searched = unknown

    def _ask(self, wanted: set[_TypeKey]) -> None:
        for key in self._types.keys() - wanted:
            del self._types[key]
            self._clear(_type_id(key))
        for key in sorted(wanted - self._types.keys()):
            self._types[key] = None
            name, service, md5sum = key
            known, unknown = partial(self._known, key), partial(self._unknown, key)
            if service:
                self._client.run(self._hub.types.find_service(name), known, unknown)
            else:
                self._client.run(self._hub.types.find_message(name, md5sum), known, unknown)

    def _known(self, key: _TypeKey, kind: MessageType | ServiceType) -> None:
        if key in self._types:
            self._types[key] = kind
            self._clear(_type_id(key))
            self._update()

    def _unknown(self, key: _TypeKey, error: RmpaError) -> None:
        if key in self._types:
            self._warn(_type_id(key), f"no {'service' if key[1] else 'topic'} of type {key[0]} is shown: {error}")

    def _learnt(self, kind: MessageType) -> None:
        """A type is known that may not have been found before."""
        if self._types.get((kind.name, False, ""), kind) is None:
            self._known((kind.name, False, ""), kind)

    def _nodes(self) -> tuple[_Nodes, _Nodes, _Nodes]:
        topics, services = self._hub.graph.topics.values(), self._hub.graph.services.values()
        return (
            {topic.name: topic.publishers for topic in topics if topic.publishers},
            {topic.name: topic.subscribers for topic in topics if topic.subscribers},
            {service.name: service.providers for service in services},
        )

    def _warn(self, identity: str, text: str) -> None:
        self._warnings[identity] = text
        self._tell(status(WARNING, text, identity))

    def _clear(self, identity: str) -> None:
        if self._warnings.pop(identity, None) is not None:
            self._tell(message("removeStatus", statusIds=[identity]))

    def _tell(self, *frames: OutFrame) -> None:
        for session in self._sessions:
            session.connection.push(*frames)


def graph_update(before: tuple[_Nodes, _Nodes, _Nodes], now: tuple[_Nodes, _Nodes, _Nodes]) -> list[OutFrame]:
    """``connectionGraphUpdate``: what leads from one graph to another; a topic without nodes counts as removed."""
    topics = (before[0].keys() | before[1].keys()) - now[0].keys() - now[1].keys()
    services = before[2].keys() - now[2].keys()
    changed = {
        "publishedTopics": _changed("publisherIds", before[0], now[0], topics),
        "subscribedTopics": _changed("subscriberIds", before[1], now[1], topics),
        "advertisedServices": _changed("providerIds", before[2], now[2], services),
        "removedTopics": sorted(topics),
        "removedServices": sorted(services),
    }
    return [message("connectionGraphUpdate", **changed)] if any(changed.values()) else []


def _changed(key: str, before: _Nodes, now: _Nodes, removed: set[str]) -> list[dict[str, object]]:
    """Entries that are new or differ, and with no node those that ended while their name remains in the graph."""
    gone = sorted(before.keys() - now.keys() - removed)
    changed = {name: ids for name, ids in now.items() if before.get(name) != ids} | dict.fromkeys(gone, ())
    return [{"name": name, key: ids} for name, ids in changed.items()]


def _schema(kind: MessageType) -> str:
    """A definition as a schema: without a separator line at its beginning, which parsers of ``ros1msg`` refuse."""
    text = kind.definition
    return text.removeprefix(_SEPARATOR).removeprefix("\n") if text.startswith("=") else text


def _type_id(key: _TypeKey) -> str:
    name, service, md5sum = key
    return f"{'service' if service else 'message'} type {name}{f' {md5sum}' if md5sum else ''}"


def _versions_id(pair: tuple[str, str]) -> str:
    return f"versions of {pair[1]} on {pair[0]}"
