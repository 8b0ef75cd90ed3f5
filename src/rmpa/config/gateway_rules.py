"""The table ``[gateway]`` of ``rmpa.toml``: which other sites and which ROS 2 a gateway joins, and what may cross."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Crossing(StrEnum):
    """The way in which a rule lets sources cross, seen from this site."""

    BOTH = "both"
    OUT = "out"
    IN = "in"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class CrossingRule:
    """One ``[[gateway.rule]]``: the first that matches a source holds. Without a rule everything crosses, on demand.

    Args:
        names: Globs over topics, services and parameters, by the names that they have in their module.
        sites: Globs over the other site's name; ``ros2`` and ``ros1_bridge`` are names too.
        modules: Globs over the module that has the source.
        crossing: Which way it may cross.
        name: The name here of what comes in; ``{site}``, ``{module}`` and ``{name}`` are replaced. ``{name}`` begins
            with a slash.
        rate: Messages a second of each topic that goes out; ``None``: no limit. Others are dropped, and counted.
        size: Bytes a second of each topic that goes out; ``None``: no limit.
    """

    names: tuple[str, ...] = ("/**",)
    sites: tuple[str, ...] = ("*",)
    modules: tuple[str, ...] = ("*",)
    crossing: Crossing = Crossing.BOTH
    name: str = "{name}"
    rate: float | None = None
    size: int | None = None


@dataclass(frozen=True, slots=True)
class Ros2Settings:
    """The table ``[gateway.ros2]``.

    Args:
        enabled: Whether the gateway joins a ROS 2 graph of rmw_zenoh.
        domain: ``ROS_DOMAIN_ID`` there.
        distribution: Its message definitions: ``humble``, ``jazzy`` and so on, as rosbags names them.
        mapping: Files of rules of ros1_bridge, for types that differ.
    """

    enabled: bool = False
    domain: int = 0
    distribution: str = "jazzy"
    mapping: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class GatewaySettings:
    """The table ``[gateway]``.

    Args:
        site: This site's name; empty: no other sites are joined.
        rank: Among several gateways of a site the one with the lowest rank leads.
        connect: Zenoh endpoints to connect to, such as ``tls/fleet.example:7447``.
        listen: Zenoh endpoints to listen at.
        router: Whether the session is a Zenoh router, which others connect to.
        insecure: Whether to connect without certificates; else a secured module is needed (``rmpa trust``).
        ros1_bridge: Whether to speak zenoh-bridge-ros1's format too.
        ros1_bridge_namespace: The bridge namespace in its keys; ``*`` is its default.
        store: The file of last values; empty: below the state directory.
        ros2: The table ``[gateway.ros2]``.
        rules: The tables ``[[gateway.rule]]``, in order.
    """

    site: str = ""
    rank: int = 100
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    router: bool = False
    insecure: bool = False
    ros1_bridge: bool = False
    ros1_bridge_namespace: str = "*"
    store: str = ""
    ros2: Ros2Settings = Ros2Settings()
    rules: tuple[CrossingRule, ...] = ()
