"""Asks the permissions of a secured mesh for all parts of the bridge, and reports what they refuse."""

from __future__ import annotations

import logging
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.core.counters import Counters
from rmpa.trust.documents import PermissionDecision, prohibition, refusal

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.config.peer_rules import Access
    from rmpa.config.settings import TrustSettings
    from rmpa.trust.documents import Permissions

_log = logging.getLogger(__name__)

_WITHOUT_TRUST: Final = PermissionDecision(True, "trust is off")
_RELAY: Final = "relay"


@dataclass(frozen=True, slots=True)
class Needs:
    """What a handler of messages from outside asks the permissions; declared where it is registered.

    ``docs/security.md`` lists all of them; a test compares it with the registrations.

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
        kind, whose = (_RELAY, relay) if by_relay else (str(access), module)
        self._counters.add(f"permission.{kind}")
        logged = self._logged[kind, decision.number]
        if whose in logged or len(logged) >= limits.REFUSALS_LOGGED:
            return
        logged.add(whose)
        what = prohibition(access, module, name) + (f" by way of {relay}" if relay else "")
        _log.warning("! %s: %s (logged once, then counted)", what, decision.rule)

    def why_not(self, access: Access, module: str, name: str) -> str:
        """What a peer is told if it may not do something, which is reported here; empty if it may."""
        return "" if self.admits(access, module, name) else refusal(access, module, name)


OPEN_GATE: Final = PermissionGate()
"""Trust is off."""
