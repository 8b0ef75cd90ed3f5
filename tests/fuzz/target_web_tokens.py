"""Fuzz target: ``[[web_token]]``."""

from __future__ import annotations

from pathlib import Path

from rmpa.config.file import parse_config
from rmpa.config.permission_rules import Access
from rmpa.config.settings import Settings
from rmpa.config.values import BadValue
from rmpa.config.web_tokens import WEB_TOKENS, WebRole, web_token_problems
from rmpa.core.errors import ConfigError, PeerRefused
from rmpa.web.server.roles import WebRoles

SEEDS: list[bytes] = [
    b"",
    b"[[web_token]]\nname = 'wall'\n",
    b"[[web_token]]\nname = 'tablet'\nrole = 'operator'\ngroups = ['ops', 'all']\nfile = '/etc/x'\n",
    b"[[web_token]]\nname = 'a'\nrole = 'admin'\n[[web_token]]\nname = 'a'\nrole = 'viewer'\n",
    b"web_token = [{name = 'b', role = 'Operator', groups = 'x;y'}]\n",
]


def fuzz(data: bytes) -> None:
    """Tokens of which no viewer and no operator without a rule changes anything; or an error that says where."""
    try:
        tokens = WEB_TOKENS.read(parse_config(data, Path("rmpa.toml")).get(("web_token",), []))
    except ConfigError as error:
        str(error)
        return
    except BadValue as error:
        if not error.at:
            raise AssertionError(f"a wrong token, but nothing says which: {error}") from error
        return
    problems = list(web_token_problems(tokens, ()))
    roles = WebRoles(Settings(web_tokens=tokens), has_token=True, trusted=True)
    for token in tokens:
        rights = roles.of(token.name)
        if token.role is WebRole.VIEWER and rights.publish and not problems:
            raise AssertionError(f"{token} may publish")
        if token.role is WebRole.OPERATOR and not problems:
            try:
                rights.check_change(Access.PUBLISH, "/cmd_vel")
            except PeerRefused:
                continue
            raise AssertionError(f"{token} may publish without a rule")
