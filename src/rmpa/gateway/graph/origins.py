"""The origin with which the relay offers what a neighbour of the gateway has. Pure."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Final

from rmpa.bridge.messages import Origin
from rmpa.core import limits as core_limits

if TYPE_CHECKING:
    from rmpa.gateway.neighbour import ForeignSource

NEIGHBOUR_GUID: Final = "0.0.0.0:0#1"
"""The GUID of each site: its form is that of a GUID, but no module can have this address."""
_INSTANCE_LABEL: Final = b"rmpa site 1"


def site_instance(site: str) -> str:
    """The instance of a site, 32 hexadecimal digits: the same in all gateways that reach it."""
    digest = hashlib.sha256(_INSTANCE_LABEL + site.encode()).digest()
    return digest[: core_limits.INSTANCE_ID_BYTES].hex()


def foreign_node(source: ForeignSource) -> str:
    """The node in the origin's graph: ``/<module>/<node>``, or ``/<node>`` where there is no module."""
    return f"/{source.module}{source.node}" if source.module else source.node


def foreign_origin(source: ForeignSource) -> Origin:
    """The origin of a neighbour's source; its path is empty."""
    return Origin(source.site, NEIGHBOUR_GUID, site_instance(source.site), foreign_node(source))


def is_foreign(origin: Origin) -> bool:
    """Whether a relayed source is one that a gateway of this mesh has from a neighbour."""
    return origin.guid == NEIGHBOUR_GUID
