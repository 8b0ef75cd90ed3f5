"""Builds the snapshot that control socket and ``/diagnostics`` show: gathers what each part tells of itself.

It judges what is shown of peers: of modules that are linked, those that are not, and those that are not of this mesh.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec
import psutil

import rmpa
from rmpa.discovery import limits as discovery_limits
from rmpa.observe.snapshot import FOREIGN, PENDING, REVOKED, AgentInfo, PeerInfo, Snapshot, read_facts
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.loop import yield_to_data, yielding_to_data
from rmpa.trust.permissions import TrustReason, TrustStatus, not_of_this_mesh

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from rmpa.bridge.facts import BridgeFacts
    from rmpa.bridge.sessions import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.core.identity import Identity
    from rmpa.core.statistics import Counters
    from rmpa.core.timers import Yielder
    from rmpa.discovery.beacon import Stranger
    from rmpa.discovery.discovery import Discovery
    from rmpa.discovery.endpoints import PeerView
    from rmpa.mesh.io.link import PeerLink
    from rmpa.mesh.io.mesh import Mesh
    from rmpa.mesh.peering import Peer
    from rmpa.ros.core.external import Core

# Seconds after the end of a peer's link in which its beacon may still be one from before.
ADDRESS_SHARED_MARGIN: Final = 1.0
_RESTART: Final = "sudo systemctl restart rmpa if the service runs it, else end it, then rmpa up"


@dataclass(slots=True, eq=False)
class SnapshotBuilder:
    """Builds snapshots of an agent; changes nothing.

    Args:
        settings: The agent's settings.
        core: The agent's ROS core.
        facts: What its bridge tells.
        endpoint: Its identity, mesh and discovery now; ``None`` while it has no place in the network.
        counters: The counters of parts that are not named here.
        notes: What else the user should know, each ready to read.
        realtime: The outcomes of ``--realtime``, ready to read; those that were refused begin with ``no``.
        trust: The state of trust; ``None``: it is off.
        restart: How to restart the agent, if its module has joined a secured mesh since it started; else empty.
    """

    settings: Settings
    core: Core
    facts: BridgeFacts
    endpoint: Callable[[], tuple[Identity, Mesh, Discovery] | None]
    counters: Counters
    notes: Callable[[], Iterable[str]]
    realtime: tuple[str, ...]
    trust: Callable[[], TrustStatus | None]
    restart: Callable[[], str]
    _process: psutil.Process = field(default_factory=psutil.Process, init=False)
    _cpu: float | None = field(default=None, init=False)
    _cpu_known: float = field(default_factory=time.monotonic, init=False)
    _began: float = field(default_factory=time.monotonic, init=False)
    _started: float = field(default_factory=time.time, init=False)

    def __post_init__(self) -> None:
        self._process.cpu_percent()  # the first call only begins to count

    def reload(self, settings: Settings) -> None:
        """Use other settings from now on."""
        self.settings = settings

    def build(
        self,
        topics: Collection[str] | None = None,
        *,
        services: Collection[str] | bool | None = None,
        peers: bool = True,
        most: int | None = None,
    ) -> Snapshot:
        """A snapshot of this moment. It yields to data between its parts.

        Args:
            topics: The only topics that are wanted, or ``None`` for all.
            services: The only services that are wanted; ``True``: all; ``None``: all if all topics are wanted.
            peers: Whether peers are wanted.
            most: Topics, and services, beyond which those are left out that nothing here uses; ``None``: all are in
                it. The snapshot says how many are left out.
        """
        endpoint, counters = self.endpoint(), Counter[str]()
        several = [self.facts.bridge.counters, self.core.counters, DESCRIPTORS.counters, self.counters]
        notes: list[str] = []
        if endpoint is not None:
            _, mesh, discovery = endpoint
            several += [mesh.counters, discovery.counters]
            notes += [*discovery.notes(), *mesh.notes()]
        for each in several:  # counters of one name add up: core and proxies have the same servers
            counters.update(each.as_dict())
        yield_to_data()
        topics_left = services_left = 0
        if services is None or isinstance(services, bool):
            services = None if services or (services is None and topics is None) else ()
        if most is not None and topics is None:
            topics, topics_left = self.facts.topics.used(most)
        if most is not None and services is None:
            services, services_left = self.facts.services.used(most)
        trust = self.trust()
        known, strangers = self._peer_infos(trust) if peers else ((), ())
        return Snapshot(
            agent=self.agent(),
            taken=time.time(),
            peers=known,
            strangers=strangers,
            lost=self.facts.lost(),
            topics=self.facts.topics.infos(topics),
            services=self.facts.services.infos(services),
            topics_left=topics_left,
            services_left=services_left,
            counters=dict(sorted(counters.items())),
            notes=(*notes, *self._notes()),
            unreachable=self.core.unreachable_infos(),
            died=tuple(self.core.liveness.died),
            trust=trust,
        )

    def _notes(self) -> Iterator[str]:
        yield from self.core.notes()
        if DESCRIPTORS.problem:
            yield DESCRIPTORS.problem
        yield from self.notes()
        yield from self.facts.notes()
        for outcome in self.realtime:
            if outcome.startswith("no "):
                yield f"realtime: {outcome}; the agent's log says what would grant it"

    def agent(self) -> AgentInfo:
        """The agent itself."""
        endpoint = self.endpoint()
        identity, _, discovery = endpoint or (None, None, None)
        now, rss = time.monotonic(), None
        with contextlib.suppress(OSError):  # no file descriptor is left to read /proc
            if now - self._cpu_known >= 1.0:  # the kernel counts in ticks of 10 ms
                self._cpu, self._cpu_known = self._process.cpu_percent(), now
            rss = self._process.memory_info().rss
        return AgentInfo(
            name=self.settings.name,
            guid=str(identity.guid) if identity else "",
            instance=identity.instance.hex() if identity else "",
            domain=self.settings.domain,
            version=rmpa.__version__,
            core_uri=self.core.uri,
            pid=os.getpid(),
            started=self._started,
            uptime=now - self._began,
            cpu=self._cpu,
            rss=rss,
            addresses=tuple(str(a) for a in (identity.guid.address, *identity.addresses)) if identity else (),
            interfaces=tuple(i.name for i in discovery.interfaces) if discovery else (),
            config_file=str(self.settings.config_file.absolute()) if self.settings.config_file else "",
            realtime=self.realtime,
            files=DESCRIPTORS.info(),
            core_memory=self.core.restored(),
            **self.facts.proxies(),
            **read_facts(AgentInfo),
        )

    def _peer_infos(self, trust: TrustStatus | None) -> tuple[tuple[PeerInfo, ...], tuple[PeerInfo, ...]]:
        """Every peer that is known, and the modules that are not of this mesh; both by name."""
        if (endpoint := self.endpoint()) is None:
            return (), ()
        (identity, mesh, discovery), now = endpoint, time.monotonic()
        links = {session.link.guid: session for session in self.facts.bridge.sessions.linked()}
        roster = {view.run.identity.guid: view for view in discovery.membership.endpoints.views(yielding_to_data)}
        yield_to_data()
        statuses = {status.identity.guid: status for status in mesh.peering.peers()}
        known_guids = {*roster, *statuses, *links}
        infos = [
            self._peer(roster.get(guid), statuses.get(guid), links.get(guid), now)
            for guid in yielding_to_data(known_guids)
        ]
        known, relayed = {info.instance: info for info in infos}, {}
        for origin, via, topics in self.facts.relayed():  # the membership may know of these modules too
            blank = PeerInfo(name=origin.name, guid=origin.guid, instance=origin.instance, state="", since_ago=0.0)
            changes = {"state": "relayed", "via": via, "topics_in": topics}
            relayed[origin.instance] = msgspec.structs.replace(known.get(origin.instance, blank), **changes)
        own = {str(address) for address in (identity.guid.address, *identity.addresses)}
        infos = [info for info in infos if info.instance not in relayed] + [*relayed.values()]
        infos.sort(key=lambda info: (info.name, info.guid))
        joined = {session.link.name: session.link.since or now for session in links.values()}
        knocking = judge_strangers(
            (one for one in discovery.strangers() if one.identity.guid not in known_guids),
            now,
            trust,
            joined=joined,
            others={self.settings.name, *(each.name for each in relayed.values())},
        )
        strange = [*(info for info in infos if info.state in (FOREIGN, PENDING)), *knocking]
        strange.sort(key=lambda info: (info.name, info.guid))
        peers = [info for info in infos if info.state not in (FOREIGN, PENDING)]
        return mark_shared_addresses(peers, own, yielding_to_data), tuple(strange)

    def _peer(
        self, view: PeerView | None, status: Peer[PeerLink] | None, session: PeerSession | None, now: float
    ) -> PeerInfo:
        run = view.run if view is not None else None
        identity = (run or status or session.link).identity  # type: ignore[union-attr] # one of the three is there
        since = status.since if status is not None and status.since is not None else run.since if run else now
        next_attempt = status.next_attempt if status is not None else None
        last_error, invite = status.last_error if status is not None else "", ""
        state = "linking"
        if session is not None:
            state, since = "linked", session.link.since or now
        elif status is not None and status.foreign is not None:
            next_attempt = None
            state, last_error, invite = judge_refusal(status.foreign, self.settings.name, self.restart())
        elif run is not None and view is not None and not view.present:
            state, since = "conflict", run.since
        elif status is not None and status.refused is not None and status.state == "refused":
            state = REVOKED if status.refused.code == TrustReason.REVOKED else "refused"
        crossing = self.facts.peer(session) if session is not None else {}
        conflicts = (*(view.conflicts if view is not None else ()), *crossing.pop("conflicts", ()))
        return PeerInfo(
            name=identity.name,
            guid=str(identity.guid),
            instance=identity.instance.hex(),
            state=state,
            since_ago=max(0.0, now - since),
            addresses=_endpoints(identity),
            found_ago=now - run.since if run else None,
            beacon_ago=now - run.heard if run else None,
            source=run.found_by if run else "link",
            last_error=last_error,
            invite=invite,
            next_attempt=max(0.0, next_attempt - now) if next_attempt is not None else None,
            link=session.link.info() if session is not None else None,
            conflicts=conflicts,
            **crossing,
        )


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


def judge_strangers(
    heard: Iterable[Stranger],
    now: float,
    trust: TrustStatus | None,
    *,
    joined: Mapping[str, float],
    others: Collection[str],
) -> Iterator[PeerInfo]:
    """What is shown of the modules that are heard and are not of this mesh.

    Args:
        heard: These modules.
        now: Monotonic seconds.
        trust: The state of trust; ``None``: it is off.
        joined: The names of linked modules, each with the time of its link: it was heard without keys before.
        others: The names of this module and of relayed ones.
    """
    since = dict.fromkeys(map(str.casefold, others), 0.0) | {name.casefold(): at for name, at in joined.items()}
    for one in heard:
        identity, guid = one.identity, str(one.identity.guid)
        folded = identity.name.casefold()
        if one.heard <= since.get(folded, 0.0):
            continue
        shown = judge_stranger(identity.name, one.reason, one.problem, trust=trust, members=since.keys())
        if shown is not None:
            state, text, invite = shown
            yield PeerInfo(
                name=identity.name if folded not in since else guid.partition("#")[0],
                guid=guid,
                instance=identity.instance.hex(),
                state=state,
                since_ago=now - one.since,
                addresses=_endpoints(identity),
                found_ago=now - one.since,
                beacon_ago=now - one.heard,
                last_error=text,
                invite=invite,
            )


# Each agent has a mesh port of its own, so the GUIDs of two machines with one address differ, and the roster takes
# them for two agents of one machine. TCP shows the difference: the beacons of both arrive, because multicast needs no
# reply, but connections to the address reach only one machine, and it refuses the other machine's port.


def mark_shared_addresses(
    peers: Sequence[PeerInfo], own: Collection[str], yielder: Yielder = iter
) -> tuple[PeerInfo, ...]:
    """Set the state ``conflict`` for peers whose address seems to be another machine's too.

    Args:
        peers: All peers.
        own: This machine's addresses.
        yielder: Lets data pass.

    Returns:
        The same peers in the same order.
    """
    holders: dict[str, list[PeerInfo]] = {}
    for peer in yielder(peers):
        holders.setdefault(peer.guid.rpartition(":")[0], []).append(peer)
    texts = ((peer, _shared_address(peer, holders, own)) for peer in yielder(peers))
    return tuple(
        msgspec.structs.replace(peer, state="conflict", conflicts=(*peer.conflicts, text)) if text else peer
        for peer, text in texts
    )


def _shared_address(peer: PeerInfo, holders: Mapping[str, Sequence[PeerInfo]], own: Collection[str]) -> str:
    """Why a peer's beacons arrive though TCP has not reached it for ``limits.ADDRESS_SHARED_AFTER``, or empty."""
    address, _, port = peer.guid.partition("#")[0].rpartition(":")
    others = [f"peer {other.name}" for other in holders[address] if other is not peer]
    others += ["this machine"] if address in own else []
    waits = peer.state == "linking" and peer.since_ago >= discovery_limits.ADDRESS_SHARED_AFTER
    if not others or not waits or peer.beacon_ago is None or address.startswith("127."):
        return ""
    if peer.beacon_ago >= peer.since_ago - ADDRESS_SHARED_MARGIN:
        return ""  # an agent that was killed sends no beacons after its link has fallen
    return (
        f"its address {address} is also that of {' and '.join(others)}, and its port {port} does not answer there: "
        "two machines seem to have one address; give one of them another (was an image copied with its address?), "
        f"or, if both run on one machine, open port {port} in its firewall"
    )


def _endpoints(identity: Identity) -> tuple[str, ...]:
    return tuple(f"{host}:{port}" for host, port in identity.endpoints)
