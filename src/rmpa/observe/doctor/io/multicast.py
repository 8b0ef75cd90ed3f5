"""Sends and receives multicast packets on chosen interfaces."""

from __future__ import annotations

import secrets
import select
import socket
import struct
import time
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import StartError
from rmpa.discovery import limits as discovery_limits
from rmpa.discovery.beacon import MAGIC, VERSION, BeaconKind
from rmpa.discovery.network import GroupMembership, open_receiver, receive
from rmpa.observe import limits
from rmpa.observe.doctor.network import MulticastEcho

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.discovery.network import Interface

_PKTINFO: Final = struct.Struct("@i4s4s")
_IP_PKTINFO: Final = 8  # Linux's (linux/in.h); not in the socket module of every supported Python
_NO_DOMAIN: Final = 0xFFFF
"""Greater than every domain: agents ignore beacons of it without logging."""


def hear(interfaces: Iterable[Interface], group: str, port: int, listen: float = 0.0) -> tuple[MulticastEcho, ...]:
    """Send one packet on each interface, and receive it there as an agent does.

    The packets are beacons of a domain that cannot exist, so agents ignore them.

    Args:
        interfaces: Where to send.
        group: The multicast group.
        port: Its port, which is shared with agents and others.
        listen: Seconds to listen for packets of other machines; 0: only until the own ones are back.

    Raises:
        StartError: Another program has the port and does not share it.
    """
    wanted = {interface.index: interface for interface in interfaces}
    own = {str(address) for interface in wanted.values() for address in interface.addresses}
    try:
        receiver = open_receiver(group, port)
    except OSError as error:
        problem = f"cannot be opened ({error.strerror})"
        raise StartError(f"UDP port {port}", problem, "`ss -ulnp` shows who has it") from None
    found: dict[str, MulticastEcho] = {}
    with receiver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, discovery_limits.MULTICAST_TTL)
        refused = GroupMembership(receiver, group).update(wanted.values())
        sent: dict[bytes, tuple[str, float]] = {}
        for interface in wanted.values():
            token = struct.pack(">4sBBH", MAGIC, VERSION, BeaconKind.HEARTBEAT, _NO_DOMAIN) + secrets.token_bytes(16)
            why = refused.get(interface.name) or _send(sender, interface, token, (group, port))
            found[interface.name] = MulticastEcho(interface.name, (why.strerror or str(why)) if why else "")
            if why is None:
                sent[token] = interface.name, time.monotonic()
        until = time.monotonic() + max(limits.DOCTOR_HEAR, listen)
        while (sent or listen) and (rest := until - time.monotonic()) > 0:
            if not select.select([receiver], [], [], rest)[0]:
                break
            try:
                data, (host, _), index = receive(receiver)
            except BlockingIOError:
                continue  # the kernel dropped it: its checksum was wrong
            name = wanted[index].name if index in wanted else ""
            # If two interfaces share a network, the packet is received on the other one too.
            if data in sent and sent[data][0] == name:
                found[name].after = time.monotonic() - sent.pop(data)[1]
            elif name and host not in own and data.startswith(MAGIC):
                found[name].others.add(host)
    return tuple(found.values())


def _send(sender: socket.socket, interface: Interface, data: bytes, to: tuple[str, int]) -> OSError | None:
    """Send one packet on an interface; return why that failed."""
    source = interface.addresses[0].packed if interface.addresses else bytes(4)
    ancillary = [(socket.IPPROTO_IP, _IP_PKTINFO, _PKTINFO.pack(interface.index, source, bytes(4)))]
    try:
        sender.sendmsg([data], ancillary, 0, to)
    except OSError as error:
        return error
    return None
