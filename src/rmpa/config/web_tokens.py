"""The tables ``[[web_token]]`` of ``rmpa.toml``: clients of ``rmpa web`` with a token and a role of their own."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.permission_rules import GROUP_NAME
from rmpa.config.values import (
    NAME,
    TEXT,
    BadValue,
    Place,
    RuleKey,
    ValueType,
    did_you_mean,
    list_of,
    member_of,
    read_keys,
    table_schema,
    tables_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from rmpa.config.permission_rules import ModuleGroup


class WebRole(StrEnum):
    """What a client of ``rmpa web`` may do; a ``[[permission]]`` that denies something holds for every role."""

    VIEWER = "viewer"
    """It looks, and changes nothing."""
    OPERATOR = "operator"
    """It looks, and does what a rule allows its name or its groups."""
    ADMIN = "admin"
    """It does everything that no rule denies."""


@dataclass(frozen=True, slots=True)
class WebToken:
    """One ``[[web_token]]``.

    Args:
        name: The client's, as ``[[permission]]`` and ``[trust.groups]`` name modules.
        role: What it may do.
        groups: Groups of ``[trust.groups]`` that it is in, besides those whose globs fit its name.
        file: The file of its token; empty: ``web-tokens/NAME`` in the module's state directory.
    """

    name: str
    role: WebRole = WebRole.VIEWER
    groups: tuple[str, ...] = ()
    file: str = ""


_KEYS: Final = (
    RuleKey("name", NAME, "The client's name, which [[permission]] means as it means a module's.", required=True),
    RuleKey(
        "role",
        member_of(WebRole, "a role"),
        "viewer: looks; operator: does what a [[permission]] allows it; admin: what none denies.",
    ),
    RuleKey(
        "groups",
        list_of(GROUP_NAME, if_empty="leave groups out, or name some"),
        "Groups of [trust.groups] that it is in, too.",
    ),
    RuleKey(
        "file", TEXT, "The file of its token, made if it is not there; else web-tokens/NAME in the state directory."
    ),
)
_EXAMPLE: Final = 'one has name = "tablet" and role = "operator"'


def _read_token(table: Mapping[str, object]) -> WebToken:
    return WebToken(**read_keys(table, _KEYS, _EXAMPLE))


def _read_tokens(raw: object) -> tuple[WebToken, ...]:
    if isinstance(raw, list | tuple) and len(raw) > limits.WEB_TOKENS_MAX:
        raise BadValue(f"{len(raw)} tokens", f"at most {limits.WEB_TOKENS_MAX}; clients of one role may share one")
    return _TABLES.read(raw)


_TABLES: Final = tables_of(_KEYS, _read_token)
WEB_TOKENS: Final = ValueType(_read_tokens, {"type": "array", "items": table_schema(_KEYS)})


def web_token_problems(tokens: Sequence[WebToken], groups: Sequence[ModuleGroup]) -> Iterator[tuple[Place, str, str]]:
    """Problems that only show when all settings are known: ``(place in [[web_token]], problem, remedy)``."""
    known = [group.name for group in groups]
    for index, token in enumerate(tokens):
        if token.name in [other.name for other in tokens[:index]]:
            yield (index, "name"), f"there are two tokens of {token.name}", "give each client a name of its own"
        for place, name in enumerate(token.groups):
            if name not in known:
                near = did_you_mean(name, known)
                remedy = f"did you mean {near}?" if near else "make it in [trust.groups]"
                yield (index, "groups", place), f"there is no group {name!r}", remedy
