"""Decides what another module may do here, by the rules of ``[[permission]]``, and names the rule that decided.

A rule fits if it is about the module (by a glob over its name, or a group) and one of its globs fits the name. A deny
that fits wins over an allow, whatever the order of the rules; if none fits, ``trust.default`` holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.config.peer_rules import ACTION_CLIENT, ACTION_SERVER, PEER, Access, Effect, PermissionRule
from rmpa.core.identity import matches
from rmpa.trust import limits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.config.settings import TrustSettings

_CLIENT_SENDS: Final = ("goal", "cancel")
"""An action's topics that its client publishes (wiki.ros.org/actionlib/DetailedDescription)."""
_SERVER_SENDS: Final = ("status", "feedback", "result")
"""An action's topics that its server publishes."""
_ACTION_TOPICS: Final = {
    (ACTION_CLIENT, Access.PUBLISH): _CLIENT_SENDS,
    (ACTION_CLIENT, Access.SUBSCRIBE): _SERVER_SENDS,
    (ACTION_SERVER, Access.PUBLISH): _SERVER_SENDS,
    (ACTION_SERVER, Access.SUBSCRIBE): _CLIENT_SENDS,
}
_DONE: Final = {
    Access.PUBLISH: "publish",
    Access.SUBSCRIBE: "subscribe to",
    Access.CALL: "call",
    Access.SERVE: "serve",
    Access.PARAM: "read or set",
    Access.KILL: "end",
}
"""Each access as a verb, for texts."""


@dataclass(frozen=True, slots=True)
class PermissionDecision:
    """Whether a module may do something here, and the rule that decided.

    Args:
        allowed: Whether it may.
        rule: The rule as text: ``[[permission]] 2 denies call of '/motors/**' to '*'``.
        number: The number of the rule in the file, from 1; ``None``: ``trust.default`` decided.
    """

    allowed: bool
    rule: str
    number: int | None = None


@dataclass(frozen=True, slots=True)
class _Pattern:
    """One glob over names, of one rule, for one module."""

    glob: str
    effect: Effect
    number: int
    text: str


class Permissions:
    """The permissions of other modules in this one.

    Args:
        settings: The rules, the groups and the default.
    """

    def __init__(self, settings: TrustSettings) -> None:
        self._known: dict[str, dict[Access, tuple[_Pattern, ...]]] = {}
        self.reload(settings)

    def reload(self, settings: TrustSettings) -> None:
        """Judge by other rules from now on."""
        self._settings = settings
        self._groups = {group.name: group.modules for group in settings.groups}
        self._known.clear()

    @property
    def direct(self) -> bool:
        """Whether nodes may connect to those of other machines directly, in plain text (``trust.direct``)."""
        return self._settings.direct

    def judge(self, access: Access, module: str, name: str) -> PermissionDecision:
        """Decide whether a module may do something.

        Args:
            access: What it would do.
            module: Its name, as its certificate proves it.
            name: The topic, service, parameter or node, by its name here.
        """
        for pattern in self._patterns(module)[access]:
            if matches(pattern.glob, name):
                return PermissionDecision(pattern.effect is Effect.ALLOW, pattern.text, pattern.number)
        if self._settings.default == Effect.ALLOW:
            return PermissionDecision(True, 'no [[permission]] fits, and trust.default = "allow"')
        return PermissionDecision(False, f"no [[permission]] lets {module} {_DONE[access]} {name}")

    def may_relay(self, module: str) -> PermissionDecision:
        """Decide whether a module may pass on what others offer: the origin that it names cannot be proved."""
        for glob in self._settings.relays:
            if matches(glob, module):
                return PermissionDecision(True, f"trust.relays has {glob!r}")
        return PermissionDecision(False, f"trust.relays does not have {module}")

    def groups_of(self, module: str) -> tuple[str, ...]:
        """The groups that a module is in, in the order of the file."""
        return tuple(name for name, globs in self._groups.items() if _first(globs, module) is not None)

    def _patterns(self, module: str) -> dict[Access, tuple[_Pattern, ...]]:
        """The globs of the rules about a module, by access, those that deny first."""
        known = self._known.get(module)
        if known is None:
            if len(self._known) >= limits.MODULES_REMEMBERED:
                self._known.clear()
            found: dict[Access, list[_Pattern]] = {access: [] for access in Access}
            for number, rule in enumerate(self._settings.rules, 1):
                for access, pattern in self._rule_patterns(number, rule, module):
                    found[access].append(pattern)
            # sorted() is stable: among denials, and among allowances, the order of the file stays.
            known = self._known[module] = {
                access: tuple(sorted(patterns, key=lambda p: p.effect is Effect.ALLOW))
                for access, patterns in found.items()
            }
        return known

    def _rule_patterns(self, number: int, rule: PermissionRule, module: str) -> Iterator[tuple[Access, _Pattern]]:
        """The globs of one rule, if it is about a module."""
        whom = self._fit(rule, module)
        if whom is None:
            return
        verb = "allows" if rule.effect is Effect.ALLOW else "denies"
        for key, globs in rule.names.items():
            for written in globs:
                text = f"[[permission]] {number} {verb} {key} of {written!r} to {whom}"
                filled = written.replace(PEER, module)
                if key not in (ACTION_CLIENT, ACTION_SERVER):
                    yield Access(key), _Pattern(filled, rule.effect, number, text)
                    continue
                for access, topic in action_topics(key, filled):
                    yield access, _Pattern(topic, rule.effect, number, text)

    def _fit(self, rule: PermissionRule, module: str) -> str | None:
        """Why a rule is about a module, as text; ``None``: it is not."""
        glob = _first(rule.modules, module)
        if glob is not None:
            return repr(glob)
        for name in rule.groups:
            if _first(self._groups.get(name, ()), module) is not None:
                return f"group {name!r}"
        return None


def refusal(access: Access, module: str, name: str, where: str = "there") -> str:
    """What a refused module is told: that it may not, and nothing of the rules."""
    return f"the permissions {where} do not let {module} {_DONE[access]} {name}"


def prohibition(access: Access, module: str, name: str) -> str:
    """That a module may not do something: ``arm2 may not publish /cmd_vel``."""
    return f"{module} may not {_DONE[access]} {name}"


def action_topics(key: str, name: str) -> Iterator[tuple[Access, str]]:
    """The five topics of an action, each with what the other module does with it.

    Args:
        key: ``ACTION_CLIENT`` if the other module is the client, ``ACTION_SERVER`` if it is the server.
        name: The action's name, or a glob.
    """
    for access in (Access.PUBLISH, Access.SUBSCRIBE):
        for topic in _ACTION_TOPICS[key, access]:
            yield access, f"{name.rstrip('/')}/{topic}"


def _first(globs: tuple[str, ...], name: str) -> str | None:
    """The first glob that fits."""
    return next((glob for glob in globs if matches(glob, name)), None)
