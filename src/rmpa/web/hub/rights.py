"""What a client may do."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Rights:
    """What a client may do beyond reading topics and the graph; nothing unless it is said."""

    publish: bool = False
    call_services: bool = False
    read_parameters: bool = False
    set_parameters: bool = False
    fetch_assets: bool = False
    serve_services: bool = False


READ_ONLY = Rights()
FULL = Rights(
    publish=True,
    call_services=True,
    read_parameters=True,
    set_parameters=True,
    fetch_assets=True,
    serve_services=True,
)
