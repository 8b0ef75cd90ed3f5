"""What an agent tells its peers of itself: the answer to their question ``agent.info``."""

from __future__ import annotations

from typing import Final

import msgspec

INFO: Final = "agent.info"
"""The request for what an agent tells of itself."""


class PeerAgent(msgspec.Struct, kw_only=True, frozen=True):
    """An agent, as its peers may know it. Later releases may add fields; each is optional.

    Attributes:
        version: Of RMPA; empty where it is not told.
        uptime: Seconds since it started.
        core_uri: Its ROS core's, as in ROS_MASTER_URI of its own module.
        cpu: Share of one core over the last second or longer, in percent.
        rss: Resident memory, bytes.
        files_open: File descriptors that are open.
        files_limit: How many it may have.
        proxies: The number of proxies of peers' nodes in its graph.
    """

    version: str = ""
    uptime: float | None = None
    core_uri: str = ""
    cpu: float | None = None
    rss: int | None = None
    files_open: int | None = None
    files_limit: int | None = None
    proxies: int | None = None
