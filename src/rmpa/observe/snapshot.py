"""The state of an agent as one value, built by ``observe.snapshot_builder`` and read by the command line.

It crosses the control socket as JSON (``msgspec``); ``core.facts`` has the pieces that the rooms below tell.

``ModuleFacts`` is the type of this module's facts and of a peer's, filled by the module's own agent. A peer's are
asked by ``INFO``. A new fact is a field there, with its ``reading`` where it needs nothing of the agent, and a column
where it is shown: ``MODULE_FACTS`` of ``cli/peer.py`` and of ``web/static/pages/module.js``.
"""

from __future__ import annotations

import functools
import os
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec

from rmpa.core import codes
from rmpa.core.facts import (  # noqa: TC001 - msgspec needs them to decode
    BoundInfo,
    FilesInfo,
    LinkInfo,
    ServiceInfo,
    TopicInfo,
    UnreachableInfo,
)
from rmpa.trust.permissions import TrustStatus  # noqa: TC001 - likewise

if TYPE_CHECKING:
    from collections.abc import Callable


# The request to a peer's agent for its ``ModuleFacts``.
INFO: Final = "agent.info"


def reading(how: Callable[[], object]) -> msgspec.Meta:
    """Marks a fact by what gets it at its owner: a function with a name, which returns at once."""
    return msgspec.Meta(extra={"reading": how})


def _host() -> str:
    return os.uname().nodename


@functools.cache
def _system() -> str:
    """Distribution, kernel and processor."""
    from platform import freedesktop_os_release  # noqa: PLC0415 - programs that only read need it not

    try:
        name = freedesktop_os_release()["PRETTY_NAME"] + ", "
    except (OSError, KeyError):
        name = ""
    about = os.uname()
    return f"{name}{about.sysname} {about.release}, {about.machine}"


class ModuleFacts(msgspec.Struct, kw_only=True, frozen=True):
    """A module, as its peers may know it. Later releases may add fields; each is optional.

    Attributes:
        version: Of RMPA; empty where the agent does not say it.
        host: The machine's host name, likewise.
        system: Its distribution, kernel and processor, likewise.
        uptime: Seconds since the agent started.
        core_uri: The ROS core's, as in ROS_MASTER_URI of its own module: ``http://127.0.0.1:11311/``.
        cpu: Share of one core over the last second or longer, in percent.
        rss: Resident memory, bytes.
        files: The file descriptors of the agent's process.
        proxies: The number of proxies of peers' nodes in its graph.
    """

    version: str = ""
    host: Annotated[str, reading(_host)] = ""
    system: Annotated[str, reading(_system)] = ""
    uptime: float = 0.0
    core_uri: str = ""
    cpu: float | None = None
    rss: int | None = None
    files: FilesInfo | None = None
    proxies: int = 0


def read_facts(kind: type[ModuleFacts]) -> dict[str, Any]:
    """The facts that have a ``reading``, by name, as they are now on this machine."""
    return {name: how() for name, how in _readings(kind).items()}


@functools.cache
def _readings(kind: type[ModuleFacts]) -> dict[str, Callable[[], object]]:
    marks = ((field.name, getattr(field.type, "__metadata__", ())) for field in msgspec.structs.fields(kind))
    return {name: mark.extra["reading"] for name, found in marks for mark in found}


class AgentInfo(ModuleFacts, kw_only=True, frozen=True):
    """The agent of this module, with what only users of this machine are shown.

    Attributes:
        name: The module's name.
        guid: ``10.0.0.1:40001#7``.
        instance: The random id of this run, 32 hexadecimal digits.
        domain: Its domain id.
        pid: The agent's process.
        started: Seconds since the epoch.
        addresses: Its numeric IPv4 addresses, best first.
        interfaces: The interfaces that beacons go out on.
        config_file: Where its settings were read, or empty.
        realtime: The outcome of each request of ``--realtime``, ready to read; empty without it.
        proxy_sockets: Listening sockets of all proxies together.
        proxy_listening: How these are used, ready to read: the ports that all share, or why each has its own.
        core_memory: Where the core stores registrations and parameters, and what it took over from its last run,
            ready to read; empty for a core that stores nothing.
    """

    name: str
    guid: str
    instance: str
    domain: int
    pid: int
    started: float
    addresses: tuple[str, ...] = ()
    interfaces: tuple[str, ...] = ()
    config_file: str = ""
    realtime: tuple[str, ...] = ()
    proxy_sockets: int = 0
    proxy_listening: str = ""
    core_memory: str = ""

    def for_peers(self) -> ModuleFacts:
        """The facts that peers may know."""
        return ModuleFacts(**{name: getattr(self, name) for name in ModuleFacts.__struct_fields__})


# The state of a module that is heard, or refuses this one, because it is not of this mesh.
FOREIGN: Final = "foreign"
# The state of a module that an invitation would let in: it has no keys and this mesh is secured, or the other way.
PENDING: Final = "pending"
# The state of a module that was revoked and knocks again; of all others where it is this one.
REVOKED: Final = "revoked"


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
        """Take the code from the state, where something is wrong."""
        wrong = self.last_error or self.conflicts or self.state not in ("linked", "linking", "relayed")
        code = codes.PEER_STATES.get(self.state, "name-conflict" if self.conflicts else "")
        if wrong and code and not self.code:
            msgspec.structs.force_setattr(self, "code", code)


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
        died: The latest nodes that ended without a word and were dropped, each with the time, Unix seconds.
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
    died: tuple[tuple[str, float], ...] = ()
    trust: TrustStatus | None = None
    topics_left: int = 0
    services_left: int = 0
    strangers: tuple[PeerInfo, ...] = ()
    lost: dict[str, str] = {}


class PingReply(msgspec.Struct, kw_only=True, frozen=True):
    """The value of the operation ``ping``.

    Attributes:
        times: Round trips over the mesh in seconds, in order; ``None`` for one that was lost.
        remote: ``address:port`` of the link's other end.
    """

    times: tuple[float | None, ...]
    remote: str = ""
