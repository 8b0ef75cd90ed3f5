"""One source of a peer at its proxy, without the bridge around it: what it asks of the bridge is written down."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, cast

from rmpa.bridge.data.quality import QosEventKind
from rmpa.bridge.data.reception import ImportFlow
from rmpa.bridge.messages import RouteOpened, Source
from rmpa.bridge.proxies import PeerProxies, ProxyNodes
from rmpa.bridge.sessions import PeerSession
from rmpa.bridge.topics.import_route import ImportRoute, RemoteTopic
from rmpa.core.statistics import Counters
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.publication import Publication


class Unjoined(ImportRoute):
    """A source whose publisher does not see further subscribers."""

    def join(self, _connection: object) -> None:
        """There is no publisher."""


class Proxied:
    """A source of the peer *b*.

    Args:
        core: The local core.
        source: The source.
        type_name: Its type.
    """

    def __init__(self, core: RosCore, source: Source, type_name: str) -> None:
        self.demands: list[bool] = []
        self.occurred: list[tuple[float, QosEventKind]] = []
        self.acks: list[int] = []
        self.loop = asyncio.get_running_loop()
        self.proxies = PeerProxies("/rmpa/b", ProxyNodes(core))
        link: Any = SimpleNamespace(
            routes={}, name="b", mark=lambda _kind, _route, sequence: self.acks.append(sequence)
        )
        self.link = link
        nothing = SimpleNamespace(
            demand=lambda _entry, _now, wanted: self.demands.append(wanted),
            listeners_changed=lambda _peer, _source: None,
            request=lambda *_: None,
        )
        part: Any = SimpleNamespace(imports=nothing, direct_imports=nothing, now=self.loop.time)
        part.keep_awake = lambda: None
        part.warn = lambda kind, _who, _text: self.occurred.append((self.loop.time(), _kind(kind)))
        pasts: dict[Any, Any] = {}
        part.pasts = lambda _name: pasts
        sessions = SimpleNamespace(proxies=lambda _session, node, _origin: (self.proxies, node))
        part.bridge = SimpleNamespace(
            core=core, counters=Counters(), relay=SimpleNamespace(enabled=False), sessions=sessions
        )
        self.entry = RemoteTopic(
            peer=1, wire=source, name=source.topic, node=source.node, type=type_name, module=("", "b")
        )
        session = PeerSession(peer=1, name="b", link=link, proxies=self.proxies)
        self.route = self.entry.route = Unjoined(part, session, self.entry)

    @property
    def flow(self) -> ImportFlow:
        """The flow, which is there."""
        assert self.route.flow is not None
        return self.route.flow

    async def publish(self) -> Publication:
        """Show it in the local graph."""
        while self.route.publication is None:
            await asyncio.sleep(0.01)
        return self.route.publication

    def opened(self, opened: RouteOpened) -> ImportFlow:
        """Its route is open."""
        self.entry.open = True
        self.route.open(opened)
        return cast("ImportFlow", self.link.routes[opened.route])

    def detach(self, *, missed: bool = False, last: int | None = None) -> None:
        """Its route ends."""
        self.route.detach(missed=missed, last=last)
        self.entry.open = False

    async def close(self) -> None:
        """Take it out of the graph."""
        self.route.end(missed=True)
        self.route.release()
        await self.proxies.close()


def _kind(name: str) -> QosEventKind:
    return QosEventKind(name.removeprefix("contract."))
