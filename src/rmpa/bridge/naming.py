"""How the names of a peer's graph read in ours, and ours in theirs: pure functions of the ``[[peer]]`` rules.

*Wire* names are those that cross: topics and services as the module has them that publishes or provides them. ::

    their graph   wire            our graph
    /odom  ─────► /odom  ──in───► /robot1/odom      prefix = "/robot1"
    /cmd_vel ◄─── /cmd_vel ◄─out─ /robot1/cmd_vel

The first rule that fits renames a name, once; its outcome is not looked at again. What stands here for a node of
another module is not passed on but by a relay, and never back to where it came from: no rule sends a message round.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.param_rules import CLOCK
from rmpa.config.peer_rules import PEER
from rmpa.core.names import matches

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.config.settings import PeerRule, Remap


class PeerNames:
    """The names of one peer.

    Args:
        peer: Its name.
        rules: All ``[[peer]]``, in the order of the file; those for other peers are passed over.
    """

    def __init__(self, peer: str, rules: Iterable[PeerRule] = ()) -> None:
        mine = [rule for rule in rules if matches(rule.name, peer)]
        prefix = next((rule.prefix for rule in mine if rule.prefix), "").replace(PEER, peer)
        self._in = [(remap, *_ends(remap, peer)) for rule in mine for remap in rule.remap_in]
        self._out = [(remap, *_ends(remap, peer)) for rule in mine for remap in rule.remap_out]
        self.prefix: Final = prefix
        """What is put in front of the peer's names here, ``/robot1``, or empty."""

    @property
    def plain(self) -> bool:
        """Whether all names stay as they are."""
        return not (self.prefix or self._in or self._out)

    def local_name(self, wire: str, type_name: str = "") -> str:
        """What a name of theirs is here.

        Args:
            wire: The name as the peer has it, of a topic or a service.
            type_name: A topic's message type; rules with ``types`` fit nothing else.
        """
        return self._incoming(wire, type_name)[0]

    def wire_name(self, local: str, type_name: str = "") -> str:
        """What a name of ours is over there; the other way round, but for names that no rule of that way fits."""
        return self._outgoing(local, type_name)[0]

    def explain_in(self, wire: str, type_name: str = "") -> str:
        """The rule that ``local_name`` goes by, ready to show; empty where the name stays."""
        return self._incoming(wire, type_name)[1]

    def explain_out(self, local: str, type_name: str = "") -> str:
        """The rule that ``wire_name`` goes by."""
        return self._outgoing(local, type_name)[1]

    def wires_of(self, local: str) -> tuple[str, ...]:
        """The names of theirs that are this name here, best first, whatever rules with ``types`` make of them."""
        names = [old for _, source, target in self._in if (old := _undone(local, source, target)) is not None]
        names.append(local if not self.prefix else local.removeprefix(self.prefix))
        typed = any(remap.types for remap, _, _ in self._in)
        return tuple(n for n in dict.fromkeys(names) if n and (typed or self.local_name(n) == local))

    def locals_of(self, wire: str) -> tuple[str, ...]:
        """The names of ours that are this name over there, best first, likewise."""
        names = [old for _, source, target in self._out if (old := _undone(wire, source, target)) is not None]
        names += [self.prefix + wire, wire]
        typed = any(remap.types for remap, _, _ in self._out)
        return tuple(n for n in dict.fromkeys(names) if typed or self.wire_name(n) == wire)

    def _incoming(self, name: str, type_name: str) -> tuple[str, str]:
        if name == CLOCK:
            return name, ""  # nodes look for time nowhere else
        for remap, source, target in self._in:
            if (new := _renamed(name, type_name, remap, source, target)) is not None:
                return new, f'remap_in has "{remap.source}" = "{remap.target}"'
        return (self.prefix + name, f'prefix = "{self.prefix}"') if self.prefix else (name, "")

    def _outgoing(self, name: str, type_name: str) -> tuple[str, str]:
        if name == CLOCK:
            return name, ""
        for remap, source, target in self._out:
            if (new := _renamed(name, type_name, remap, source, target)) is not None:
                return new, f'remap_out has "{remap.source}" = "{remap.target}"'
        if self.prefix and name.startswith(self.prefix + "/"):
            return name[len(self.prefix) :], f'prefix = "{self.prefix}"'
        return name, ""


class Names:
    """The names of every peer; one value for every room that renames, replaced when the rules change.

    Args:
        rules: All ``[[peer]]``, in the order of the file.
    """

    def __init__(self, rules: tuple[PeerRule, ...] = ()) -> None:
        self._rules = rules
        self._known: dict[str, PeerNames] = {}

    def of(self, peer: str) -> PeerNames:
        """Those of the peer of this name."""
        known = self._known.get(peer)
        if known is None:
            if len(self._known) >= limits.NAMES_REMEMBERED:
                self._known.clear()
            known = self._known[peer] = PeerNames(peer, self._rules)
        return known

    def local_name(self, peer: str, wire: str, type_name: str = "") -> str:
        """What a peer's name is here (``PeerNames.local_name``)."""
        return self.of(peer).local_name(wire, type_name)

    def wire_name(self, peer: str, local: str, type_name: str = "") -> str:
        """What a name of ours is at a peer (``PeerNames.wire_name``)."""
        return self.of(peer).wire_name(local, type_name)


def _undone(name: str, source: str, target: str) -> str | None:
    """The name that a rule makes ``name`` of, or ``None`` where it makes no such name."""
    if not target.endswith("/**"):
        return source if name == target and not source.endswith("/**") else None
    stem = target[:-3]
    if name != stem and not name.startswith(stem + "/"):
        return None
    return source[:-3] + name[len(stem) :] or None


def _ends(remap: Remap, peer: str) -> tuple[str, str]:
    return remap.source.replace(PEER, peer), remap.target.replace(PEER, peer)


def _renamed(name: str, type_name: str, remap: Remap, source: str, target: str) -> str | None:
    """A name by one rule, or ``None`` where it does not fit."""
    if remap.types and not any(matches(glob, type_name) for glob in remap.types):
        return None
    if not source.endswith("/**"):
        return target if name == source else None
    stem = source[:-3]
    if name != stem and not name.startswith(stem + "/"):
        return None
    return target[:-3] + name[len(stem) :] or None
