"""The origin with which the relay offers what a neighbour of the gateway has. Pure."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Final

from rmpa.bridge.messages import Origin
from rmpa.bridge.policy import OUTSIDE_GUID
from rmpa.core import limits as core_limits

if TYPE_CHECKING:
    from rmpa.gateway.neighbour import ForeignSource

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
    return Origin(source.site, OUTSIDE_GUID, site_instance(source.site), foreign_node(source))
