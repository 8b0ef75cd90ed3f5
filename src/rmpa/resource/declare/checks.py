"""Checks the arguments of a declaration: functions, keys of a contract, values of an ``Enum``."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

from rmpa.config.read import LISTS
from rmpa.config.rules import CONTRACT_RULES
from rmpa.config.values import BadValue, did_you_mean
from rmpa.core.contract import Contract
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


def check_arity(function: Callable[..., object], count: int, where: str) -> None:
    """Check that a function can be called with ``count`` arguments.

    Raises:
        ConfigError: The function cannot be called that way; ``where`` begins the error's text.
    """
    what = "without arguments" if not count else "with the message"
    try:
        inspect.signature(function).bind(*[None] * count)
    except TypeError as error:
        name = getattr(function, "__name__", "its function")
        raise ConfigError(where, f"{name} cannot be called {what}: {error}", "change its arguments") from None
    except ValueError:
        pass  # a callable without a signature, such as some built-in ones


def read_contract(where: str, terms: Mapping[str, object]) -> Contract:
    """Make the contract of an output or input from the keys of a ``[[contract]]`` (docs/contracts.md).

    Raises:
        ConfigError: A key is unknown or a value is invalid; ``where`` begins the error's text.
    """
    known = [key for key in LISTS["contract",] if key not in ("topics", "types")]
    for term in terms:
        if term not in known:
            near = did_you_mean(term, known)
            remedy = f"did you mean {near}?" if near else f"known here: {', '.join(known)}"
            raise ConfigError(where, f"a contract has no {term!r}", remedy)
    if not terms:
        return Contract()
    try:
        rules = CONTRACT_RULES.read([{"topics": ["/**"], **terms}])
    except BadValue as error:
        key = error.at[-1] if error.at else ""
        remedy = error.remedy or (f"did you mean {error.better}?" if error.better else "")
        raise ConfigError(f"{where}, {key}" if key else where, error.problem, remedy) from None
    return Contract(**rules[0].values)  # type: ignore[arg-type] # as ContractRule.values promises


def read_enum(kind: type[Any], text: str, where: str) -> Any:
    """Find the member of an ``Enum`` by its value.

    Raises:
        ConfigError: The ``Enum`` has no such value; ``where`` begins the error's text.
    """
    known = [item.value for item in kind]
    if text not in known:
        near = did_you_mean(text, known)
        remedy = f"did you mean {near}?" if near else f"it is one of {', '.join(known)}"
        raise ConfigError(where, f"{text!r} is not known here", remedy)
    return kind(text)
