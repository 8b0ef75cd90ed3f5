"""The services' part of the snapshot: those of this module and of its peers, and how their calls went."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.observe.snapshot import SampleSpread, ServiceInfo
from rmpa.runtime.event_loop import yield_to_data

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.bridge.services.exports import LocalService
    from rmpa.bridge.services.imports import RemoteService
    from rmpa.bridge.services.io.calls import CallStats
    from rmpa.bridge.services.io.part import Services


class ServicesSection:
    """Reads what is known of services; changes nothing.

    Args:
        services: The bridge's part.
    """

    def __init__(self, services: Services) -> None:
        self._services = services

    def infos(self) -> tuple[ServiceInfo, ...]:
        """Every service of the local graph, the agent's own left out, and every one that peers offer."""
        found = [*self._local(), *self._remote()]
        return tuple(sorted(found, key=lambda info: (info.name, info.direction == "in", info.peer)))

    def _local(self) -> Iterator[ServiceInfo]:
        services = self._services
        for service, server in list(services.exports.seen.items()):
            yield_to_data()
            yield self._export(service, server, services.served.get(service))

    def _export(self, service: str, server: LocalService, stats: CallStats | None) -> ServiceInfo:
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
            calls=stats.calls if stats else 0,
            failed=stats.failed if stats else 0,
            active=stats.active if stats else 0,
            latency=_latency(stats),
            crosses=decision.allowed,
            policy=decision.rule,
            problem=stats.problem if stats else "",
        )

    def _remote(self) -> Iterator[ServiceInfo]:
        for peer, remote in list(self._services.imports):
            yield_to_data()
            yield self._import(peer, remote)

    def _import(self, peer: int, remote: RemoteService) -> ServiceInfo:
        shown = self._services.shown(peer, remote.name) if remote.shown else None
        stats = shown.stats if shown else None
        decision = self._services.rules.judge(remote.name, remote.node)
        return ServiceInfo(
            name=remote.name,
            node=remote.node,
            direction="in",
            peer=self._services.imports.peer_name(peer),
            state=remote.state.name.lower() if remote.shown else "hidden",
            wire=remote.wire if remote.wire != remote.name else "",
            type=remote.about.type if remote.about else "",
            md5=remote.about.md5 if remote.about else "",
            calls=stats.calls if stats else 0,
            failed=stats.failed if stats else 0,
            active=stats.active if stats else 0,
            latency=_latency(stats),
            crosses=decision.allowed,
            policy=decision.rule,
            hidden=remote.hidden,
            problem=(shown.mismatch if shown else "") or (stats.problem if stats else "") or remote.problem,
        )


def _latency(stats: CallStats | None) -> SampleSpread | None:
    if stats is None or not stats.latencies.total:
        return None
    summary = stats.latencies.summary()
    return SampleSpread(
        count=summary.count,
        mean=summary.mean,
        sd=summary.sd,
        min=summary.minimum,
        max=summary.maximum,
        p50=summary.p50,
        p99=summary.p99,
    )
