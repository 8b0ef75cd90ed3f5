"""Answers of other nodes to ``getBusInfo``. Pure; replaced soon by a complete reader."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_INFO: Final = re.compile(r"port (\d+) to \[([^\]\s]+):(\d+)")


@dataclass(frozen=True, slots=True)
class BusLink:
    """One topic connection of a node."""

    number: int
    other: str
    inbound: bool
    topic: str
    connected: bool
    local_port: int | None
    remote: tuple[str, int] | None


def read_bus_info(value: XmlRpcValue) -> list[BusLink]:
    """Read the answer ``[code, status, links]``."""
    links = value[2] if isinstance(value, list) and len(value) == 3 else []
    found = []
    for link in links if isinstance(links, list) else []:
        if not isinstance(link, list) or len(link) < 6:
            continue
        match = _INFO.search(str(link[6])) if len(link) > 6 else None
        found.append(
            BusLink(
                link[0] if isinstance(link[0], int) else 0,
                str(link[1]),
                link[2] == "i",
                str(link[4]),
                bool(link[5]),
                int(match[1]) if match else None,
                (match[2], int(match[3])) if match else None,
            )
        )
    return found
