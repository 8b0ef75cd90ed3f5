"""Fuzz target: keys and tokens of sites and of ROS 2 over Zenoh, and the graph of ROS 2."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_global_name
from rmpa.gateway.ros2 import format as ros2_tokens
from rmpa.gateway.ros2.format import Ros2Endpoint
from rmpa.gateway.ros2.graph import Ros2Graph
from rmpa.gateway.sites import keys as site_keys
from rmpa.gateway.sites.services import asked_type

if TYPE_CHECKING:
    from collections.abc import Callable

_Parsed = TypeVar("_Parsed")
_RUN: Final = "0123456789abcdef0123456789abcdef"
_ENDPOINT: Final = (
    "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/{}/{}/%/%ns/talker/%chatter/{}/RIHS01_"
    + "0" * 64
    + "/::,10:,:,:,,"
)
SEEDS: list[bytes] = [
    b"",
    f"rmpa/1/warehouse/arm/up/{_RUN}".encode(),
    f"rmpa/1/warehouse/arm/up/{_RUN}/t/sensor_msgs%LaserScan/%lidar%driver/%base%scan".encode(),
    f"rmpa/1/warehouse/arm/up/{_RUN}/s/-/%node/%stop".encode(),
    f"rmpa/1/warehouse/arm/to/{_RUN}/yard/t/sensor_msgs%LaserScan/%lidar%driver/%base%scan".encode(),
    b"rmpa/1/warehouse/arm/to/yard/s/std_srvs%Trigger/stop",
    f"rmpa/1/warehouse/-gateway/010/{_RUN}".encode(),
    b"rmpa/1/warehouse/arm/s/std_srvs%Trigger/stop",
    _ENDPOINT.format(1, "MP", "std_msgs::msg::dds_::String_").encode(),
    _ENDPOINT.format(2, "SS", "std_srvs::srv::dds_::Trigger_").replace("::,10:", "2:1:2,1:3,4:").encode(),
    b"@ros2_lv/3/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/talker",
    "@ros2_lv/0/a1/1/2/MP/%/%é/a b/%..%etc/os::system::dds_::x_/\x1b[2J/::,10:,:,:,,".encode(),
    f"rmpa/1/eve/arm/up/{_RUN}/t/a%B/%..%etc%passwd/%\x1b[2J".encode(),
]


def fuzz(data: bytes) -> None:
    """Each key is read as it will be written again, or refused with a text that is safe to log."""
    key = data.decode("utf-8", "replace")
    site = _read(site_keys.parse_token, key)
    if site is not None and site_keys.parse_token(site.token()) != site:
        raise AssertionError(f"{site} does not survive its token")
    entity = _read(ros2_tokens.parse_token, key)
    if entity is not None and ros2_tokens.parse_token(entity.token()) != entity:
        raise AssertionError(f"{entity} does not survive its token")
    if isinstance(entity, Ros2Endpoint) and not entity.key():
        raise AssertionError("an endpoint has no key")
    _read(asked_type, key)
    graph = Ros2Graph(0, "own")
    shown = graph.change(key, alive=True)
    if isinstance(site, site_keys.SiteSource) and not (is_global_name(site.node) and is_global_name(site.name)):
        raise AssertionError(f"{site} has a name that ROS does not allow")
    names = [shown.name] if shown is not None else []
    names += [shown.node.name] if isinstance(shown, Ros2Endpoint) else []
    if not all(re.fullmatch(r"(/\w+)+", name, re.ASCII) and not name.startswith("/rmpa/") for name in names):
        raise AssertionError(f"{names} are not all names of ROS 2")
    if graph.change(key, alive=False) != shown or len(graph) or graph.nodes:
        raise AssertionError("a token that is gone stays in the graph")


def _read(parse: Callable[[str], _Parsed], key: str) -> _Parsed | None:
    try:
        return parse(key)
    except RemoteProtocolError as error:
        if not str(error).isprintable():
            raise AssertionError("an error's text is not safe to log") from error
        return None
