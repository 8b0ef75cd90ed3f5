"""The services in the snapshot: those of this module and of its peers, with the figures of their calls."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from rmpa.observe.snapshot import SampleSpread, ServiceInfo
from rmpa.runtime.loop import sorted_yielding, yield_to_data, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from rmpa.bridge.services.bodies import LocalService
    from rmpa.bridge.services.calls import CallStats
    from rmpa.bridge.services.exports import RemoteService
    from rmpa.bridge.services.part import Services


class ServicesSection:
    """Reads what the bridge knows of services; changes nothing.

    Args:
        services: The bridge's part.
    """

    def __init__(self, services: Services) -> None:
        self._services = services

    def used(self, most: int) -> tuple[Collection[str] | None, int]:
        """The names to show where at most so many services can be shown, and the number of the other services.

        First the services of this module and those that are or were called, all of them; then the others that are
        shown, then the hidden ones. A name stands for all services of that name.

        Returns:
            The names, ``None`` for all, and how many services are left out.
        """
        first, shown, hidden = set(self._services.exports.seen), Counter[str](), Counter[str]()
        for peer, remote in yielding_to_data(list(self._services.imports)):
            known = self._services.shown(peer, remote.name)
            if remote.route or remote.problem or (known is not None and (known.stats.calls or known.mismatch)):
                first.add(remote.name)
            (shown if remote.shown else hidden)[remote.name] += 1
        counts = shown + hidden
        room = most - sum(counts[name] or 1 for name in first)
        left = 0
        for name in (*sorted_yielding(shown), *sorted_yielding(hidden.keys() - shown.keys())):
            if name in first:
                continue
            if room >= counts[name] and not left:
                first.add(name)
                room -= counts[name]
            else:
                left += counts[name]
        return (first, left) if left else (None, 0)

    def infos(self, wanted: Collection[str] | None = None) -> tuple[ServiceInfo, ...]:
        """The services of the local graph, without the agent's own, and of the peers: all, or those of some names."""
        if wanted is not None and not wanted:
            return ()
        found = [*self._local(wanted), *self._remote(wanted)]
        return tuple(sorted(found, key=lambda info: (info.name, info.direction == "in", info.peer)))

    def _local(self, wanted: Collection[str] | None) -> Iterator[ServiceInfo]:
        for service, server in list(self._services.exports.seen.items()):
            if wanted is not None and service not in wanted:
                continue
            yield_to_data()
            yield self._export(service, server)

    def _export(self, service: str, server: LocalService) -> ServiceInfo:
        exports = self._services.exports
        about = exports.about(service)
        decision = self._services.rules.judge(service, server.node)
        callers = tuple(sorted(self._services.imports.peer_name(peer) for peer in exports.callers(service)))
        return ServiceInfo(
            name=service,
            node=server.node,
            direction="out",
            state="home" if service not in exports.offered else "open" if callers else "idle",
            type=about.type if about else "",
            md5=about.md5 if about else "",
            callers=callers,
            wanted=self._services.rules.transport(service).value,
            direct_callers=tuple(
                sorted(
                    self._services.imports.peer_name(peer)
                    for peer, _, _ in self._services.direct_exports.of(service, server.node)
                )
            ),
            crosses=decision.allowed,
            policy=decision.rule,
            **_figures(self._services.served.get(service)),
        )

    def _remote(self, wanted: Collection[str] | None) -> Iterator[ServiceInfo]:
        for peer, remote in yielding_to_data(list(self._services.imports)):
            if wanted is not None and remote.name not in wanted:
                continue
            yield_to_data()
            yield self._import(peer, remote)

    def _import(self, peer: int, remote: RemoteService) -> ServiceInfo:
        shown = self._services.shown(peer, remote.name) if remote.shown else None
        decision = self._services.rules.judge(remote.name, remote.node)
        figures = _figures(shown.stats if shown else None)
        figures["problem"] = (shown.mismatch if shown else "") or figures.get("problem") or remote.problem
        return ServiceInfo(
            name=remote.name,
            node=remote.node,
            direction="in",
            peer=self._services.imports.peer_name(peer),
            state=remote.state.name.lower() if remote.shown else "hidden",
            wire=remote.wire if remote.wire != remote.name else "",
            type=remote.about.type if remote.about else "",
            md5=remote.about.md5 if remote.about else "",
            crosses=decision.allowed,
            policy=decision.rule,
            hidden=remote.hidden,
            **self._transport(peer, remote),
            **figures,
        )

    def _transport(self, peer: int, remote: RemoteService) -> dict[str, Any]:
        """The fields of a peer's service that say by which transport it is called."""
        wanted = self._services.rules.transport(remote.name).value
        if not remote.shown:
            return {"wanted": wanted}
        direct = self._services.direct_imports.answer(peer, remote.name)
        if direct is not None:
            return {"wanted": wanted, "transport": "direct", "address": direct.uri, "lookups": direct.lookups}
        found = {"wanted": wanted, "transport": "relay"}
        unmet = self._services.direct_imports.unmet(peer, remote.name)
        return found if unmet is None else found | {"condition": unmet.condition.value, "relayed_because": unmet.text}


def _figures(stats: CallStats | None) -> dict[str, Any]:
    """The fields of a service that its calls give."""
    if stats is None:
        return {}
    return {
        "calls": stats.calls,
        "failed": stats.failed,
        "active": stats.active,
        "latency": SampleSpread.of(stats.latencies.summary()) if stats.latencies.total else None,
        "problem": stats.problem,
    }
