"""What other sites may do here, by ``[[permission]]``: the rules of the module that the gateway is.

Zenoh proves which gateway is connected, but not which site or module a message is of: so they are judged as
``PermissionGate.judge_site`` says.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.policy import OPEN_GATE
from rmpa.trust.documents import refusal

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.bridge.policy import PermissionGate
    from rmpa.config.peer_rules import Access
    from rmpa.trust.documents import PermissionDecision


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
        return self._gate.judge_site(access, site, (module,) if module else (), name)

    def admits(self, access: Access, site: str, module: str, name: str) -> bool:
        """Decide as ``judge`` does; a refusal is counted (``permission.publish`` and so on), and logged once."""
        decision = self.judge(access, site, module, name)
        if not decision.allowed:
            self._gate.refused(access, site, name, decision)
        return decision.allowed

    def why_not(
        self, access: Access, site: str, name: str, modules: Iterable[str] = (), told: str | None = None
    ) -> str:
        """What another site is told if it may not do something, which is counted here; empty if it may.

        Args:
            access: What it would do.
            site: The site's name.
            name: The topic, service or parameter, by its name here.
            modules: Those of its modules that ask.
            told: The name that it asked for, if ``name`` was found in it and may be a secret.
        """
        decision = self._gate.judge_site(access, site, modules, name)
        if decision.allowed:
            return ""
        self._gate.refused(access, site, name, decision)
        return refusal(access, site, name if told is None else told)
