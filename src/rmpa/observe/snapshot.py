"""What an agent shows of itself: one value, built in ``rmpa.agent``, read by the CLI.

It crosses the control socket as JSON (``msgspec``). Times are seconds; ``…_ago`` counts back from the snapshot.
A field that is ``None`` is not known, or not yet.
"""

from __future__ import annotations

import msgspec


class FilesInfo(msgspec.Struct, kw_only=True, frozen=True):
    """The file descriptors of the agent's process.

    Attributes:
        open: How many are open.
        limit: How many it may have (the soft limit, ``ulimit -n``).
        hard: What the limit may be raised to (``ulimit -Hn``).
        reserved: The last ones, kept for the ROS core, the control socket and the links to peers.
        near: Whether there are soon none left for data.
        refused: Attempts to accept or to dial so far for which there was none, repetitions among them.
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
        realtime: What came of each wish of ``--realtime``, ready to read; empty without it.
        files: Its file descriptors.
        proxies: Nodes of peers that stand in the local graph.
        proxy_sockets: Sockets that listen for all of them together.
        proxy_listening: How these are used, ready to read: the ports that all share, or why each has its own.
        core_memory: Where the core keeps its registrations and parameters, and what it took up of the run before,
            ready to read; empty for one that keeps nothing.
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


class LinkInfo(msgspec.Struct, kw_only=True, frozen=True):
    """The live link to a peer.

    Attributes:
        remote: ``address:port`` of the other end of the TCP connection.
        dialled: Whether we dialled; else the peer did.
        up_ago: Seconds since it came up.
        rtt: Round trip, seconds: the least of the last ones.
        clock_offset: The peer's wall clock less ours, seconds.
        clock_error: Bound of that offset's error, ± seconds.
        bytes_in: Received since it came up.
        bytes_out: Sent since it came up.
        queued: Bytes that wait for the peer to take them.
        dropped: Messages dropped because it took them too slowly.
        heard_ago: Seconds since anything arrived.
        packet: Bytes of the largest packet that large messages leave in, headers included.
        path_problem: What is wrong with the path to it, ready to read; empty if nothing is known.
        path_remedy: What to do about that.
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
    packet: int | None = None
    path_problem: str = ""
    path_remedy: str = ""


class BoundInfo(msgspec.Struct, kw_only=True, frozen=True):
    """Something of a module that another one hides because there is more than its ``[limits]`` say.

    Attributes:
        kind: The limit: ``nodes``, ``topics`` or ``services``.
        limit: Its value.
        hidden: How many of these are hidden.
        here: Whether they are the peer's and hidden here; else they are ours and hidden there.
        text: Ready to read, with the remedy.
    """

    kind: str
    limit: int
    hidden: int
    here: bool
    text: str


class PeerInfo(msgspec.Struct, kw_only=True, frozen=True):
    """One peer of the roster.

    Attributes:
        name: Its name.
        guid: Its GUID as text.
        instance: The random id of its run, 32 hexadecimal digits.
        addresses: Where it can be reached, best first.
        state: ``linked``; ``linking`` (dialling, or waiting to be dialled); ``refused`` (it said no, or we did);
            ``conflict`` (shares a GUID or a name with another); ``relayed`` (no link, but another peer passes on what
            it publishes).
        since_ago: Seconds since it came into this state.
        found_ago: Seconds since it was first heard of.
        beacon_ago: Seconds since its last beacon.
        source: How it was found: ``multicast``, ``unicast``, ``seed``, ``gossip`` or ``link``.
        link: The link, while there is one.
        last_error: Why the last attempt or link failed, ready to read; empty if none did.
        next_attempt: Seconds until the next attempt to dial.
        conflicts: What is wrong with its identity, each ready to read.
        topics_in: Topics that it offers us.
        topics_out: Topics that we offer it.
        via: The name of the peer that passes on what it publishes, if one does.
        beyond: What of it is hidden here, and what of ours there, by the limits of either side.
    """

    name: str
    guid: str
    instance: str
    state: str
    since_ago: float
    addresses: tuple[str, ...] = ()
    found_ago: float | None = None
    beacon_ago: float | None = None
    source: str = ""
    link: LinkInfo | None = None
    last_error: str = ""
    next_attempt: float | None = None
    conflicts: tuple[str, ...] = ()
    topics_in: int = 0
    topics_out: int = 0
    via: str = ""
    beyond: tuple[BoundInfo, ...] = ()


class SampleSpread(msgspec.Struct, kw_only=True, frozen=True):
    """How samples are spread, in seconds. The percentiles are linear between neighbours.

    Attributes:
        count: Of samples.
        mean: Their mean.
        sd: Their standard deviation.
        min: The least.
        max: The greatest.
        p50: Half of them are below.
        p99: 99 of 100 are below.
    """

    count: int
    mean: float
    sd: float
    min: float
    max: float
    p50: float
    p99: float


class LatencyInfo(SampleSpread, kw_only=True, frozen=True):
    """One-way latencies, from the publisher's agent taking a message to this agent handing it on.

    Attributes:
        count: Of messages.
        mean: Their mean.
        sd: Their standard deviation.
        min: The least.
        max: The greatest.
        p50: Half of them are below.
        p99: 99 of 100 are below.
        last: The last message's.
        error: The true ones lie within ± this: what is known of the other machine's clock.
    """

    last: float
    error: float


class EventInfo(msgspec.Struct, kw_only=True, frozen=True):
    """What happened to a topic's contract.

    Attributes:
        kind: ``deadline_missed``, ``lifespan_expired``, ``liveliness_lost``, ``liveliness_restored`` or
            ``messages_lost``.
        count: How often, or to how many messages.
        text: Ready to read.
        ago: Seconds since then.
    """

    kind: str
    count: int
    text: str
    ago: float


class RouteInfo(msgspec.Struct, kw_only=True, frozen=True):
    """One source that crosses the mesh, seen from here.

    The figures are of the messages that an open route brought in the last minute, as far as they are remembered.

    Attributes:
        peer: The peer it comes from, or goes to.
        node: The publishing node, by its name in its own graph.
        direction: ``in`` or ``out``.
        state: ``idle`` (visible, nobody listens), ``opening``, ``open``, ``lingering``, ``waiting`` (it failed and
            is tried again) or ``hidden`` (not shown: see ``problem``); of those that go out ``open`` or ``away`` (the
            peer has no link, and reliable messages are kept or counted for it).
        type: The message type that the source has.
        md5: Of that type; empty before it is known.
        messages: That crossed since the route was opened.
        bytes: Of these, without the lengths that TCPROS puts in front.
        dropped: Messages dropped because a receiver was slow.
        lost: Messages that never came, by the gaps in their numbers and by what the sender says; of a route that goes
            out: messages of a reliable one that were given up.
        kept: Messages that wait for the peer, of a reliable route that goes out.
        oversized: Messages that the publisher's agent left out because they are too long to cross.
        oversized_bytes: The last one's.
        late: Messages that came behind newer ones, or that an outage held up, and were left out.
        expired: Messages dropped beyond their lifespan.
        age: Seconds since the last message.
        rate: Messages a second.
        bandwidth: Bytes a second.
        period: From one message to the next.
        jitter: The period's 99th percentile less its median, seconds.
        latency: On the way; needs the link's clock.
        latched: Whether its publisher latches.
        lane: ``express`` or ``bulk``; empty before it is known.
        contract: What the topic's contract says that is not the default, by key.
        events: What happened to the contract, counted by kind.
        recent: The last of these, oldest first.
        problem: Why it does not flow, ready to read; empty if nothing is wrong.
        wire: The topic's name over there, where that is another one than here.
        limit: The setting that hides it, where one of ``[limits]`` does: ``nodes`` or ``topics``; else empty.
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


class TopicInfo(msgspec.Struct, kw_only=True, frozen=True):
    """One topic of the local graph, or one that peers offer.

    Attributes:
        name: Its global name.
        type: The local graph's type; ``*`` or empty where nobody has told it.
        md5: Of that type; empty before it is known.
        publishers: Local nodes that publish it (proxies of peers left out).
        subscribers: Local nodes that subscribe to it (our own left out).
        routes: What of it crosses.
        crosses: Whether policy lets it cross.
        policy: The rule that says so, ready to read.
        mismatches: Sources with another type or md5, each ready to read.
        unreachable: Local publishers that nothing can connect to, each ready to read.
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
        peer: Whose it is; empty for ``out``.
        state: ``in``: ``hidden`` (not in the local graph: see ``hidden``), ``idle`` (nobody calls it), ``opening`` or
            ``open``. ``out``: ``home`` (policy keeps it here), ``idle``, or ``open`` (some peer has it open).
        wire: Its name on the way, and in the peer's own graph, where that differs.
        type: ``package/Name``; empty before anybody asked for it.
        md5: Of that type, likewise.
        callers: ``out``: the peers that have it open.
        calls: Calls made across the mesh so far.
        failed: Of these, those that ended with an error.
        active: Calls under way.
        latency: ``in``: from a client's request to its reply; ``out``: the server's part of it. Seconds, of the last
            calls that went well.
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
    calls: int = 0
    failed: int = 0
    active: int = 0
    latency: SampleSpread | None = None
    crosses: bool = True
    policy: str = ""
    hidden: str = ""
    problem: str = ""


class UnreachableInfo(msgspec.Struct, kw_only=True, frozen=True):
    """A node of the local graph that nothing can connect to; it may be dead, or its network may be down.

    Attributes:
        node: Its name.
        uri: The slave API that it registered with.
        problem: Why it cannot be reached, ready to read.
        ago: Seconds since it was first found so.
        withdrawn: Whether peers are not offered it any more.
    """

    node: str
    uri: str
    problem: str
    ago: float
    withdrawn: bool = False

    def __str__(self) -> str:
        """What is wrong, for people."""
        text = f"{self.node} cannot be reached at {self.uri} ({self.problem})"
        return f"{text}, so peers are not offered it" if self.withdrawn else text


class Snapshot(msgspec.Struct, kw_only=True, frozen=True):
    """Everything at one moment.

    Attributes:
        agent: The agent itself.
        taken: When, seconds since the epoch.
        peers: The roster, by name.
        topics: The graph's topics, by name.
        services: The graph's services and the peers', by name; of one name first the local one.
        counters: What was refused or dropped, by name: ``beacon.malformed`` …
        notes: What the user should know (a port taken, no multicast), each ready to read.
        unreachable: Nodes of the local graph that nothing can connect to, by name.
    """

    agent: AgentInfo
    taken: float
    peers: tuple[PeerInfo, ...] = ()
    topics: tuple[TopicInfo, ...] = ()
    services: tuple[ServiceInfo, ...] = ()
    counters: dict[str, int] = {}
    notes: tuple[str, ...] = ()
    unreachable: tuple[UnreachableInfo, ...] = ()


class FollowedInfo(msgspec.Struct, kw_only=True, frozen=True):
    """One parameter of another module that this one follows; a value of the op ``followed``.

    Attributes:
        key: Its name here.
        owner: The peer's name.
        owner_key: Its name over there.
        state: ``followed``; ``waiting`` for its owner; ``refused``.
        size: Characters of its value as XML-RPC text; ``None`` where its owner has none, or has not told it.
        problem: What is wrong, or empty.
    """

    key: str
    owner: str
    owner_key: str
    state: str
    size: int | None = None
    problem: str = ""


class PingReply(msgspec.Struct, kw_only=True, frozen=True):
    """The value of the op ``ping``.

    Attributes:
        times: Round trips over the mesh in seconds, in order; ``None`` for one that was lost.
        remote: ``address:port`` of the peer's end of the link.
    """

    times: tuple[float | None, ...]
    remote: str = ""
