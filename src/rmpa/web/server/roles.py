"""What the clients of ``rmpa web`` may do, by their tokens: roles, and the rules of ``[[permission]]``."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from rmpa.config.permission_rules import Effect, ModuleGroup
from rmpa.config.web_tokens import WebRole
from rmpa.trust.permissions import Permissions
from rmpa.web.hub.rights import FULL, READ_ONLY, ClientRules, Rights

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.config.settings import Settings, TrustSettings
    from rmpa.config.web_tokens import WebToken

OWN_CLIENT_NAME: Final = "web"
"""The name, for the rules, of clients with the server's own token and of those without one."""
_LOOKS: Final = Rights(read_parameters=True, fetch_assets=True)


class WebRoles:
    """Gives each client its rights.

    Args:
        settings: ``[web]``, ``[[web_token]]``, ``[[permission]]`` and ``[trust]``.
        has_token: Whether the server asks for a token: without one parameters and files are not read either.
        trusted: Whether this module is in a secured mesh: then rules hold for the server's own token too.
    """

    def __init__(self, settings: Settings, *, has_token: bool, trusted: bool) -> None:
        web = settings.web
        strict = _with_groups(settings.trust, settings.web_tokens)
        lax = replace(strict, default=Effect.ALLOW.value)
        self._strict, self._lax = Permissions(strict), Permissions(lax)
        self._command_age = web.command_age_ms / 1000
        own = self._own(control=web.control, drive=web.drive) if has_token else READ_ONLY
        rules = ClientRules(OWN_CLIENT_NAME, self._lax)
        self._rights = {"": replace(own, look=rules, change=rules) if trusted else own}
        self._rights |= {token.name: self._of(token) for token in settings.web_tokens}

    def of(self, client: str) -> Rights:
        """The rights of a client.

        Args:
            client: The name of its token (``AccessGranted.client``); empty: the server's own, or none.
        """
        return self._rights.get(client, READ_ONLY)

    def _own(self, *, control: bool, drive: bool) -> Rights:
        return replace(FULL if control else _LOOKS, drive=drive, command_age=self._command_age)

    def _of(self, token: WebToken) -> Rights:
        look = ClientRules(token.name, self._lax)
        if token.role is WebRole.VIEWER:
            return replace(_LOOKS, look=look)
        change = look if token.role is WebRole.ADMIN else ClientRules(token.name, self._strict)
        return replace(FULL, drive=True, look=look, change=change, command_age=self._command_age)


def _with_groups(trust: TrustSettings, tokens: Sequence[WebToken]) -> TrustSettings:
    """The settings with the clients as members of the groups that their tokens name."""
    groups = (
        ModuleGroup(group.name, (*group.modules, *(token.name for token in tokens if group.name in token.groups)))
        for group in trust.groups
    )
    return replace(trust, groups=tuple(groups))
