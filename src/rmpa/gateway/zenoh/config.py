"""What a Zenoh session is opened with, and the keys of Zenoh's configuration that this becomes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from rmpa.gateway.zenoh import limits


class ZenohMode(StrEnum):
    """Zenoh's modes."""

    CLIENT = "client"
    PEER = "peer"
    ROUTER = "router"


@dataclass(frozen=True, slots=True)
class ZenohConfig:
    """The configuration of one session.

    Args:
        mode: A client has one router; a peer or a router listens too. Two peers that reach only a router exchange
            nothing, so what only connects is a client.
        connect: Endpoints to connect to.
        listen: Endpoints to listen at.
        lease: Seconds without a sign of life after which a transport is dead.
    """

    mode: ZenohMode = ZenohMode.CLIENT
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    lease: float = limits.LEASE

    def entries(self) -> dict[str, object]:
        """The entries of Zenoh's configuration that differ from its defaults, as JSON values by their path."""
        return {
            "mode": str(self.mode),
            "connect/endpoints": list(self.connect),
            "listen/endpoints": list(self.listen),
            "connect/retry": {
                "period_init_ms": round(limits.RECONNECT_FIRST * 1000),
                "period_max_ms": round(limits.RECONNECT_MAX * 1000),
                "period_increase_factor": limits.RECONNECT_GROWTH,
            },
            "scouting/delay": 0,
            "scouting/multicast/enabled": False,
            "transport/link/tx/lease": round(self.lease * 1000),
            "transport/link/tx/queue/congestion_control/block/wait_before_close": round(limits.BLOCK_MAX * 1e6),
            "transport/shared_memory/enabled": False,
            "timestamping/enabled": True,
        }
