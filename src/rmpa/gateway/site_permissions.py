"""What other sites may do here, by ``[[permission]]``: the rules of the module that the gateway is.

Zenoh proves which gateway is connected, but not which site or module a message is of. So a site has the permissions
of a module with the site's name, and a denial of the module that it names holds on top: a rule that allows something
to the module ``arm`` of this site allows nothing to one that is named so elsewhere.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.permission_gate import OPEN_GATE
from rmpa.trust.permissions import refusal

if TYPE_CHECKING:
    from rmpa.bridge.permission_gate import PermissionGate
    from rmpa.config.permission_rules import Access
    from rmpa.trust.permissions import PermissionDecision


class SitePermissions:
    """Decides what sites and their modules may do here.

    Args:
        gate: Judges modules, counts what is refused, and logs it once; without trust it lets everything pass.
    """

    def __init__(self, gate: PermissionGate = OPEN_GATE) -> None:
        self._gate = gate

    def judge(self, access: Access, site: str, module: str, name: str) -> PermissionDecision:
        """Decide whether a module at a site may do something.

        Args:
            access: What it would do.
            site: The site's name.
            module: The module that the message, query or token names; empty where it names none.
            name: The topic, service or parameter, by its name here.
        """
        decision = self._gate.judge(access, site, name)
        if decision.allowed and module:
            own = self._gate.judge(access, module, name)
            if not own.allowed and own.number is not None:
                return own
        return decision

    def admits(self, access: Access, site: str, module: str, name: str) -> bool:
        """Decide as ``judge`` does; a refusal is counted (``permission.publish`` and so on), and logged once."""
        decision = self.judge(access, site, module, name)
        if not decision.allowed:
            self._gate.refused(access, site, name, decision)
        return decision.allowed

    def why_not(self, access: Access, site: str, module: str, name: str) -> str:
        """What another site is told if it may not do something, which is counted here; empty if it may."""
        return "" if self.admits(access, site, module, name) else refusal(access, site, name)
