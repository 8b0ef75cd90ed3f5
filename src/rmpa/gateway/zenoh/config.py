"""What a Zenoh session is opened with: from our settings to the keys of Zenoh's configuration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import StartError
from rmpa.gateway.zenoh import limits

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.config.rules import GatewaySettings

_ENCRYPTED: Final = ("tls", "quic")
"""Protocols of endpoints that are encrypted, and that certificates are checked at."""
_INSECURE: Final = "or say --insecure, and every program that reaches it may read and write everything"


class ZenohMode(StrEnum):
    """Zenoh's modes."""

    CLIENT = "client"
    PEER = "peer"
    ROUTER = "router"


@dataclass(frozen=True, slots=True)
class MeshCertificates:
    """The files (PEM) that prove a module's name to other members of its secured mesh.

    Args:
        authority: The certificate of the mesh's authority; only what it has signed is let in.
        certificate: The module's certificate.
        key: Its private key.
    """

    authority: str
    certificate: str
    key: str

    def entries(self) -> dict[str, object]:
        """Zenoh's configuration of TLS: both sides show a certificate of the mesh.

        The name of the host is not checked where we connect: a certificate of the mesh names a module. An endpoint
        may ask for it: ``tls/fleet.local:7447#verify_name_on_connect=true``.
        """
        return {
            "root_ca_certificate": self.authority,
            "connect_certificate": self.certificate,
            "connect_private_key": self.key,
            "listen_certificate": self.certificate,
            "listen_private_key": self.key,
            "enable_mtls": True,
            "verify_name_on_connect": False,
            "close_link_on_expiration": True,
        }


@dataclass(frozen=True, slots=True)
class ZenohConfig:
    """The configuration of one session.

    Args:
        mode: A client has one router; a peer or a router listens too. Two peers that reach only a router exchange
            nothing, so what only connects is a client.
        connect: Endpoints to connect to.
        listen: Endpoints to listen at.
        certificates: For encrypted endpoints; ``None``: there are none.
        access_control: Zenoh's table of who may do what; ``None``: everything.
        lease: Seconds without a sign of life after which a transport is dead.
        uplink: Bytes a second that the line carries; ``None``: it is not known, and Linux sizes the buffers.
    """

    mode: ZenohMode = ZenohMode.CLIENT
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    certificates: MeshCertificates | None = None
    access_control: Mapping[str, object] | None = None
    lease: float = limits.LEASE
    uplink: int | None = None

    def entries(self) -> dict[str, object]:
        """The entries of Zenoh's configuration that differ from its defaults, as JSON values by their path."""
        entries: dict[str, object] = {
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
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": round(limits.DROP_WAIT * 1e6),
            "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": round(
                limits.DROP_WAIT_MAX * 1e6
            ),
            "transport/link/rx/max_message_size": limits.ZENOH_MESSAGE_MAX,
            "transport/shared_memory/enabled": False,
            "timestamping/enabled": True,
        }
        if self.certificates is not None:
            entries["transport/link/tls"] = self.certificates.entries()
        if self.uplink is not None:
            buffer = max(limits.SEND_BUFFER_MIN, round(self.uplink * limits.SEND_BUFFER))
            batch = min(limits.BATCH_MAX, max(limits.BATCH_MIN, round(self.uplink * limits.BATCH)))
            entries |= {f"transport/link/{kind}/so_sndbuf": buffer for kind in ("tcp", "tls")}
            entries["transport/link/tx/batch_size"] = batch
        if self.access_control is not None:
            entries["access_control"] = self.access_control
        return entries


def gateway_config(settings: GatewaySettings, certificates: MeshCertificates | None) -> ZenohConfig:
    """What the session of a gateway is opened with; without a table of access.

    Args:
        settings: Its endpoints, and whether it is a router.
        certificates: Of the gateway's module; ``None``: it has joined no secured mesh.

    Raises:
        StartError: An endpoint needs certificates that are not there, or is not encrypted although ``insecure`` is
            not set. Endpoints on loopback need neither.
    """
    for endpoint in (*settings.connect, *settings.listen):
        problem = _problem(endpoint, certificates)
        if problem and not settings.insecure:
            raise StartError(f"zenoh {endpoint}", *problem)
    mode = ZenohMode.ROUTER if settings.router else ZenohMode.PEER if settings.listen else ZenohMode.CLIENT
    return ZenohConfig(mode, settings.connect, settings.listen, certificates, uplink=settings.uplink)


def zenohd_entries(config: ZenohConfig) -> dict[str, object]:
    """The same as a nested object, which a configuration file has."""
    nested: dict[str, object] = {}
    for path, value in replace(config, mode=ZenohMode.ROUTER).entries().items():
        inner = nested
        *above, last = path.split("/")
        for part in above:
            found = inner.setdefault(part, {})
            if not isinstance(found, dict):
                raise TypeError(f"{path}: {part} has a value of its own")
            inner = found
        inner[last] = value
    return nested


def _problem(endpoint: str, certificates: MeshCertificates | None) -> tuple[str, str] | None:
    """Why an endpoint is refused, and the remedy."""
    protocol, _, address = endpoint.partition("/")
    if protocol in _ENCRYPTED:
        if certificates is not None:
            return None
        return (
            "it is encrypted, and this gateway has no certificate: its module has joined no secured mesh",
            f"let it join (rmpa trust join TOKEN --name with the gateway's name), {_INSECURE}",
        )
    if _is_loopback(address.partition("#")[0].partition("?")[0]):
        return None
    if certificates is None:
        return (
            f"{protocol} is not encrypted",
            f"let the gateway's module join a secured mesh (rmpa trust) and write tls/{address}, {_INSECURE}",
        )
    return f"{protocol} is not encrypted", f"write tls/{address}, {_INSECURE}"


def _is_loopback(address: str) -> bool:
    host = address.rpartition(":")[0]
    return host in ("localhost", "[::1]") or host.startswith("127.")
