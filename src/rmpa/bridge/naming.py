"""Translates names between a peer's graph and the local one: pure functions of the ``[[peer]]`` rules.

*Wire* names are those that cross: topics and services as the module has them that publishes or provides them. ::

    their graph   wire            our graph
    /odom  ─────► /odom  ──in───► /robot1/odom      prefix = "/robot1"
    /cmd_vel ◄─── /cmd_vel ◄─out─ /robot1/cmd_vel

The first rule that fits renames a name, once; the result is not renamed again. Only a relay offers the proxies of
other modules, and never to the module that they came from, so no rule can make a message loop.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.peer_rules import PEER
from rmpa.config.rules import CLOCK
from rmpa.core.identity import matches

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.config.settings import PeerRule


class PeerNames:
    """The names of one peer.

    Args:
        peer: The peer's name.
        rules: All ``[[peer]]`` tables, in the order of the file; those for other peers are ignored.
    """

    def __init__(self, peer: str, rules: Iterable[PeerRule] = ()) -> None:
        mine = [rule for rule in rules if matches(rule.name, peer)]
        prefix = next((rule.prefix for rule in mine if rule.prefix), "").replace(PEER, peer)
        self._in = [_filled(each, peer) for rule in mine for each in rule.remap_in]
        self._out = [_filled(each, peer) for rule in mine for each in rule.remap_out]
        self.prefix: Final = prefix
        """The prefix of the peer's names in the local graph, such as ``/robot1``, or empty."""

    @property
    def plain(self) -> bool:
        """Whether no rule renames anything of this peer."""
        return not (self.prefix or self._in or self._out)

    def local_name(self, wire: str) -> str:
        """The local name of a peer's topic or service."""
        if wire == CLOCK:
            return wire  # nodes read the time from no other topic
        for source, target in self._in:
            if (new := _renamed(wire, source, target)) is not None:
                return new
        return self.prefix + wire

    def wire_name(self, local: str) -> str:
        """The wire name, for this peer, of a local topic or service."""
        if local == CLOCK:
            return local
        for source, target in self._out:
            if (new := _renamed(local, source, target)) is not None:
                return new
        if self.prefix and local.startswith(self.prefix + "/"):
            return local[len(self.prefix) :]
        return local

    def wires_of(self, local: str) -> tuple[str, ...]:
        """The wire names that become this local name, best first."""
        names = [old for source, target in self._in if (old := _undone(local, source, target)) is not None]
        names.append(local if not self.prefix else local.removeprefix(self.prefix))
        return tuple(n for n in dict.fromkeys(names) if n and self.local_name(n) == local)

    def locals_of(self, wire: str) -> tuple[str, ...]:
        """The local names that become this wire name, best first."""
        names = [old for source, target in self._out if (old := _undone(wire, source, target)) is not None]
        names += [self.prefix + wire, wire]
        return tuple(n for n in dict.fromkeys(names) if self.wire_name(n) == wire)


class Names:
    """The names of all peers; one immutable set of rules for all parts, replaced when the rules change.

    Args:
        rules: All ``[[peer]]`` tables, in the order of the file.
    """

    def __init__(self, rules: tuple[PeerRule, ...] = ()) -> None:
        self._rules = rules
        self._known: dict[str, PeerNames] = {}

    def of(self, peer: str) -> PeerNames:
        """The names of one peer, by the peer's name."""
        known = self._known.get(peer)
        if known is None:
            if len(self._known) >= limits.NAMES_REMEMBERED:
                self._known.clear()
            known = self._known[peer] = PeerNames(peer, self._rules)
        return known

    def local_name(self, peer: str, wire: str) -> str:
        """The local name of a peer's topic or service."""
        return self.of(peer).local_name(wire)

    def wire_name(self, peer: str, local: str) -> str:
        """The wire name of a local topic or service for a peer."""
        return self.of(peer).wire_name(local)


def _filled(renaming: tuple[str, str], peer: str) -> tuple[str, str]:
    source, target = renaming
    return source.replace(PEER, peer), target.replace(PEER, peer)


def _undone(name: str, source: str, target: str) -> str | None:
    """The name that a rule turns into ``name``; ``None`` if there is none."""
    if not target.endswith("/**"):
        return source if name == target and not source.endswith("/**") else None
    stem = target[:-3]
    if name != stem and not name.startswith(stem + "/"):
        return None
    return source[:-3] + name[len(stem) :] or None


def _renamed(name: str, source: str, target: str) -> str | None:
    """The name as one rule renames it; ``None`` if the rule does not fit."""
    if not source.endswith("/**"):
        return target if name == source else None
    stem = source[:-3]
    if name != stem and not name.startswith(stem + "/"):
        return None
    return target[:-3] + name[len(stem) :] or None
