"""What a Zenoh session is opened with: our settings as keys of Zenoh's configuration, and who may use a router."""

from __future__ import annotations

import json
import logging
import os
import socket
import stat
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rmpa.agent.trust import trust_store
from rmpa.config.peer_rules import Effect
from rmpa.core.errors import RemoteProtocolError, StartError
from rmpa.gateway import limits
from rmpa.trust.limits import CERTIFICATE_LIFETIME, RENEWAL_SHARE
from rmpa.trust.store import CA, CERTIFICATE, DENY, KEY, MemberFiles

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from rmpa.config.rules import GatewaySettings
    from rmpa.config.settings import Settings
    from rmpa.trust.certificates import DenyList

_log = logging.getLogger(__name__)

# Seconds of the line's rate that the kernel's buffer of a connection holds, which counts them twice. In that buffer
# there are no priorities: on 1 Mbit/s with images a command waited 2.7 s with Linux's own size, 0.3 s with this one,
# and as many images came.
_SEND_BUFFER: Final = 0.125
# Bytes of that buffer at least: the kernel allows no less than about two packets.
_SEND_BUFFER_MIN: Final = 4096
# Seconds of the line's rate in one batch of Zenoh, which a message of a higher priority does not overtake.
_BATCH: Final = 0.0625
# Bytes of a batch at least.
_BATCH_MIN: Final = 2048
# Bytes of a batch at most: Zenoh's own.
_BATCH_MAX: Final = 65_535
# Bytes of one connection that the kernel may hold unsent (TCP_NOTSENT_LOWAT): a command does not overtake them. On 1
# Mbit/s with images a command waited 1.0 s with it and 3.4 s without it, both without ``uplink``.
_UNSENT_BYTES: Final = 16_384
# Seconds before the first attempt to reach a router again.
_RECONNECT_FIRST: Final = 0.2
# Seconds between two later attempts at most; a router that was restarted is reached again within that time.
_RECONNECT_MAX: Final = 2.0
# Factor between the waits of two attempts.
_RECONNECT_GROWTH: Final = 1.5

# Protocols of endpoints that are encrypted, and that certificates are checked at.
_ENCRYPTED: Final = ("tls", "quic")
_INSECURE: Final = "or say --insecure, and every program that reaches it may read and write everything"


@dataclass(frozen=True, slots=True)
class ZenohConfig:
    """The configuration of one session.

    Args:
        mode: ``client``, ``peer`` or ``router``. A client has one router; a peer or a router listens too. Two peers
            that reach only a router exchange nothing, so what only connects is a client.
        connect: Endpoints to connect to.
        listen: Endpoints to listen at.
        certificates: The folder with the files of a member of a secured mesh, for encrypted endpoints; ``None``:
            there are none.
        access_control: Zenoh's table of who may do what; ``None``: everything.
        uplink: Bytes a second that the line carries; ``None``: it is not known, and Linux sizes the buffers.
    """

    mode: str = "client"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    certificates: Path | None = None
    access_control: Mapping[str, object] | None = None
    uplink: int | None = None

    def entries(self) -> dict[str, object]:
        """The entries of Zenoh's configuration that differ from its defaults, as JSON values by their path."""
        entries: dict[str, object] = {
            "mode": self.mode,
            "connect/endpoints": list(self.connect),
            "listen/endpoints": list(self.listen),
            "connect/retry": {
                "period_init_ms": round(_RECONNECT_FIRST * 1000),
                "period_max_ms": round(_RECONNECT_MAX * 1000),
                "period_increase_factor": _RECONNECT_GROWTH,
            },
            "scouting/delay": 0,
            "scouting/multicast/enabled": False,
            "transport/link/tx/lease": round(limits.LEASE * 1000),
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
            entries["transport/link/tls"] = _tls_entries(self.certificates)
        if self.uplink is not None:
            buffer = max(_SEND_BUFFER_MIN, round(self.uplink * _SEND_BUFFER))
            batch = min(_BATCH_MAX, max(_BATCH_MIN, round(self.uplink * _BATCH)))
            entries |= {f"transport/link/{kind}/so_sndbuf": buffer for kind in ("tcp", "tls")}
            entries["transport/link/tx/batch_size"] = batch
        if self.access_control is not None:
            entries["access_control"] = self.access_control
        return entries

    def stamp(self) -> tuple[int, int] | None:
        """What changes when the certificate of what listens is replaced; ``None``: none, or not seen."""
        if self.certificates is None or not self.listen:
            return None
        try:
            info = (self.certificates / CERTIFICATE).stat()
        except OSError:
            return None
        return info.st_ino, info.st_mtime_ns

    def start_error(self, reason: str) -> StartError:
        """The error of a session that could not be opened, for what Zenoh says."""
        where = ", ".join((*self.connect, *self.listen)) or "its default endpoints"
        if "listener" in reason or "in use" in reason:
            remedy = "choose another --listen, or stop the program that listens there"
        elif "certificate" in reason.lower() or "tls" in reason.lower():
            remedy = "both sides need certificates of the same mesh: see rmpa trust status"
        else:
            remedy = "start the router there, or correct --connect"
        return StartError(f"zenoh {where}", reason, remedy)


def reason_of(error: Exception) -> str:
    """The text of an error of Zenoh without the places in Zenoh's source."""
    text = str(error).strip()
    while (at := text.rfind(" at /")) > 0:
        text = text[:at].rstrip(" .;[")
    return text


def _tls_entries(folder: Path) -> dict[str, object]:
    """Zenoh's configuration of TLS: both sides show a certificate of the mesh, whose authority has signed it.

    The name of the host is not checked where we connect: a certificate of the mesh names a module. An endpoint may
    ask for it: ``tls/fleet.local:7447#verify_name_on_connect=true``.
    """
    certificate, key = str(folder / CERTIFICATE), str(folder / KEY)
    return {
        "root_ca_certificate": str(folder / CA),
        "connect_certificate": certificate,
        "connect_private_key": key,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "enable_mtls": True,
        "verify_name_on_connect": False,
        "close_link_on_expiration": True,
    }


def gateway_config(settings: GatewaySettings, certificates: Path | None) -> ZenohConfig:
    """What the session of a gateway is opened with; without a table of access.

    Args:
        settings: Its endpoints, and whether it is a router.
        certificates: The folder of the gateway's module; ``None``: it has joined no secured mesh.

    Raises:
        StartError: An endpoint needs certificates that are not there, or is not encrypted although ``insecure`` is
            not set. Endpoints on loopback need neither.
    """
    for endpoint in (*settings.connect, *settings.listen):
        problem = _problem(endpoint, certificates)
        if problem and not settings.insecure:
            raise StartError(f"zenoh {endpoint}", *problem, code="invalid-value" if certificates else "not-a-member")
    mode = "router" if settings.router else "peer" if settings.listen else "client"
    return ZenohConfig(mode, settings.connect, settings.listen, certificates, uplink=settings.uplink)


def _problem(endpoint: str, certificates: Path | None) -> tuple[str, str] | None:
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


# Which certificates may use a router. Zenoh's table of access knows the name in a certificate alone. So a router has
# one rule: members may use the keys of sites, and those that were revoked may use nothing. Which topics, services and
# parameters a site may have is judged by the gateways at both ends, and by the modules.


_MESSAGES: Final = (
    *("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)
# The keys of sites; ``**`` alone fits no chunk that begins with ``@``, as the caches of latched topics do.
_SITES: Final = ("rmpa/1/**", "rmpa/1/**/@adv/**")
_ALL: Final = ("**", "**/@adv/**", "@ros2_lv/**")
# Where zenohd listens if the settings name no endpoint.
_LISTEN: Final = ("tls/0.0.0.0:7447",)
_HEAD: Final = """\
// For zenohd 1.10 or later; made by rmpa gateway zenoh-config from [gateway] and [trust].
// Both sides show a certificate of the mesh. zenohd reads this file and the certificates once, at its start: start
// it again when the certificate is renewed (each {days:g} days), or a module was revoked.
"""


def session_config(settings: Settings) -> ZenohConfig:
    """What the gateway's session is opened with.

    Raises:
        StartError: As ``gateway_config``; or the certificates are not whole, or other users can read them.
    """
    store = trust_store(settings)
    if store is None or not store.exists:
        return gateway_config(settings.gateway, None)
    files = store.load()
    config = gateway_config(settings.gateway, store.folder)
    if not config.listen:
        return config
    return replace(config, access_control=_access_table(settings, _deny_list(files, store.path(DENY))))


def _access_table(settings: Settings, deny: DenyList | None) -> dict[str, object]:
    """Zenoh's ``access_control``: members may use the keys of sites, revoked modules nothing.

    Zenoh allows a certificate what it allows to everybody, whatever is denied to its name, and knows it by its name
    alone. So while a certificate that was revoked may be valid, the others are named, as the deny list has them; a
    name that was invited again stays out until then.
    """
    keys = _ALL if settings.trust.default == Effect.ALLOW else _SITES
    if settings.gateway.ros2.enabled:
        domain = settings.gateway.ros2.domain
        keys = (*keys, "@ros2_lv/**", f"{domain}/**", f"{domain}/**/@adv/**")
    subject: dict[str, object] = {"id": "members"}
    if deny is not None and (revoked := deny.in_force(time.time())):
        # Never empty, which would be everybody.
        named = sorted({*deny.members, settings.name}.difference(revoked)) or [settings.name]
        subject["cert_common_names"] = named
    rule = {"id": "sites", "permission": "allow", "flows": ["ingress", "egress"]}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [{**rule, "messages": list(_MESSAGES), "key_exprs": list(dict.fromkeys(keys))}],
        "subjects": [subject],
        "policies": [{"rules": ["sites"], "subjects": ["members"]}],
    }


def zenohd_config(settings: Settings) -> str:
    """A configuration file (JSON5) for zenohd, as a router between sites.

    Raises:
        StartError: The module has joined no secured mesh, and ``insecure`` is not set; or its files are broken.
    """
    gateway = replace(settings.gateway, router=True, listen=settings.gateway.listen or _LISTEN)
    config = session_config(replace(settings, gateway=gateway))
    text = _HEAD.format(days=CERTIFICATE_LIFETIME * RENEWAL_SHARE / 86_400)
    if config.certificates is None:
        text += "// INSECURE: no certificates, and no rules of access.\n"
    nested: dict[str, Any] = {}
    for path, value in config.entries().items():
        inner = nested
        *above, last = path.split("/")
        for part in above:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return text + json.dumps(nested, indent=2) + "\n"


def _deny_list(files: MemberFiles, path: Path) -> DenyList | None:
    """The deny list of this module's mesh; ``None``: nothing was ever revoked.

    Raises:
        StartError: It is broken.
    """
    if not files.deny:
        return None
    from rmpa.trust.certificates import DenyList, ca_public_key, read_document  # noqa: PLC0415 - the extra rmpa[trust]

    try:
        return read_document(files.deny, ca_public_key(files.ca), DenyList)
    except RemoteProtocolError as error:
        raise StartError(str(path), f"is broken: {error}", "see rmpa trust status", code="keys-unusable") from None


# Bounds what the kernel holds unsent of Zenoh's connections, so that priorities hold on a slow line too.
#
# Zenoh sends by priority, but what it has handed to the kernel goes first in, first out: on 1 Mbit/s that is seconds.
# Zenoh has an option for the whole send buffer alone, which would have to fit each line. TCP_NOTSENT_LOWAT bounds the
# part that is not on the line yet, whatever the line carries; Zenoh has no option for it, so its sockets are looked
# for in this process.


_FILES: Final = Path("/proc/self/fd")
_STREAMS: Final = frozenset({"tcp", "tls", "ws"})


def bound_unsent(endpoints: Collection[str], unsent: int = _UNSENT_BYTES) -> int:
    """Bound what the kernel may hold unsent of some connections.

    Args:
        endpoints: Those of the other side of each, such as ``tcp/192.0.2.1:7447``.
        unsent: Bytes of one connection.

    Returns:
        The number of sockets that were tuned.
    """
    wanted = {found for each in endpoints if (found := _address(each)) is not None}
    try:
        numbers = [int(entry.name) for entry in _FILES.iterdir()] if wanted else []
    except OSError:
        return 0  # no /proc, or no file descriptor is left
    count = sum(_tune(number, wanted, unsent) for number in numbers)
    _log.debug("= %d of Zenoh's sockets hold at most %d bytes unsent", count, unsent)
    return count


def _tune(number: int, wanted: Collection[tuple[str, int]], unsent: int) -> bool:
    try:
        if not stat.S_ISSOCK(os.fstat(number).st_mode):
            return False
        with socket.socket(fileno=os.dup(number)) as found:
            if found.family not in (socket.AF_INET, socket.AF_INET6) or found.type != socket.SOCK_STREAM:
                return False
            address, port = found.getpeername()[:2]
            if (address.removeprefix("::ffff:"), port) not in wanted:
                return False
            found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, unsent)
    except OSError:
        return False  # closed meanwhile, not connected, or no TCP
    return True


def _address(endpoint: str) -> tuple[str, int] | None:
    """Address and port of an endpoint; ``None`` if it is no TCP connection."""
    protocol, _, place = endpoint.partition("/")
    host, _, port = place.partition("?")[0].partition("#")[0].rpartition(":")
    if protocol not in _STREAMS or not port.isdigit():
        return None
    return host.strip("[]").removeprefix("::ffff:"), int(port)
