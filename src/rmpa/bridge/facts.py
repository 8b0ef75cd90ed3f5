"""The bridge's piece of the snapshot: topics, services, and what crosses between this module and each peer."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from rmpa.bridge.topics.facts import TopicFacts, first_names
from rmpa.core.facts import BoundInfo, ServiceInfo
from rmpa.core.statistics import SampleSpread
from rmpa.runtime.loop import yield_to_data, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.messages import Origin
    from rmpa.bridge.offers import OfferBook
    from rmpa.bridge.peer_offers import ImportBook
    from rmpa.bridge.services.bodies import LocalService
    from rmpa.bridge.services.books import RemoteService
    from rmpa.bridge.services.calls import CallStats
    from rmpa.bridge.services.part import Services
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.subscriptions import Subscriptions
    from rmpa.bridge.twins import TwinWatch


class ServiceFacts:
    """Reads what the part for services knows; changes nothing.

    Args:
        services: The part.

    Attributes:
        part: The part.
    """

    def __init__(self, services: Services) -> None:
        self.part = services

    def used(self, most: int) -> tuple[Collection[str] | None, int]:
        """The names to show where at most so many services can be shown, and the number of the other services.

        First the services of this module and those that are or were called, all of them; then the others that are
        shown, then the hidden ones. A name stands for all services of that name.
        """
        services = self.part
        first, shown, hidden = set(services.exports.seen), Counter[str](), Counter[str]()
        for _, remote in yielding_to_data(list(services.imports)):
            known = services.shown(remote)
            if remote.route or remote.problem or (known is not None and (known.stats.calls or known.mismatch)):
                first.add(remote.name)
            (shown if remote.shown else hidden)[remote.name] += 1
        return first_names(most, first, shown + hidden, (shown.keys() - first, hidden.keys() - shown.keys() - first))

    def infos(self, wanted: Collection[str] | None) -> tuple[ServiceInfo, ...]:
        """The services of the local graph, without the agent's own, and of the peers: all, or those of some names."""
        if wanted is not None and not wanted:
            return ()
        found = []
        for service, server in list(self.part.exports.seen.items()):
            if wanted is None or service in wanted:
                yield_to_data()
                found.append(self._own_service(service, server))
        for peer, remote in yielding_to_data(list(self.part.imports)):
            if wanted is None or remote.name in wanted:
                yield_to_data()
                found.append(self.of_peer(peer, remote))
        return tuple(sorted(found, key=lambda info: (info.name, info.direction == "in", info.peer)))

    def _own_service(self, service: str, server: LocalService) -> ServiceInfo:
        services = self.part
        exports, peer_name = services.exports, services.imports.peer_name
        about, decision = exports.about.get(service), exports.judge(service, server)
        callers = tuple(sorted(map(peer_name, exports.callers(service))))
        direct = services.direct_exports.of(service, server.node)
        return ServiceInfo(
            name=service,
            node=server.node,
            direction="out",
            state="home" if service not in exports.offered else "open" if callers else "idle",
            type=about.type if about else "",
            md5=about.md5sum if about else "",
            callers=callers,
            wanted=self.part.context.services.transport(service).value,
            direct_callers=tuple(sorted(peer_name(peer) for peer, _, _ in direct)),
            crosses=decision.allowed,
            policy=decision.rule,
            **_figures(services.serving.stats.get(service)),
        )

    def of_peer(self, peer: int, remote: RemoteService) -> ServiceInfo:
        """A service of a peer, by the number of its session."""
        services, rules = self.part, self.part.context.services
        shown, decision = services.shown(remote), rules.judge(remote.name, remote.node)
        figures = _figures(shown.stats if shown else None)
        figures["problem"] = (shown.mismatch if shown else "") or figures.get("problem") or remote.problem
        direct = services.direct_imports
        transport: dict[str, Any] = {}
        if remote.shown and (address := direct.address(peer, remote.name)):
            transport = {"transport": "direct", "address": address, "lookups": direct.lookups[remote.name]}
        elif remote.shown:
            transport = {"transport": "relay"}
            if (unmet := direct.unmet(remote)) is not None:
                transport |= {"condition": unmet.condition.value, "relayed_because": unmet.text}
        return ServiceInfo(
            name=remote.name,
            node=remote.node,
            direction="in",
            peer=services.imports.peer_name(peer),
            state=remote.state if remote.shown else "hidden",
            wire=remote.wire if remote.wire != remote.name else "",
            type=remote.about.type if remote.about else "",
            md5=remote.about.md5sum if remote.about else "",
            wanted=rules.transport(remote.name).value,
            crosses=decision.allowed,
            policy=decision.rule,
            hidden=services.imports.why_hidden(remote)[0],
            **transport,
            **figures,
        )


def _figures(stats: CallStats | None) -> dict[str, Any]:
    """The fields of a service that its calls give."""
    if stats is None:
        return {}
    known = {name: getattr(stats, name) for name in ("calls", "failed", "active", "problem")}
    return known | {"latency": SampleSpread.of(stats.latencies) if stats.latencies else None}


class BridgeFacts:
    """Reads what the bridge and its parts know; changes nothing.

    Args:
        bridge: The bridge.
        services: Its part for services.
        subscriptions: Its part for the subscriptions of peers.
        twins: Its part for peers of this module's kind.

    Attributes:
        topics: The facts of topics.
        services: The facts of services.
    """

    def __init__(self, bridge: Bridge, services: Services, subscriptions: Subscriptions, twins: TwinWatch) -> None:
        self.bridge = bridge
        self.topics = TopicFacts(bridge)
        self.services = ServiceFacts(services)
        self._services, self._subscriptions, self._twins = services, subscriptions, twins

    def proxies(self) -> dict[str, Any]:
        """The fields of ``AgentInfo`` about the nodes that stand for those of peers."""
        nodes, count = self.bridge.proxy_nodes, self.bridge.sessions.proxy_count
        return {"proxies": count, "proxy_sockets": nodes.sockets(count), "proxy_listening": nodes.listening}

    def peer(self, session: PeerSession) -> dict[str, Any]:
        """The fields of ``PeerInfo`` about what crosses; ``conflicts`` has those of names alone."""
        topics, peer = self.bridge.topics, session.peer
        offered = len(topics.imports.offered_by(peer)), topics.exports.topics_for(peer)
        yield_to_data()
        twins = self._twins.problem(session)
        direct = sum(path.session.peer == peer and path.endpoint is not None for path in topics.direct_imports)
        return {
            "topics_in": offered[0],
            "topics_out": offered[1],
            "conflicts": (twins,) if twins else (),
            "beyond": tuple(self._beyond(session)),
            "direct_in": direct,
            "direct_out": sum(owner == peer for owner, _, _ in topics.direct_exports),
        }

    def _beyond(self, session: PeerSession) -> Iterator[BoundInfo]:
        """What of a peer this module refuses because of its limits."""
        books: dict[str, ImportBook[Any, Any, Any]] = {
            "topics": self.bridge.topics.imports,
            "services": self._services.imports,
            "subscriptions": self._subscriptions.imports,
        }
        most, peer, name = self.bridge.context.settings.limits, session.peer, session.link.name
        nodes = {kind: book.refused_nodes(peer) for kind, book in books.items()}
        further = [f"{count} {kind}" for kind, of in nodes.items() if (count := sum(map(len, of.values())))]
        for hidden, kind, limit in (
            (len(set().union(*nodes.values())), "nodes", most.nodes),
            (books["topics"].refused(peer) + books["subscriptions"].refused(peer), "topics", most.topics),
            (books["services"].refused(peer), "services", most.services),
        ):
            if hidden:
                what = _count(hidden, kind) + (f" with {' and '.join(further)}" if kind == "nodes" else "")
                text = f"{what} of {name} stay hidden here: it has more than limits.{kind} = {limit} of this module; "
                yield BoundInfo(kind=kind, limit=limit, hidden=hidden, text=text + _raise_limit(kind))

    def relayed(self) -> Iterator[tuple[Origin, str, int]]:
        """Each module without a link: one of its origins, the peer that relays it, and how many topics are shown."""
        imports = self.bridge.topics.imports
        shown = {
            (entry.origin.instance, entry.name)
            for entry in yielding_to_data(list(imports))
            if entry.origin is not None and entry.shown
        }
        counts = Counter(instance for instance, _ in shown)
        yield from ((origin, via, counts[origin.instance]) for origin, via in imports.ways)

    def lost(self) -> dict[str, str]:
        """The relay that brought a module last, of each that no relay brings any more."""
        return dict(self.bridge.topics.imports.ways.lost)

    def notes(self) -> Iterator[str]:
        """What of this module no peer is offered because of its limits."""
        books: tuple[tuple[OfferBook[Any, Any, Any, Any], str, str], ...] = (
            (self.bridge.topics.exports, "topics", ""),
            (self._subscriptions.exports, "topics", " that nodes subscribe to"),
            (self._services.exports, "services", ""),
        )
        for book, kind, of in books:
            if beyond := book.beyond:
                which = f"{_count(len(beyond), kind)} of this module{of} are offered to no peer"
                limit = getattr(self.bridge.context.settings.limits, kind)
                yield f"{which}: more than limits.{kind} = {limit}; {_raise_limit(kind)}"


def _count(hidden: int, kind: str) -> str:
    return f"{hidden} {kind if hidden > 1 else kind[:-1]}"


def _raise_limit(kind: str) -> str:
    setting = "services.deny" if kind == "services" else "bridge.deny"
    return f"raise it in rmpa.toml and `rmpa reload`, or deny some by {setting}"
