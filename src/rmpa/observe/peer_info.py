"""What is shown of a peer, of sites and of a check's result.

The peers in an agent's snapshot: each peer of the roster, its link and the link's lanes.

Times are seconds; ``…_ago`` counts back from the snapshot.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final, Self

import msgspec

from rmpa.core import codes
from rmpa.trust.permissions import TrustReason, not_of_this_mesh

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from rmpa.trust.permissions import TrustStatus

# The state of a module that is heard, or refuses this one, because it is not of this mesh.
FOREIGN: Final = "foreign"
# The state of a module that an invitation would let in: it has no keys and this mesh is secured, or the other way.
PENDING: Final = "pending"
# The state of a module that was revoked and knocks again; of all others where it is this one.
REVOKED: Final = "revoked"


class LaneInfo(msgspec.Struct, kw_only=True, frozen=True):
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
        rests: Whether the link is at rest: nothing depends on it, and keepalives come every 5 s, with more than 50
            peers more rarely.
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


class PeerInfo(msgspec.Struct, kw_only=True, frozen=True):
    """One peer of the roster.

    Attributes:
        name: Its name.
        guid: Its GUID as text.
        instance: The random id of its run, 32 hexadecimal digits.
        addresses: Where it can be reached, best first.
        state: ``linked``; ``linking`` (dialling, or waiting to be dialled); ``refused`` (by either side);
            ``conflict`` (shares a GUID or an address with another, so it cannot be linked); ``relayed`` (has no link;
            another peer relays its topics); ``pending`` (either it or this module has no keys of a mesh, so that an
            invitation would link them); ``revoked``; ``foreign`` (is not of this mesh).
        since_ago: Seconds since it came into this state.
        found_ago: Seconds since it was found.
        beacon_ago: Seconds since its last beacon.
        source: How it was found: ``multicast``, ``unicast``, ``seed``, ``gossip`` or ``link``.
        link: The link, while there is one.
        last_error: Why the last attempt or link failed, ready to read; empty if none did.
        next_attempt: Seconds until the next attempt to dial.
        conflicts: What is wrong with its identity or its names, each ready to read. Only in the state ``conflict``
            they keep it from being linked; else its messages come.
        topics_in: The number of topics that it offers.
        topics_out: The number of topics that it is offered.
        via: The name of the peer that relays its topics, if one does.
        beyond: What this module hides of it by its limits.
        direct_in: Subscribers here that are connected to its nodes directly.
        direct_out: Its subscribers that may connect to nodes here directly.
        invite: While it is pending: the command that makes the invitation, at the authority; else empty.
        code: Why it is not linked, by ``core.codes``; empty where nothing is wrong.
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
    direct_in: int = 0
    direct_out: int = 0
    invite: str = ""
    code: str = ""

    def __post_init__(self) -> None:
        """Take the code from the state, where there is something to tell."""
        told = self.last_error or self.conflicts or self.state not in ("linked", "linking", "relayed")
        code = codes.PEER_STATES.get(self.state, "name-conflict" if self.conflicts else "")
        if told and code and not self.code:
            msgspec.structs.force_setattr(self, "code", code)


# --- Modules that knock ---------------------------------------------------------------------------------------------
#
# What is shown of a module that is heard and is not of this mesh. Nothing that it says is proved.

_RESTART: Final = "sudo systemctl restart rmpa if the service runs it, else end it, then rmpa up"


def judge_stranger(
    name: str, reason: TrustReason | None, problem: str, *, trust: TrustStatus | None, members: Collection[str]
) -> tuple[str, str, str] | None:
    """What is shown of a module whose beacons are refused.

    Args:
        name: Its name, as it says.
        reason: Why its beacons are refused, as ``discovery.Stranger`` has it.
        problem: Likewise.
        trust: The state of trust here; ``None``: it is off.
        members: The names of this module and of those that are linked or relayed, in lower case. Names that differ
            only in case are the same to a user.

    Returns:
        Its state, the text for ``PeerInfo.last_error``, and the command that lets it in; ``None``: it is not shown.
    """
    folded = name.casefold()
    revoked = trust is not None and folded in map(str.casefold, trust.revoked)
    if trust is None or (reason is TrustReason.REVOKED and not revoked):
        return None if reason is TrustReason.REVOKED else (FOREIGN, problem, "")
    certificates = {member.name.casefold(): member.name for member in trust.members}
    certified = certificates.get(folded) == name
    if folded in members or (folded in certificates and not certified):
        if reason is TrustReason.REVOKED:
            return None  # it has joined again
        text = f"not of this mesh: it uses the name {name} without a certificate"
        return FOREIGN, f"{text}; do not invite it; if it is yours, give it another name: rmpa up --name", ""
    invite = f"rmpa trust invite --module {name}"
    where = "here" if trust.is_authority else f"on {trust.authority or 'the authority'}"
    lets_in = f"run {where}: {invite} (it prints the line to run on {name})"
    if revoked and not certified:
        text = f"revoked: its beacons have the name {name}, which was revoked; to let it back in, rmpa trust leave"
        return REVOKED, f"{text} --yes on {name}, then {lets_in}", ""
    if reason is not TrustReason.UNSECURED:
        return FOREIGN, problem, ""
    if certified:
        text = (
            f"its beacons have the name {name} and no certificate, while {name} has one; if it is {name}, its agent"
        )
        restart = f"runs without its keys: restart it: {_RESTART}; if these are lost, {lets_in}"
        return PENDING, f"pending: {text} {restart}", invite
    text = "pending: it has no keys, so its name and address are not proved"
    return PENDING, f"{text}; if it is yours, {lets_in}", invite


def judge_refusal(reason: TrustReason, own: str, restart: str = "") -> tuple[str, str, str]:
    """What is shown of a peer that refuses this module, or is refused, as not of its mesh; as ``judge_stranger``.

    Args:
        reason: The word of the refusal.
        own: The name of this module.
        restart: How to restart this module's agent, if it has joined since that started; else empty.
    """
    if reason is not TrustReason.PLAIN:
        return FOREIGN, not_of_this_mesh(reason), ""
    if restart:
        return PENDING, f"pending: this module has its keys, but its agent runs without; restart it: {restart}", ""
    invite = f"rmpa trust invite --module {own}"
    text = "pending: this module has no keys of that secured mesh; to join it, run on its authority"
    return PENDING, f"{text}: {invite} (it prints the line to run here)", invite


# --- What an agent tells its peers of itself ------------------------------------------------------------------------
#
# The answer to their question ``agent.info``.


# The request for what an agent tells of itself.
INFO: Final = "agent.info"


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


# --- Other sites as a gateway sees them -----------------------------------------------------------------------------
#
# What ``rmpa site`` shows.


class SiteModuleInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A module of a site.

    Attributes:
        name: The module.
        instance: Its run, 32 hexadecimal digits.
        topics: Its topics that its site offers, each publisher counted.
        services: Its services that its site offers.
        shown: How many of both are in the graph here; for a module of this site: how many are offered.
    """

    name: str
    instance: str = ""
    topics: int = 0
    services: int = 0
    shown: int = 0


class SiteSourceInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A topic of one publisher, or a service, of a site.

    Attributes:
        kind: ``topic`` or ``service``.
        module: The module.
        node: The node in its module's graph.
        name: Its name there.
        type: ``package/Name``; ``*`` for a service whose server was not asked.
        here: Its name in the gateway's graph; empty if it is not shown.
        problem: Why it does not cross, or does not work; empty for nothing.
    """

    kind: str
    module: str
    node: str
    name: str
    type: str = "*"
    here: str = ""
    problem: str = ""


class SiteInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A site.

    Attributes:
        name: The site.
        state: ``this site``; ``joined``; ``no gateway``: its modules are announced and no gateway leads it;
            ``unreachable``: it was there, and is not now.
        since_ago: Seconds since that is so; ``None``: unknown.
        gateways: How many gateways it has.
        modules: Its modules.
        sources: What it offers, in ``rmpa site info`` alone.
        not_shown: How many sources a rule or a conflict of names keeps out.
        beyond: Sources that were left out because there are too many.
    """

    name: str
    state: str = "joined"
    since_ago: float | None = None
    gateways: int = 0
    modules: tuple[SiteModuleInfo, ...] = ()
    sources: tuple[SiteSourceInfo, ...] = ()
    not_shown: int = 0
    beyond: int = 0


class SitesReport(msgspec.Struct, frozen=True, kw_only=True):
    """What one gateway joins.

    Attributes:
        gateway: The gateway's name among its peers.
        site: Its site.
        leads: Whether it is the one that exports and imports.
        rank: Of gateways of one site the lowest leads.
        problem: Why no other site can be reached; empty for nothing.
        endpoints: The Zenoh endpoints that it is connected to.
        sites: This site first, then the others.
    """

    gateway: str
    site: str
    leads: bool = False
    rank: int = 0
    problem: str = ""
    endpoints: tuple[str, ...] = ()
    sites: tuple[SiteInfo, ...] = ()


# The terms of a topic's contract by the settings of a module, which the topic has before any route is open.


class ContractTerm(msgspec.Struct, kw_only=True, frozen=True):
    """One term of a topic's contract by this module's settings; values of the operation ``contract``, by key.

    Attributes:
        value: Its value; seconds, messages a second, or a word of docs/guides/contracts.md.
        rule: What sets it: ``rule 2: topics /cmd/**`` (the second ``[[contract]]``), ``[bridge] transport``, or
            ``default``.
    """

    value: str | float | None
    rule: str


# --- The result of a check ------------------------------------------------------------------------------------------
#
# One model behind ``rmpa doctor``, ``rmpa why``, the agent's health and ``/diagnostics``.


class CheckLevel(StrEnum):
    """How bad a result is."""

    OK = "ok"
    # It works, or may work: the first thing to check when something fails.
    WARN = "warn"
    # Something cannot work like this. ERROR on ``/diagnostics``.
    FAIL = "fail"
    # It could not be checked.
    SKIPPED = "skipped"
    # The agent that knows the answer did not reply; the walk along a path goes on.
    UNKNOWN = "unknown"
    # It existed before, and is gone (REP 107).
    STALE = "stale"


OK, WARN, FAIL = CheckLevel.OK, CheckLevel.WARN, CheckLevel.FAIL
SKIPPED, UNKNOWN, STALE = CheckLevel.SKIPPED, CheckLevel.UNKNOWN, CheckLevel.STALE


class Check(msgspec.Struct, frozen=True, omit_defaults=True):
    """One result of one check.

    It crosses the mesh as a stage of ``rmpa why``, where ``level`` is called ``verdict``.

    Attributes:
        name: What was looked at: ``multicast``, ``clock``, a stage of a topic's path, a component of
            ``/diagnostics``.
        level: How bad it is.
        text: What was seen, ready to read.
        remedy: What to do, where something is to be done.
        where: Which of several: an interface, a variable, a peer; empty where there is one only.
        evidence: Figures by their name, as ``/diagnostics`` shows them; units stand in the names.
        code: What is wrong, by ``core.codes``: that of the name where none is given; empty where nothing is wrong.
    """

    name: str
    level: CheckLevel = msgspec.field(name="verdict")
    text: str
    remedy: str = ""
    where: str = ""
    evidence: dict[str, str] = {}
    code: str = ""

    def __post_init__(self) -> None:
        """Take the code from the name."""
        if not self.code and self.level in (WARN, FAIL) and (code := codes.CHECKS.get(self.name)):
            msgspec.structs.force_setattr(self, "code", code)

    @property
    def line(self) -> str:
        """The text with its code."""
        return f"{self.text} [{self.code}]" if self.code else self.text

    @classmethod
    def from_message(cls, name: str, level: CheckLevel, message: str, remedy: str = "", where: str = "") -> Self:
        """Split a message as ``message`` joins it: text after the first "; " replaces the given remedy."""
        text, _, told = message.partition("; ")
        return cls(name, level, text, told or remedy, where)

    @property
    def message(self) -> str:
        """Text and remedy in one line."""
        return f"{self.text}; {self.remedy}" if self.remedy else self.text


def exit_code(checks: Iterable[Check]) -> int:
    """The exit code of a command: 1 if something fails, else 0; warnings do not count."""
    return int(any(check.level is FAIL for check in checks))
