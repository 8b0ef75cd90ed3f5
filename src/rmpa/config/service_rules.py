"""The tables ``[[service]]`` of ``rmpa.toml``: how long calls of some services may take, and their transport."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.config.quantities import TIMEOUT
from rmpa.config.values import SERVICE_GLOB, TRANSPORT, BadValue, RuleKey, list_of, read_keys, tables_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.core.contract import Transport


@dataclass(frozen=True, slots=True)
class ServiceRule:
    """One ``[[service]]``.

    Args:
        names: Globs over the names that services have here.
        timeout: Seconds that a call may take; ``None``: the rule says nothing of it.
        transport: The path of calls; ``None``: the rule says nothing of it.
    """

    names: tuple[str, ...]
    timeout: float | None = None
    transport: Transport | None = None


_KEYS: Final = (
    RuleKey(
        "names",
        list_of(SERVICE_GLOB, if_empty="name some services"),
        "Globs over services, by their names here.",
        required=True,
    ),
    RuleKey("timeout", TIMEOUT, "How long a call may take: seconds, or a text such as 5 min."),
    RuleKey("transport", TRANSPORT, "relay: through the agents; direct, auto: from node to node where it can be."),
)
_EXAMPLE: Final = 'one has names = ["/plan/**"] and timeout = "5 min", or transport = "direct"'


def _read_rule(table: Mapping[str, object]) -> ServiceRule:
    values = read_keys(table, _KEYS, _EXAMPLE)
    if len(values) == 1:
        raise BadValue("a rule without timeout and transport", _EXAMPLE)
    return ServiceRule(**values)


SERVICE_RULES: Final = tables_of(_KEYS, _read_rule)
