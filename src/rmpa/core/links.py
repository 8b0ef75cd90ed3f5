"""Which peers stay linked: the word of ``[mesh] links``."""

from __future__ import annotations

from enum import StrEnum


class Links(StrEnum):
    """When a link to a peer stands."""

    AUTO = "auto"
    """As ``FULL`` in a small mesh, as ``DEMAND`` in a large one."""
    FULL = "full"
    """Always, to each peer (paper, section 4.2)."""
    DEMAND = "demand"
    """While something depends on it; a peer of which nothing is used is *parked*: it has no link for now."""
