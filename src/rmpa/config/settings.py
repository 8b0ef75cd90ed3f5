"""The agent's settings, as values; ``config.sources`` reads them from files, variables and flags."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.config import limits

if TYPE_CHECKING:
    from pathlib import Path

    from rmpa.core.contract import ContractRule


@dataclass(frozen=True, slots=True)
class HostPort:
    """An address as written by a user: a host (name or number) and a port, 0 where none was given."""

    host: str
    port: int = 0

    def __str__(self) -> str:
        """``host:port`` or ``host``."""
        return f"{self.host}:{self.port}" if self.port else self.host


@dataclass(frozen=True, slots=True)
class PolicySettings:
    """What may cross the mesh, by globs (``core.names.matches``); the stronger of two answers is "no".

    Args:
        allow: Topics that may cross; empty lets none cross.
        deny: Topics that stay home, on top of the built-in ones.
        allow_types: Message types that may cross.
        deny_types: Message types that stay home.
    """

    allow: tuple[str, ...] = ("/**",)
    deny: tuple[str, ...] = ()
    allow_types: tuple[str, ...] = ("**",)
    deny_types: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Remap:
    """One name that is another one at a peer, or a namespace: both ends with ``/**``.

    Args:
        source: The name before, or ``/namespace/**``; ``{peer}`` in it is the peer's name.
        target: The name after, likewise.
        types: Globs over message types, one of which must fit; empty: topics of any type, and services.
    """

    source: str
    target: str
    types: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PeerRule:
    """One ``[[peer]]``: what holds between us and the peers of some name. All that fit a peer apply, in order.

    Args:
        name: A glob over peers' names.
        prefix: What is put in front of their names here, and taken from ours there; ``{peer}`` is the peer's name.
        remap_in: Their names (before) and what they are here (after); the first that fits.
        remap_out: Our names (before) and what they are there (after).
        policy: What may cross to and from them, on top of ``[bridge]``; in our names, with ``{peer}``.
    """

    name: str
    prefix: str = ""
    remap_in: tuple[Remap, ...] = ()
    remap_out: tuple[Remap, ...] = ()
    policy: PolicySettings = field(default_factory=PolicySettings)


@dataclass(frozen=True, slots=True)
class FollowRule:
    """A parameter, or a namespace as a whole, of another module that this one follows (``[[param]]``).

    Args:
        key: Its global name over there.
        owner: The peer's name.
        to: Its global name here.
    """

    key: str
    owner: str
    to: str

    def __str__(self) -> str:
        """``base:/robot_description as /base/robot_description``."""
        return f"{self.owner}:{self.key}" + (f" as {self.to}" if self.to != self.key else "")


@dataclass(frozen=True, slots=True)
class ParamSettings:
    """What crosses of the parameters.

    Args:
        remote_get: Globs over what peers may read and follow.
        remote_set: Globs over what they may set and delete.
        follow: What this module follows, no two of them within each other.
    """

    remote_get: tuple[str, ...] = ("/**",)
    remote_set: tuple[str, ...] = ("/**",)
    follow: tuple[FollowRule, ...] = ()


@dataclass(frozen=True, slots=True)
class TimeSettings:
    """Simulated time (``/use_sim_time`` and ``/clock``) across modules.

    Args:
        follow: The peer whose time holds here; empty for none.
        share: Whether peers may have ours.
    """

    follow: str = ""
    share: bool = False


@dataclass(frozen=True, slots=True)
class ServiceRule:
    """One ``[[service]]``: what holds for services of some names.

    Args:
        names: Globs over their names here.
        timeout: Seconds that a call may take.
    """

    names: tuple[str, ...]
    timeout: float


@dataclass(frozen=True, slots=True)
class ServiceSettings:
    """What crosses of the services.

    Args:
        allow: Globs over services that may cross, by their names here; empty lets none cross.
        deny: Globs over those that stay home.
        loggers: Whether each node's ``get_loggers`` and ``set_logger_level`` cross too.
        timeout: Seconds that a call may take.
        rules: Exceptions from that; the first that fits holds.
    """

    allow: tuple[str, ...] = ("/**",)
    deny: tuple[str, ...] = ()
    loggers: bool = False
    timeout: float = limits.SERVICE_TIMEOUT
    rules: tuple[ServiceRule, ...] = ()


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """What peers may do with this module's nodes.

    Args:
        kill: Globs over the nodes that they may ask to end (``rosnode kill``, ``rmpa node kill``).
    """

    kill: tuple[str, ...] = ("/**",)


@dataclass(frozen=True, slots=True)
class LaneSettings:
    """How the packets of each lane are marked.

    Args:
        express_dscp: DSCP of the express lane (RFC 2474), 0 to 63. 48 is CS6: Wi-Fi's voice queue, where EF is video.
        express_priority: SO_PRIORITY of the express lane, 0 to 6; 6 is the first band of pfifo_fast.
        bulk_dscp: DSCP of the bulk lane.
        bulk_priority: SO_PRIORITY of the bulk lane.
    """

    express_dscp: int = 48
    express_priority: int = 6
    bulk_dscp: int = 0
    bulk_priority: int = 0


@dataclass(frozen=True, slots=True)
class RealtimeSettings:
    """What the agent asks the kernel for; what it does not get, it says.

    Args:
        enabled: Whether it asks at all (``--realtime``).
        priority: Of SCHED_FIFO, 1 to 99.
        cpus: The CPUs to run on; empty: any.
        lock_memory: Whether its memory stays in RAM (mlockall).
        keep_awake: Whether the CPUs are kept from idle states that they wake from late; it costs power.
    """

    enabled: bool = False
    priority: int = 50
    cpus: tuple[int, ...] = ()
    lock_memory: bool = True
    keep_awake: bool = False


@dataclass(frozen=True, slots=True)
class LimitSettings:
    """How much of one peer is taken, and how much peers are told; what is beyond stays hidden, and is told as such.

    Args:
        nodes: Nodes of one peer that stand in the local graph.
        topics: (topic, node) pairs of one peer, and those that this module offers.
        services: Services of one peer, and those that this module offers.
        params: Parameters that this module follows, and that one peer may follow here.
    """

    nodes: int = limits.NODES_PER_PEER_MAX
    topics: int = limits.TOPICS_PER_PEER_MAX
    services: int = limits.SERVICES_PER_PEER_MAX
    params: int = limits.FOLLOWED_MAX


@dataclass(frozen=True, slots=True)
class Settings:
    """All settings of one agent.

    Args:
        name: The module's name, a ROS base name; empty means: from the host's name.
        domain: Only agents of one domain join.
        core_host: The address that the ROS core listens at.
        core_port: Its port.
        core_mode: ``embedded``: the agent runs the core; ``external``: a roscore that runs already is used.
        core_master: The external core's URI; empty: ROS's own default.
        core_fresh: Whether the embedded core begins empty, whatever it has kept of the run before.
        port: The mesh's port (TCP links, UDP unicast beacons); 0 lets the system choose.
        interfaces: Names of the interfaces to use; empty means all usable ones.
        seeds: Agents to greet by unicast, across sub-networks; port 0 means the domain's discovery port.
        group: Multicast group of the beacons.
        group_port: Its port before the domain is added.
        multicast: Whether beacons are sent to the group at all (``ROS_AUTOMATIC_DISCOVERY_RANGE=OFF`` says no).
        policy: What may cross.
        peers: What holds for single peers, in the order of the file.
        contracts: What the topics need, in the order of the file (``core.contract.Contracts``).
        services: What crosses of the services, and how long a call may take.
        params: What crosses of the parameters.
        nodes: What peers may do with this module's nodes.
        time: Whose simulated time holds.
        limits: How much of one peer is taken.
        lanes: How the lanes are marked.
        realtime: What is asked of the kernel.
        relay: Whether what comes from one peer is offered to others that do not reach it themselves.
        log_level: ``debug``, ``info``, ``warning`` or ``error``.
        log_json: One JSON object a line instead of text.
        config_file: Where the file's part came from, if there was a file.
        runtime_dir: Where control sockets live; empty means the usual place of this user.
        state_dir: Where is kept what survives the agent's end; likewise.
    """

    name: str = ""
    domain: int = 0
    core_host: str = "127.0.0.1"
    core_port: int = 11311
    core_mode: str = "embedded"
    core_master: str = ""
    core_fresh: bool = False
    port: int = 0
    interfaces: tuple[str, ...] = ()
    seeds: tuple[HostPort, ...] = ()
    group: str = limits.MULTICAST_GROUP
    group_port: int = limits.MULTICAST_PORT
    multicast: bool = True
    policy: PolicySettings = field(default_factory=PolicySettings)
    peers: tuple[PeerRule, ...] = ()
    contracts: tuple[ContractRule, ...] = ()
    services: ServiceSettings = field(default_factory=ServiceSettings)
    params: ParamSettings = field(default_factory=ParamSettings)
    nodes: NodeSettings = field(default_factory=NodeSettings)
    time: TimeSettings = field(default_factory=TimeSettings)
    limits: LimitSettings = field(default_factory=LimitSettings)
    lanes: LaneSettings = field(default_factory=LaneSettings)
    realtime: RealtimeSettings = field(default_factory=RealtimeSettings)
    relay: bool = False
    log_level: str = "info"
    log_json: bool = False
    config_file: Path | None = None
    runtime_dir: str = ""
    state_dir: str = ""

    @property
    def discovery_port(self) -> int:
        """The port of this domain's beacons."""
        return self.group_port + self.domain
