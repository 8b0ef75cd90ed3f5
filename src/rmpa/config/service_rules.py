"""The tables ``[[service]]`` of ``rmpa.toml``: how long calls of some services may take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.config.quantities import TIMEOUT
from rmpa.config.values import SERVICE_GLOB, RuleKey, list_of, read_keys, tables_of

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class ServiceRule:
    """One ``[[service]]``.

    Args:
        names: Globs over the names that services have here.
        timeout: Seconds that a call may take.
    """

    names: tuple[str, ...]
    timeout: float


_KEYS: Final = (
    RuleKey(
        "names",
        list_of(SERVICE_GLOB, if_empty="name some services"),
        "Globs over services, by their names here.",
        required=True,
    ),
    RuleKey("timeout", TIMEOUT, "How long a call may take: seconds, or a text such as 5 min.", required=True),
)


def _read_rule(table: Mapping[str, object]) -> ServiceRule:
    return ServiceRule(**read_keys(table, _KEYS, 'one has names = ["/plan/**"] and timeout = "5 min"'))


SERVICE_RULES: Final = tables_of(_KEYS, _read_rule)
