"""The state of an agent as one value, built by ``observe.snapshot_builder`` and read by the command line.

It crosses the control socket as JSON (``msgspec``). Times are seconds; ``…_ago`` counts back from the snapshot.
A field that is ``None`` is not known, or not yet. A text "ready to read" is for users.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

import msgspec

from rmpa.observe.peer_info import PeerInfo  # noqa: TC001 - msgspec needs it to decode
from rmpa.trust.permissions import TrustStatus  # noqa: TC001 - msgspec needs it to decode

if TYPE_CHECKING:
    from rmpa.core.statistics import SampleSummary


class FilesInfo(msgspec.Struct, kw_only=True, frozen=True):
    """The file descriptors of the agent's process.

    Attributes:
        open: How many are open.
        limit: How many it may have (the soft limit, ``ulimit -n``).
        hard: What the limit may be raised to (``ulimit -Hn``).
        reserved: How many are kept for the ROS core, the control socket and the links to peers.
        near: Whether nearly all that are not reserved are open.
        refused: Attempts to accept or to dial that found none free so far, repetitions included.
        problem: What waits for one now, and what to do, ready to read; empty where nothing does.
    """

    open: int
    limit: int
    hard: int
    reserved: int
    near: bool = False
    refused: int = 0
    problem: str = ""


class AgentInfo(msgspec.Struct, kw_only=True, frozen=True):
    """The agent itself.

    Attributes:
        name: The module's name.
        guid: ``10.0.0.1:40001#7``.
        instance: The random id of this run, 32 hexadecimal digits.
        domain: Its domain id.
        core_uri: The ROS core's, as in ROS_MASTER_URI: ``http://127.0.0.1:11311/``.
        version: Of RMPA.
        pid: The agent's process.
        started: Seconds since the epoch.
        uptime: Seconds.
        cpu: Share of one core over the last second or longer, in percent.
        rss: Resident memory, bytes.
        addresses: Its numeric IPv4 addresses, best first.
        interfaces: The interfaces that beacons go out on.
        config_file: Where its settings were read, or empty.
        realtime: The outcome of each request of ``--realtime``, ready to read; empty without it.
        files: Its file descriptors.
        proxies: The number of proxies of peers' nodes in the local graph.
        proxy_sockets: Listening sockets of all of them together.
        proxy_listening: How these are used, ready to read: the ports that all share, or why each has its own.
        core_memory: Where the core stores registrations and parameters, and what it took over from its last run,
            ready to read; empty for a core that stores nothing.
    """

    name: str
    guid: str
    instance: str
    domain: int
    core_uri: str
    version: str
    pid: int
    started: float
    uptime: float
    cpu: float | None = None
    rss: int | None = None
    addresses: tuple[str, ...] = ()
    interfaces: tuple[str, ...] = ()
    config_file: str = ""
    realtime: tuple[str, ...] = ()
    files: FilesInfo | None = None
    proxies: int = 0
    proxy_sockets: int = 0
    proxy_listening: str = ""
    core_memory: str = ""


class SampleSpread(msgspec.Struct, kw_only=True, frozen=True):
    """The distribution of samples, in seconds. Percentiles are interpolated linearly.

    Attributes:
        count: The number of samples.
        mean: Their mean.
        sd: Their standard deviation.
        min: The least.
        max: The greatest.
        p50: The median.
        p99: The 99th percentile.
    """

    count: int
    mean: float
    sd: float
    min: float
    max: float
    p50: float
    p99: float

    @classmethod
    def of(cls, samples: SampleSummary, **more: Any) -> Self:
        """The distribution that a summary holds; ``more`` are the fields of a subclass."""
        same: dict[str, Any] = {name: getattr(samples, name) for name in ("count", "mean", "sd", "p50", "p99")}
        return cls(min=samples.minimum, max=samples.maximum, **same, **more)


class LatencyInfo(SampleSpread, kw_only=True, frozen=True):
    """One-way latencies, from the publisher's agent receiving a message to this agent handing it on.

    Attributes:
        last: The last message's.
        error: The bound of their error, ±: how well the other machine's clock is known.
    """

    last: float
    error: float


class EventInfo(msgspec.Struct, kw_only=True, frozen=True):
    """An event of a topic's contract.

    Attributes:
        kind: ``deadline_missed``, ``lifespan_expired``, ``liveliness_lost``, ``liveliness_restored`` or
            ``messages_lost``.
        count: How many times, or how many messages.
        text: Ready to read.
        ago: Seconds since it happened.
    """

    kind: str
    count: int
    text: str
    ago: float


class SubscriberTransport(msgspec.Struct, kw_only=True, frozen=True):
    """The transport of one subscriber of a route: of a local one (``in``), or of a peer's (``out``).

    Attributes:
        node: The subscriber, by its name in its own graph.
        transport: The path of its messages now: ``direct``, ``relay``, or empty while it has none.
        state: What is decided: ``asking`` (the peer is asked, and the publisher's port is tried), ``direct``
            or ``relayed``; of outgoing routes ``granted``.
        since_ago: Seconds since a direct connection was answered, else since the state began; ``None``: not known.
        wanted: The transport that the contract of the subscriber's module asks for; empty for ``out``.
        endpoint: ``address:port`` of the publisher's node while the transport is direct; ``out``: the port alone.
        condition: The condition of direct transport that does not hold (docs/guides/contracts.md), if it is relayed.
        text: That as text, ready to read.
        interruptions: How often it was without a path: moved between transports, its connection broken, or its link
            lost. What was published meanwhile is lost, and not counted.
        interrupted: How long the last of these lasted, or lasts, in seconds.
        interrupted_ago: Seconds since it was over; ``None`` while it lasts.
    """

    node: str
    transport: str = ""
    state: str = ""
    since_ago: float | None = None
    wanted: str = ""
    endpoint: str = ""
    condition: str = ""
    text: str = ""
    interruptions: int = 0
    interrupted: float | None = None
    interrupted_ago: float | None = None


class RouteInfo(msgspec.Struct, kw_only=True, frozen=True):
    """The route of one source, a publisher of a topic at one node, between this module and a peer.

    Figures are of the messages that an open route brought in the last minute, within the bounds of its statistics.
    Messages of direct transport do not pass the agents: ``state`` and all figures are of the relayed transport alone.

    Attributes:
        peer: The peer it comes from, or goes to.
        node: The publishing node, by its name in its own graph.
        direction: ``in`` or ``out``.
        state: Of incoming routes ``idle`` (no subscriber), ``opening``, ``open``, ``lingering``, ``waiting`` (it
            failed and is tried again) or ``hidden`` (see ``problem``); of outgoing ones ``open`` or ``away`` (the
            peer has no link, and reliable messages are kept or counted for it) or ``idle`` (its subscribers there
            are connected directly).
        type: The message type that the source has.
        md5: Of that type; empty before it is known.
        messages: Messages that crossed since the route was opened.
        bytes: Of these, without TCPROS's length fields.
        dropped: Messages dropped because a receiver was slow.
        lost: Messages that never arrived, by the gaps in their numbers and by the sender's reports; of outgoing
            reliable routes: messages that were given up.
        kept: Of outgoing reliable routes: messages that wait for the peer.
        oversized: Messages that the publisher's agent left out because they are too long to cross.
        oversized_bytes: The length of the last of these, in bytes.
        late: Messages left out because a newer one had arrived, or because an outage delayed them.
        expired: Messages dropped beyond their lifespan.
        age: Seconds since the last message.
        rate: Messages a second.
        bandwidth: Bytes a second.
        period: From one message to the next.
        jitter: The period's 99th percentile less its median, seconds.
        latency: One-way; not known before the peer's clock is.
        latched: Whether the publisher latches.
        lane: ``express`` or ``bulk``; empty before it is known.
        contract: The topic's contract, without defaults, by key.
        events: The contract's events, counted by kind.
        recent: The last of these, oldest first.
        problem: Why nothing flows, ready to read; empty if nothing is wrong.
        wire: The topic's name at the peer, where that differs.
        limit: The limit that hides it, ``nodes`` or ``topics``; empty if none does.
        transport: How its messages go: ``direct``, ``relay``, ``both`` (its subscribers differ), or empty while none
            is in use.
        condition: Why a subscriber is relayed: the condition of direct transport that does not hold
            (docs/guides/contracts.md); empty where none is relayed.
        condition_text: That as text, ready to read.
        subscribers: The subscribers that have, or may get, a direct connection, by name. ``in``: of this module, if
            its contract's transport is ``direct`` or ``auto``; ``out``: of the peer, if one was granted.
    """

    peer: str
    node: str
    direction: str
    state: str
    type: str = ""
    md5: str = ""
    messages: int = 0
    bytes: int = 0
    dropped: int = 0
    lost: int = 0
    kept: int = 0
    oversized: int = 0
    oversized_bytes: int = 0
    late: int = 0
    expired: int = 0
    age: float | None = None
    rate: float | None = None
    bandwidth: float | None = None
    period: SampleSpread | None = None
    jitter: float | None = None
    latency: LatencyInfo | None = None
    latched: bool = False
    lane: str = ""
    contract: dict[str, str | float | None] = {}
    events: dict[str, int] = {}
    recent: tuple[EventInfo, ...] = ()
    problem: str = ""
    wire: str = ""
    limit: str = ""
    transport: str = ""
    condition: str = ""
    condition_text: str = ""
    subscribers: tuple[SubscriberTransport, ...] = ()


class TopicInfo(msgspec.Struct, kw_only=True, frozen=True):
    """One topic of the local graph, or one that peers offer.

    Attributes:
        name: Its global name.
        type: Its type in the local graph; ``*`` or empty where that is not known.
        md5: Of that type; empty before it is known.
        publishers: Local nodes that publish it, without proxies.
        subscribers: Local nodes that subscribe to it, without the agent's own.
        routes: Its routes to and from peers.
        crosses: Whether policy lets it cross.
        policy: The rule that says so, ready to read.
        mismatches: Sources and subscribers with another type or md5 sum, each ready to read.
        unreachable: Local publishers to which no connection can be made, each ready to read.
    """

    name: str
    type: str = ""
    md5: str = ""
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()
    routes: tuple[RouteInfo, ...] = ()
    crosses: bool = True
    policy: str = ""
    mismatches: tuple[str, ...] = ()
    unreachable: tuple[str, ...] = ()

    @property
    def peers(self) -> tuple[str, ...]:
        """The peers that publish it, each once, in order."""
        return tuple(sorted({route.peer for route in self.routes if route.direction == "in"}))


class ServiceInfo(msgspec.Struct, kw_only=True, frozen=True):
    """One service: of the local graph, or of a peer.

    Attributes:
        name: Its global name here.
        node: The node that provides it, by its name in its own graph.
        direction: ``out`` (of this module; peers may call it) or ``in`` (a peer's).
        peer: The module that provides it; empty for ``out``.
        state: ``in``: ``hidden`` (not in the local graph: see ``hidden``), ``idle`` (no client), ``opening`` or
            ``open``. ``out``: ``home`` (policy does not let it cross), ``idle``, or ``open`` (a peer has it open).
        wire: Its name on the wire, and in the peer's own graph, where that differs.
        type: ``package/Name``; empty before a client has asked for it.
        md5: Of that type, likewise.
        callers: ``out``: the peers that have it open.
        transport: ``in``: ``direct`` (clients call the server itself) or ``relay``; empty for ``out``.
        wanted: The transport that the rules of this module ask for: ``relay``, ``direct`` or ``auto``.
        condition: ``in``: the condition of direct transport that does not hold, in one word; empty if none is known.
        relayed_because: That condition's fact, ready to read.
        address: ``in``: where clients call the server directly, ``rosrpc://address:port``; else empty.
        lookups: ``in``: lookups that were answered with that address.
        direct_callers: ``out``: the peers whose nodes may call the server directly.
        calls: Calls across the mesh so far; direct ones pass no agent, and are not counted.
        failed: Of these, those that ended with an error.
        active: Calls under way.
        latency: Of the last successful calls; ``in``: from a client's request to its reply, ``out``: the server's
            part of that.
        crosses: Whether policy lets it cross.
        policy: The rule that says so, ready to read.
        hidden: Why a peer's service is not in the local graph, ready to read; empty where it is.
        problem: Why the last call, or the last attempt to open it, failed; empty if none did.
    """

    name: str
    node: str
    direction: str
    peer: str = ""
    state: str = "idle"
    wire: str = ""
    type: str = ""
    md5: str = ""
    callers: tuple[str, ...] = ()
    transport: str = ""
    wanted: str = "relay"
    condition: str = ""
    relayed_because: str = ""
    address: str = ""
    lookups: int = 0
    direct_callers: tuple[str, ...] = ()
    calls: int = 0
    failed: int = 0
    active: int = 0
    latency: SampleSpread | None = None
    crosses: bool = True
    policy: str = ""
    hidden: str = ""
    problem: str = ""


class UnreachableInfo(msgspec.Struct, kw_only=True, frozen=True):
    """A node of the local graph to which no connection can be made; it may be dead, or its network may be down.

    Attributes:
        node: Its name.
        uri: The slave API that it registered with.
        problem: Why it cannot be reached, ready to read.
        ago: Seconds since that was found.
        withdrawn: Whether its topics are no longer offered to peers.
    """

    node: str
    uri: str
    problem: str
    ago: float
    withdrawn: bool = False

    def __str__(self) -> str:
        """The problem as a text for users."""
        text = f"{self.node} cannot be reached at {self.uri} ({self.problem})"
        return f"{text}, so peers are not offered it" if self.withdrawn else text


class Snapshot(msgspec.Struct, kw_only=True, frozen=True):
    """The state of an agent at one moment.

    Attributes:
        agent: The agent itself.
        taken: When, seconds since the epoch.
        peers: The roster, by name.
        topics: The graph's topics, by name.
        services: The graph's services and the peers', by name; of one name first the local one.
        counters: What was refused or dropped, by name: ``beacon.malformed`` …
        notes: What the user should know (a port taken, no multicast), each ready to read.
        unreachable: Nodes of the local graph to which no connection can be made, by name.
        trust: The module's membership of a secured mesh; ``None``: trust is off.
        topics_left: Topics that are not in it, as nothing here uses them, if only so many were asked for.
        services_left: Services, likewise.
        strangers: Modules that are heard and are not of this mesh, in the states ``pending``, ``revoked`` and
            ``foreign``. ``last_error`` says what to do; nothing that they say of themselves is proved.
        lost: The relay that brought a module last, by the names of both, of each that no relay brings any more.
    """

    agent: AgentInfo
    taken: float
    peers: tuple[PeerInfo, ...] = ()
    topics: tuple[TopicInfo, ...] = ()
    services: tuple[ServiceInfo, ...] = ()
    counters: dict[str, int] = {}
    notes: tuple[str, ...] = ()
    unreachable: tuple[UnreachableInfo, ...] = ()
    trust: TrustStatus | None = None
    topics_left: int = 0
    services_left: int = 0
    strangers: tuple[PeerInfo, ...] = ()
    lost: dict[str, str] = {}


class FollowedInfo(msgspec.Struct, kw_only=True, frozen=True):
    """A parameter of another module that this one follows; a value of the operation ``followed``.

    Attributes:
        key: Its name here.
        owner: The peer's name.
        owner_key: Its name at the owner.
        state: ``followed``; ``waiting`` for its owner; ``refused``.
        size: Characters of its value as XML-RPC text; ``None`` where the owner has none, or has not replied.
        problem: What is wrong, or empty.
    """

    key: str
    owner: str
    owner_key: str
    state: str
    size: int | None = None
    problem: str = ""


class PingReply(msgspec.Struct, kw_only=True, frozen=True):
    """The value of the operation ``ping``.

    Attributes:
        times: Round trips over the mesh in seconds, in order; ``None`` for one that was lost.
        remote: ``address:port`` of the link's other end.
    """

    times: tuple[float | None, ...]
    remote: str = ""
