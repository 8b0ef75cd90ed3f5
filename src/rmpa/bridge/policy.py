"""What the settings say of peers: which topics and services cross, and how they are called at each end. Pure.

What decides is a table of rules, and the rule that decided is named. The context is frozen; when settings are read
again it is replaced as a whole, and the parts judge again by it.

*Wire* names are those that cross: topics and services as the module has them that publishes or provides them. ::

    their graph   wire            our graph
    /odom  ─────► /odom  ──in───► /robot1/odom      prefix = "/robot1"
    /cmd_vel ◄─── /cmd_vel ◄─out─ /robot1/cmd_vel

The first rule that fits renames a name, once; the result is not renamed again. Only a relay offers the proxies of
other modules, and never to the module that they came from, so no rule can make a message loop.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.bridge import limits
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import Access, PeerRule, PolicySettings, ServiceRule
from rmpa.config.rules import CLOCK
from rmpa.config.settings import ServiceSettings, Settings, TimeSettings, TrustSettings
from rmpa.config.values import PEER
from rmpa.core.identity import NEVER_CROSSING, OUTSIDE_GUID, ROSOUT, is_own, matches, matches_any
from rmpa.core.statistics import Counters
from rmpa.trust.permissions import PermissionDecision, Permissions, prohibition, refusal

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.bridge.messages import Origin, Source
    from rmpa.core.contract import Contracts, Transport


_log = logging.getLogger(__name__)

_NO_TIME: Final = TimeSettings()


@dataclass(frozen=True, slots=True)
class PolicyDecision:
    """Whether a source may cross, and the rule that decided, as text."""

    allowed: bool
    rule: str


class Policy:
    """Judges sources by their topic, type and node.

    Args:
        settings: The user's globs for all peers.
        peers: Additional globs for single peers.
        time: Whether ``/clock`` crosses, and from which peer it is taken.
        rosout: Whether ``/rosout`` crosses.
    """

    def __init__(
        self,
        settings: PolicySettings,
        peers: tuple[PeerRule, ...] = (),
        time: TimeSettings = _NO_TIME,
        *,
        rosout: bool = False,
    ) -> None:
        self._settings = settings
        self._peers = peers
        self._time = time
        self._rosout = rosout
        self._rules_for = lru_cache(config_limits.NAMES_REMEMBERED)(self._filled)

    def judge(self, topic: str, type_name: str, node: str) -> PolicyDecision:
        """Decide about one source by the rules for all peers; a refusal wins over an ``allow``."""
        if is_own(node):
            return PolicyDecision(False, f"{node} stands for a node of another module, or is the agent itself")
        if topic == CLOCK and self._time.share:
            return PolicyDecision(True, "time.share = true: peers may follow this module's time")
        if (why := never_crosses(topic)) and not (self._rosout and topic == ROSOUT):
            return PolicyDecision(False, f"built in: {why}")
        return judge_globs(self._settings, "bridge", topic, type_name)

    def judge_clock(self, peer: str) -> PolicyDecision:
        """Decide whether a peer's ``/clock`` may come here."""
        if not self._time.follow:
            return PolicyDecision(False, f"built in: {NEVER_CROSSING[CLOCK]}; [time] follow names the peer to follow")
        if self._time.follow != peer:
            return PolicyDecision(False, f'time.follow = "{self._time.follow}": time comes from there alone')
        return PolicyDecision(True, f'time.follow = "{peer}"')

    def _filled(self, peer: str) -> tuple[tuple[str, PolicySettings], ...]:
        """The rules for a peer: the place of each in the file, as text, and its globs with the name filled in."""
        return tuple(
            (
                f'peer "{rule.name}"',
                replace(
                    rule.policy,
                    allow=tuple(glob.replace(PEER, peer) for glob in rule.policy.allow),
                    deny=tuple(glob.replace(PEER, peer) for glob in rule.policy.deny),
                ),
            )
            for rule in self._peers
            if matches(rule.name, peer)
        )

    def judge_for(self, peer: str, name: str, type_name: str | None = None, wire: str = "") -> PolicyDecision:
        """Decide whether a source that ``judge`` allows may cross between this module and one peer.

        Args:
            peer: The peer's name.
            name: The local name of the topic or service.
            type_name: A topic's message type; ``None`` for a service, or if the type is unknown.
            wire: The wire name, if it differs.
        """
        if wire and wire != name and (why := never_crosses(wire)):
            return PolicyDecision(False, f"built in: {why} (it is {wire} there)")
        for where, settings in self._rules_for(peer):
            decision = judge_globs(settings, where, name, type_name)
            if not decision.allowed:
                return decision
        return PolicyDecision(True, "")


def never_crosses(topic: str) -> str:
    """The reason why a topic never crosses, or empty."""
    return next((why for pattern, why in NEVER_CROSSING.items() if matches(pattern, topic)), "")


def judge_globs(
    settings: PolicySettings | ServiceSettings, where: str, name: str, type_name: str | None = None
) -> PolicyDecision:
    """Decide by one set of globs.

    Args:
        settings: It.
        where: Its place in the file, as text.
        name: The local name of the topic or service.
        type_name: A topic's message type; ``None`` for a service, or if the type is unknown.
    """
    for pattern in settings.deny:
        if matches(pattern, name):
            return PolicyDecision(False, f"{where}.deny has {pattern!r}")
    if type_name is not None and isinstance(settings, PolicySettings):
        for pattern in settings.deny_types:
            if matches(pattern, type_name):
                return PolicyDecision(False, f"{where}.deny_types has {pattern!r}")
        if not matches_any(settings.allow_types, type_name):
            return PolicyDecision(False, f"no glob of {where}.allow_types fits {type_name}")
    for pattern in settings.allow:
        if matches(pattern, name):
            return PolicyDecision(True, f"{where}.allow has {pattern!r}")
    return PolicyDecision(False, f"no glob of {where}.allow fits {name}")


_WITHOUT_TRUST: Final = PermissionDecision(True, "trust is off")


@dataclass(frozen=True, slots=True)
class Needs:
    """What a handler of messages from outside asks the permissions; declared where it is registered.

    ``docs/reference/security.md`` lists all of them; a test compares it with the registrations.

    Args:
        access: The kinds of access that are judged; none: nothing is.
        of: The names that are judged for them, and what is told of others; or why nothing has to be asked.
        key: The keys of a Zenoh query, which has no other name.
    """

    access: tuple[Access, ...]
    of: str
    key: str = ""


class PermissionGate:
    """Decides what peers may do here, by their names; without trust, everything.

    Args:
        permissions: The permissions of this module; ``None``: trust is off.
        counters: Counts ``permission.publish``, ``permission.subscribe`` and so on, one for each kind of access that
            is refused, and ``permission.relay``.
    """

    def __init__(self, permissions: Permissions | None = None, counters: Counters | None = None) -> None:
        self.permissions = permissions
        self._counters = counters if counters is not None else Counters()
        self._logged: dict[tuple[str, int | None], set[str]] = defaultdict(set)

    @property
    def on(self) -> bool:
        """Whether the mesh is secured, so that permissions hold."""
        return self.permissions is not None

    @property
    def plain(self) -> bool:
        """Whether nodes may have connections between machines that TLS does not protect."""
        return self.permissions is None or self.permissions.direct

    def reload(self, settings: TrustSettings) -> None:
        """Judge by other rules from now on; what they refuse is logged again."""
        if self.permissions is not None:
            self.permissions.reload(settings)
        self._logged.clear()

    def judge(self, access: Access, module: str, name: str, *, relay: str = "") -> PermissionDecision:
        """Decide whether a module may do something here.

        Args:
            access: What it would do.
            module: Its name: that of a peer as its certificate proves it, or the origin that a relay names.
            name: The topic, service, parameter or node, by its name here.
            relay: The peer that passes it on for ``module``, if one does: it has to be in ``trust.relays`` as well.
        """
        if self.permissions is None:
            return _WITHOUT_TRUST
        if relay and not (decision := self.permissions.may_relay(relay)).allowed:
            return decision
        return self.permissions.judge(access, module, name)

    def judge_site(self, access: Access, site: str, modules: Iterable[str], name: str) -> PermissionDecision:
        """Decide whether another site may do something here; nothing proves the names of the site and its modules.

        So a site has the permissions of a module with the site's name, and denials of the modules that it names hold
        on top: what a rule allows to the module ``arm`` of this mesh it does not allow to an ``arm`` elsewhere.

        Args:
            access: What it would do.
            site: The site's name; empty for a program that names none.
            modules: Those of the site that the message, query or token names.
            name: The topic, service or parameter, by its name here.
        """
        decision = self.judge(access, site, name)
        for module in modules if decision.allowed else ():
            own = self.judge(access, module, name)
            if not own.allowed and own.number is not None:
                return own
        return decision

    def judge_all(self, access: Access, askers: str, name: str) -> PermissionDecision | None:
        """The decision that holds for all modules and sites alike, as ``Permissions.judge_all`` says."""
        return _WITHOUT_TRUST if self.permissions is None else self.permissions.judge_all(access, askers, name)

    def may_relay(self, relay: str) -> bool:
        """Whether a peer may pass on what others offer."""
        return self.permissions is None or self.permissions.may_relay(relay).allowed

    def admits(self, access: Access, module: str, name: str, *, relay: str = "") -> bool:
        """Decide as ``judge`` does, and report a refusal."""
        decision = self.judge(access, module, name, relay=relay)
        if not decision.allowed:
            self.refused(access, module, name, decision, relay=relay)
        return decision.allowed

    def refused(
        self, access: Access, module: str, name: str, decision: PermissionDecision, *, relay: str = ""
    ) -> None:
        """Count a refusal; the first one of a module, a kind of access and a rule is logged.

        Names of sites may be invented, so further modules and sites of one rule are only counted.
        """
        by_relay = bool(relay) and not self.may_relay(relay)
        kind, whose = ("relay", relay) if by_relay else (str(access), module)
        self._counters.add(f"permission.{kind}")
        logged = self._logged[kind, decision.number]
        if whose in logged or len(logged) >= limits.REFUSALS_LOGGED:
            return
        logged.add(whose)
        what = prohibition(access, module, name) + (f" by way of {relay}" if relay else "")
        _log.warning("! %s: %s (logged once, then counted) [not-permitted]", what, decision.rule)

    def why_not(self, access: Access, module: str, name: str) -> str:
        """What a peer is told if it may not do something, which is reported here; empty if it may."""
        return "" if self.admits(access, module, name) else refusal(access, module, name)


# Trust is off.
OPEN_GATE: Final = PermissionGate()


# Topics that have one name in all modules.
_FIXED: Final = (CLOCK, ROSOUT)


class PeerNames:
    """The names of one peer.

    Args:
        peer: The peer's name.
        rules: All ``[[peer]]`` tables, in the order of the file; those for other peers are ignored.

    Attributes:
        prefix: The prefix of the peer's names in the local graph, such as ``/robot1``, or empty.
    """

    def __init__(self, peer: str, rules: Iterable[PeerRule] = ()) -> None:
        mine = [rule for rule in rules if matches(rule.name, peer)]
        prefix = next((rule.prefix for rule in mine if rule.prefix), "").replace(PEER, peer)
        self._in = [_filled(each, peer) for rule in mine for each in rule.remap_in]
        self._out = [_filled(each, peer) for rule in mine for each in rule.remap_out]
        self.prefix: Final = prefix

    def local_name(self, wire: str) -> str:
        """The local name of a peer's topic or service."""
        if wire in _FIXED:
            return wire  # nodes read the time, and the core the log, from no other topic
        renamed = (_renamed(wire, source, target) for source, target in self._in)
        return next((new for new in renamed if new is not None), self.prefix + wire)

    def wire_name(self, local: str) -> str:
        """The wire name, for this peer, of a local topic or service."""
        if local in _FIXED:
            return local
        renamed = (_renamed(local, source, target) for source, target in self._out)
        plain = local[len(self.prefix) :] if local.startswith(self.prefix + "/") else local
        return next((new for new in renamed if new is not None), plain)

    def wires_of(self, local: str) -> tuple[str, ...]:
        """The wire names that become this local name, best first."""
        names = [old for source, target in self._in if (old := _renamed(local, target, source)) is not None]
        names.append(local if not self.prefix else local.removeprefix(self.prefix))
        return tuple(n for n in dict.fromkeys(names) if n and self.local_name(n) == local)

    def locals_of(self, wire: str) -> tuple[str, ...]:
        """The local names that become this wire name, best first."""
        names = [old for source, target in self._out if (old := _renamed(wire, target, source)) is not None]
        names += [self.prefix + wire, wire]
        return tuple(n for n in dict.fromkeys(names) if self.wire_name(n) == wire)


class Names:
    """The names of all peers; one immutable set of rules for all parts, replaced when the rules change.

    Args:
        rules: All ``[[peer]]`` tables, in the order of the file.

    Attributes:
        of: ``(peer)``: the names of one peer, by the peer's name.
    """

    def __init__(self, rules: tuple[PeerRule, ...] = ()) -> None:
        self.of = lru_cache(config_limits.NAMES_REMEMBERED)(lambda peer: PeerNames(peer, rules))


def _filled(renaming: tuple[str, str], peer: str) -> tuple[str, str]:
    source, target = renaming
    return source.replace(PEER, peer), target.replace(PEER, peer)


def _renamed(name: str, source: str, target: str) -> str | None:
    """The name as one rule renames it, or with the two exchanged, undoes it; ``None`` if the rule does not fit."""
    if not source.endswith("/**"):
        return target if name == source else None
    stem = source[:-3]
    if name != stem and not name.startswith(stem + "/"):
        return None
    return target[:-3] + name[len(stem) :] or None


OWN_SERVICES: Final = "/rmpa/**"
# Every node has these two services; if they crossed, they would double the graph for no use.
LOGGERS: Final = ("**/get_loggers", "**/set_logger_level")


class ServiceRules:
    """Judges services, and says how they are called; the rules of topics do not apply to them.

    Args:
        settings: ``[services]`` and ``[[service]]``.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings

    def judge(self, service: str, node: str) -> PolicyDecision:
        """Decide whether a service may cross at all.

        The built-in rules go first, then ``services.deny``, then ``services.allow``; what no glob fits may not cross.

        Args:
            service: Its name in the local graph.
            node: The node that provides it.
        """
        settings = self._settings
        if is_own(node):
            return PolicyDecision(False, f"{node} stands for a node of another module, or is the agent itself")
        if matches(OWN_SERVICES, service):
            return PolicyDecision(False, "built in: the agent's own services do not cross")
        if not settings.loggers and matches_any(LOGGERS, service):
            return PolicyDecision(
                False, "built in: a node's log is set at home; services.loggers = true lets it cross"
            )
        return judge_globs(settings, "services", service)

    def timeout(self, service: str) -> float:
        """The time-out of a call of a service, in seconds.

        It is that of the first ``[[service]]`` that fits the service's name and says one, else that of
        ``[services]``.
        """
        said = (rule.timeout for rule in self._fitting(service) if rule.timeout is not None)
        return next(said, self._settings.timeout)

    def has_timeout(self, service: str) -> bool:
        """Whether a service has another time-out than the built-in one.

        Only agents keep time-outs: a call from node to node has none.
        """
        return self.timeout(service) != config_limits.SERVICE_TIMEOUT

    def transport(self, service: str) -> Transport:
        """The path of a service's calls that this module wants.

        It is that of the first ``[[service]]`` that fits the service's name and says one, else that of
        ``[services]``.
        """
        said = (rule.transport for rule in self._fitting(service) if rule.transport is not None)
        return next(said, self._settings.transport)

    def _fitting(self, service: str) -> Iterator[ServiceRule]:
        """The rules ``[[service]]`` that fit a service, in order."""
        return (rule for rule in self._settings.rules if matches_any(rule.names, service))


@dataclass(frozen=True, slots=True)
class BridgeContext:
    """The rules of one reading of the settings; made by ``of``.

    Args:
        settings: The settings that they come from.
        policy: Which topics may cross.
        services: Which services may cross, with their time-outs.
        names: Renames what crosses, for each peer.
        contracts: The contracts of this module's topics.
        gate: What each peer may do here.
    """

    settings: Settings
    policy: Policy
    services: ServiceRules
    names: Names
    contracts: Contracts
    gate: PermissionGate

    @classmethod
    def of(cls, settings: Settings | None = None, gate: PermissionGate = OPEN_GATE) -> BridgeContext:
        """The rules of these settings; without any, those of a module that sets nothing."""
        settings = settings if settings is not None else Settings()
        policy = Policy(settings.policy, settings.peers, settings.time, rosout=settings.rosout)
        names, services = Names(settings.naming), ServiceRules(settings.services)
        return cls(settings, policy, services, names, settings.make_contracts(), gate)

    def limit(self, kind: str) -> int:
        """The most ``topics`` or ``services`` of a module that cross."""
        return self.settings.limits.topics if kind == "topics" else self.settings.limits.services


# A topic and the proxy that publishes it, by their local names.
Place = tuple[str, str]


def is_outside(origin: Origin) -> bool:
    """Whether an origin is not a module of this mesh, but what a gateway of it reaches."""
    return origin.guid == OUTSIDE_GUID


def service_place(service: str, node: str) -> Place:
    """The place of a service, which differs from that of a topic of the same name."""
    return f"service {service}", node


class Relay:
    """The relaying side: which proxies of the local graph are offered to other peers, with which origin.

    A module that is in two networks may pass on what one offers to the other, as the paper's proxies do::

        network 0                                      network 1
        a ──── /cmd ───► r (relay) ──── /cmd, origin a, path r ───► b     shown there as /rmpa/a/…

    The origin lists every relay on the path, which prevents loops: a source is not offered to its own module nor to a
    relay on its path, and a relay on its path does not show it. A module that is linked to the origin, or reaches it
    by a better relay, hides the source.

    Args:
        enabled: Whether this module relays at all.

    Attributes:
        instance: Our own, as 32 hexadecimal digits.
    """

    def __init__(self, *, enabled: bool = False) -> None:
        self.enabled = enabled
        self.instance = ""
        self._origins: dict[Place, tuple[int, Source, Origin]] = {}
        self._places: dict[tuple[int, Source], Place] = {}

    def shown(self, peer: int, source: Source, place: Place, origin: Origin) -> None:
        """Register a peer's source that is about to appear in the local graph.

        Args:
            peer: The number of the peer that offers it.
            source: The source, by its wire name.
            place: Its topic and proxy here.
            origin: Its module and node; the path does not include this module.
        """
        self._places[peer, source] = place
        self._origins[place] = (peer, source, origin)

    def gone(self, peer: int, source: Source) -> None:
        """Forget a source that leaves the local graph; another peer's source may have its place already."""
        place = self._places.pop((peer, source), None)
        if place is not None and self._origins[place][:2] == (peer, source):
            del self._origins[place]

    def peer_gone(self, peer: int) -> None:
        """Forget all sources that a peer offered."""
        for owner, source in [key for key in self._places if key[0] == peer]:
            self.gone(owner, source)

    def source(self, place: Place) -> tuple[int, Source] | None:
        """The peer that offers what is at a place, and its source, by the wire name; ``None`` if it is no proxy's."""
        shown = self._origins.get(place)
        return shown[:2] if shown is not None else None

    def origin(self, place: Place) -> Origin | None:
        """The origin to offer a proxy's topic with, this relay in its path; ``None`` if it is not relayed."""
        if not self.enabled or place not in self._origins:
            return None
        origin = self._origins[place][2]
        if len(origin.path) >= limits.RELAY_HOPS_MAX:
            return None
        return msgspec.structs.replace(origin, path=(*origin.path, self.instance))


class Local:
    """What a node of this module, or a proxy that is relayed, has in the local graph; for subclasses.

    Attributes:
        type: Its message type; ``None`` for a service.
        origin: Its module and node, if it is relayed.
    """

    __slots__ = ()

    type: str | None
    origin: Origin | None


def may_have(instance: str, origin: Origin) -> bool:
    """Whether a relayed source may be offered to the peer of this instance: not to one that it came from."""
    return instance != origin.instance and instance not in origin.path
