"""The peers in the snapshot, and the modules that knock: what is heard, the links, and what is judged of both."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.discovery import limits as discovery_limits
from rmpa.observe.snapshot import PeerInfo
from rmpa.runtime.loop import yield_to_data, yielding_to_data
from rmpa.trust.permissions import TrustReason, not_of_this_mesh

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from rmpa.bridge.facts import BridgeFacts
    from rmpa.bridge.sessions import PeerSession
    from rmpa.core.identity import Identity
    from rmpa.core.timers import Yielder
    from rmpa.discovery.beacon import Stranger
    from rmpa.discovery.discovery import Discovery
    from rmpa.discovery.endpoints import PeerView
    from rmpa.mesh.io.link import PeerLink
    from rmpa.mesh.io.mesh import Mesh
    from rmpa.mesh.peering import Peer
    from rmpa.trust.permissions import TrustStatus

# The state of a module that is heard, or refuses this one, because it is not of this mesh.
FOREIGN: Final = "foreign"
# The state of a module that an invitation would let in: it has no keys and this mesh is secured, or the other way.
PENDING: Final = "pending"
# The state of a module that was revoked and knocks again; of all others where it is this one.
REVOKED: Final = "revoked"
# Seconds after the end of a peer's link in which its beacon may still be one from before.
ADDRESS_SHARED_MARGIN: Final = 1.0


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


class Peers:
    """The peers' piece of the snapshot, of what discovery, mesh and bridge know of each.

    Args:
        name: This module's.
        endpoint: As of ``AgentParts``.
        facts: What the bridge tells.
        restart: As of ``AgentParts``.
    """

    def __init__(
        self,
        name: str,
        endpoint: Callable[[], tuple[Identity, Mesh, Discovery] | None],
        facts: BridgeFacts,
        restart: Callable[[], str],
    ) -> None:
        self._name = name
        self._endpoint = endpoint
        self._facts = facts
        self._restart = restart

    def infos(self, trust: TrustStatus | None) -> tuple[tuple[PeerInfo, ...], tuple[PeerInfo, ...]]:
        """Every peer that is known, and the modules that are not of this mesh; both by name."""
        if (endpoint := self._endpoint()) is None:
            return (), ()
        (identity, mesh, discovery), now = endpoint, time.monotonic()
        links = {session.link.guid: session for session in self._facts.bridge.sessions.linked()}
        roster = {view.run.identity.guid: view for view in discovery.membership.endpoints.views(yielding_to_data)}
        yield_to_data()
        statuses = {status.identity.guid: status for status in mesh.peering.peers()}
        known_guids = {*roster, *statuses, *links}
        infos = [
            self._peer(roster.get(guid), statuses.get(guid), links.get(guid), now)
            for guid in yielding_to_data(known_guids)
        ]
        known, relayed = {info.instance: info for info in infos}, {}
        for origin, via, topics in self._facts.relayed():  # the membership may know of these modules too
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
            others={self._name, *(each.name for each in relayed.values())},
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
            state, last_error, invite = judge_refusal(status.foreign, self._name, self._restart())
        elif run is not None and view is not None and not view.present:
            state, since = "conflict", run.since
        elif status is not None and status.refused is not None and status.state == "refused":
            state = REVOKED if status.refused.code == TrustReason.REVOKED else "refused"
        crossing = self._facts.peer(session) if session is not None else {}
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
        if one.heard > since.get(one.identity.name.casefold(), 0.0):
            info = _stranger(one, now, trust, since.keys())
            if info is not None:
                yield info


def _stranger(one: Stranger, now: float, trust: TrustStatus | None, members: Collection[str]) -> PeerInfo | None:
    identity = one.identity
    shown = judge_stranger(identity.name, one.reason, one.problem, trust=trust, members=members)
    if shown is None:
        return None
    state, text, invite = shown
    guid = str(identity.guid)
    return PeerInfo(
        name=identity.name if identity.name.casefold() not in members else guid.partition("#")[0],
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
