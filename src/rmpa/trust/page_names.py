"""The names and addresses by which a module's page is opened: which of them its certificate may have (RFC 9525).

Those that follow from the module's name are never another module's. Further ones are asked for. A browser that trusts
the mesh's CA is to believe it about no host of the Internet, so these are private addresses, and names of the local
network.
"""

from __future__ import annotations

import ipaddress
import re
from typing import TYPE_CHECKING, Final

from rmpa.trust import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

_LABEL: Final = r"[a-z0-9](?:[a-z0-9-]{0,61}[a-z0-9])?"
_LOCAL: Final = re.compile(rf"{_LABEL}|(?:{_LABEL}\.)+(?:local|lan|internal|home\.arpa)")
"""A name without a dot, or below a domain that is no one's in the Internet (RFC 6762, RFC 8375, ICANN's internal)."""
_SHARED: Final = ipaddress.IPv4Network("100.64.0.0/10")
"""Of carriers, and of VPNs such as Tailscale's (RFC 6598)."""


def server_names(name: str) -> tuple[str, ...]:
    """The names that every module's certificate has, besides 127.0.0.1.

    They follow from the module's name and are not asked for, so that no module gets those of another. A host's name
    has ``-`` where the module's name, which is made of it, has ``_``.
    """
    host = name.replace("_", "-").lower()
    return (host, f"{host}.local", "localhost")


def page_hosts(wanted: Iterable[str]) -> tuple[str, ...]:
    """Of names and addresses those that a certificate may have, in their normal form, at most so many."""
    found = dict.fromkeys(host for text in wanted if (host := _page_host(text)))
    return tuple(found)[: limits.PAGE_HOSTS_MAX]


def host_names(host_name: str) -> tuple[str, ...]:
    """The names of a machine in its network: its host's name, whole and short, and that of mDNS."""
    name = host_name.lower().removesuffix(".")
    short = name.partition(".")[0]
    return (name, short, f"{short}.local")


def _page_host(text: str) -> str:
    """The normal form; empty: a certificate may not have it, or has it anyway."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        name = text.lower().removesuffix(".")
        return name if name != "localhost" and _LOCAL.fullmatch(name) else ""
    special = address.is_loopback or address.is_unspecified or address.is_multicast
    shared = isinstance(address, ipaddress.IPv4Address) and address in _SHARED
    return str(address) if (address.is_private or shared) and not special else ""
