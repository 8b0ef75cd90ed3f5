"""Reads what a user declares a resource with: functions, a contract's words, one word of several."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

from rmpa.config.contract_rules import CONTRACT_RULES
from rmpa.config.file import LISTS
from rmpa.config.values import BadValue, did_you_mean
from rmpa.core.contract import Contract
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


def check_takes(function: Callable[..., object], count: int, where: str) -> None:
    """Check that a function can be called with so many arguments.

    Raises:
        ConfigError: It cannot.
    """
    what = "without arguments" if not count else "with the message"
    try:
        inspect.signature(function).bind(*[None] * count)
    except TypeError as error:
        name = getattr(function, "__name__", "its function")
        raise ConfigError(where, f"{name} cannot be called {what}: {error}", "change its arguments") from None
    except ValueError:
        pass  # something that tells nothing of itself


def read_contract(where: str, words: Mapping[str, object]) -> Contract:
    """The contract of an output or input, from the words of a ``[[contract]]``.

    Raises:
        ConfigError: A word that no contract has, or a value that it cannot have.
    """
    known = [key for key in LISTS["contract"] if key not in ("topics", "types")]
    for word in words:
        if word not in known:
            near = did_you_mean(word, known)
            remedy = f"did you mean {near}?" if near else f"known here: {', '.join(known)}"
            raise ConfigError(where, f"a contract has no {word!r}", remedy)
    if not words:
        return Contract()
    try:
        rules = CONTRACT_RULES.read([{"topics": ["/**"], **words}])
    except BadValue as error:
        key = error.at[-1] if error.at else ""
        remedy = error.remedy or (f"did you mean {error.better}?" if error.better else "")
        raise ConfigError(f"{where}, {key}" if key else where, error.problem, remedy) from None
    return Contract(**rules[0].values)  # type: ignore[arg-type] # as Rule.values promises


def read_word(kind: type[Any], word: str, where: str) -> Any:
    """A member of an ``Enum``, from its value.

    Raises:
        ConfigError: It has no such value.
    """
    words = [item.value for item in kind]
    if word not in words:
        near = did_you_mean(word, words)
        remedy = f"did you mean {near}?" if near else f"it is one of {', '.join(words)}"
        raise ConfigError(where, f"{word!r} is not known here", remedy)
    return kind(word)
