"""The pieces of an agent's snapshot: what each part tells of itself, at its owner, by these types.

They cross the control socket as JSON (``msgspec``), and some of them the mesh. Times are seconds; ``…_ago`` counts
back from the snapshot. A field that is ``None`` is not known, or not yet. A text "ready to read" is for users.
"""

from __future__ import annotations

import msgspec

from rmpa.core.statistics import SampleSpread

# Why what a peer offers is hidden (``Arrival.cause``): another type here, a permission, ``limits.nodes``.
CONFLICT, DENIED, CROWDED = "conflict", "denied", "crowded"


class ModuleAnswer(msgspec.Struct, frozen=True, kw_only=True):
    """What one module answers to a question that several are asked; for subclasses.

    Attributes:
        module: Its name, as the asking module knows it.
        problem: Why it does not tell, or has not done it; empty: it has.
        code: That of the problem, by ``core.codes``.
    """

    module: str = ""
    problem: str = ""
    code: str = ""


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


class LaneInfo(msgspec.Struct, frozen=True):
    """One of the two lanes of a link.

    Attributes:
        name: ``express`` (control and small messages) or ``bulk`` (large ones).
        connected: Whether it has its TCP connection; messages for a lane without one wait.
        unneeded: Whether it has none because nothing was sent on it yet; the first message dials it.
        bytes_in: Bytes that its present connection has received.
        bytes_out: Bytes that its present connection has sent.
        queued: Bytes that wait in its send queue.
        dropped: Messages dropped because it was too slow, since the link came up.
    """

    name: str
    connected: bool
    unneeded: bool = False
    bytes_in: int = 0
    bytes_out: int = 0
    queued: int = 0
    dropped: int = 0


class LinkInfo(msgspec.Struct, kw_only=True, frozen=True):
    """The live link to a peer.

    Attributes:
        remote: ``address:port`` of the other end of the TCP connection.
        dialled: Whether this agent dialled; else the peer did.
        up_ago: Seconds since it came up.
        rtt: The last round trip on the wire, seconds.
        clock_offset: The peer's wall clock less this machine's, seconds.
        clock_error: Bound of that offset's error, ± seconds.
        bytes_in: Received since it came up.
        bytes_out: Sent since it came up.
        queued: Bytes in its send queues.
        dropped: Messages dropped because the link was too slow.
        heard_ago: Seconds since anything arrived.
        rests: Whether the link is at rest: nothing depends on it, and its keepalives come more rarely.
        lease: Seconds of silence after which the link counts as lost.
        lanes: Its lanes, ``express`` first; empty from an agent that does not report them.
    """

    remote: str
    dialled: bool
    up_ago: float
    rtt: float | None = None
    clock_offset: float | None = None
    clock_error: float | None = None
    bytes_in: int = 0
    bytes_out: int = 0
    queued: int = 0
    dropped: int = 0
    heard_ago: float | None = None
    rests: bool = False
    lease: float = 1.0
    lanes: tuple[LaneInfo, ...] = ()

    @property
    def is_silent(self) -> bool:
        """Whether nothing has come for half the time after which the link counts as lost."""
        return self.heard_ago is not None and self.heard_ago > self.lease / 2


class BoundInfo(msgspec.Struct, kw_only=True, frozen=True):
    """What this module hides of a peer because a limit of its ``[limits]`` is exceeded.

    Attributes:
        kind: The limit: ``nodes``, ``topics`` or ``services``.
        limit: Its value.
        hidden: How many are hidden.
        text: Ready to read, with the remedy.
    """

    kind: str
    limit: int
    hidden: int
    text: str


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
        remote_subscribers: Nodes of other modules that do, as ``module:/node``.
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
    remote_subscribers: tuple[str, ...] = ()
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


class ContractTerm(msgspec.Struct, kw_only=True, frozen=True):
    """One term of a topic's contract by this module's settings; values of the operation ``contract``, by key.

    Attributes:
        value: Its value; seconds, messages a second, or a word of docs/guides/contracts.md.
        rule: What sets it: ``rule 2: topics /cmd/**`` (the second ``[[contract]]``), ``[bridge] transport``, or
            ``default``.
    """

    value: str | float | None
    rule: str


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


class PublisherReport(msgspec.Struct, frozen=True, kw_only=True):
    """One publisher, as its own agent sees it.

    Attributes:
        node: Its name.
        topic: The topic's name in its own graph.
        type: Its message type; ``*`` where it is not known.
        crosses: Whether the policy of its module lets it cross to the agent that asks.
        rule: The rule that says so.
        offered: Whether peers are offered it.
        route: The state of the route to the agent that asks: empty (none), ``opening`` (the publisher has not
            answered) or ``open``.
        messages: Messages received from the publisher since its agent connected to it.
        dropped: Of these, those that were dropped because a link was too slow.
        lost: Messages of a reliable route to the agent that asks that were given up after too long an outage.
        oversized: Messages that are too long, and were left out.
        oversized_bytes: The length of the last of these, in bytes.
        beyond: ``limits.topics`` of its module, if it is not offered because there are more; else 0.
        unreachable: Why its agent cannot connect to it, ready to read; empty where it can.
    """

    node: str
    topic: str = ""
    type: str = ""
    crosses: bool = True
    rule: str = ""
    offered: bool = True
    route: str = ""
    messages: int = 0
    dropped: int = 0
    lost: int = 0
    oversized: int = 0
    oversized_bytes: int = 0
    beyond: int = 0
    unreachable: str = ""


class Arrival(msgspec.Struct, kw_only=True, frozen=True):
    """What the subscribers' agent knows of one publisher of a peer: its route, and the proxy that stands for it.

    Attributes:
        route: The route.
        proxy: The proxy's name.
        registered: Whether it is a publisher of the topic in the local graph.
        cause: Why it is hidden, as ``bridge.peer_offers`` has it; empty if it is not.
        permission: The rule by which the module may publish it here, or may not; empty: trust is off.
        readers: The node, the bytes that wait, and the dropped messages of each local subscriber's connection to the
            proxy, by its number.
        mismatches: The subscribers that were refused here or at the peer, ready to read.
    """

    route: RouteInfo
    proxy: str = ""
    registered: bool = False
    cause: str = ""
    permission: str = ""
    readers: dict[int, tuple[str, int, int]] = {}
    mismatches: tuple[str, ...] = ()
