"""Rules that select a context by fields of topics and by the resource's parameters.

::

    rule       = conjunction { "or" conjunction }
    conjunction= negation { "and" negation }
    negation   = "not" negation | "(" rule ")" | value [ ("==" | "!=" | "<" | "<=" | ">" | ">=") value ]
    value      = number | 'text' | "text" | true | false | ~parameter | /topic | /topic/field | /topic.field.field

Example: ``/battery/charging == true and ~gain > 3``. In ``/battery/charging`` the longest part that is a published
topic is the topic, as for rostopic; ``/battery.charging`` is explicit. A topic alone means the message's only field
(``std_msgs/Bool``). A value that is unknown (no message yet, no publisher) makes a comparison neither true nor false.
A rule holds only if it is true whatever the unknown values are (Kleene's logic).

Pure: a rule is parsed once, into a function of the values; nothing is evaluated as Python.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.resource import limits

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

Scalar = bool | int | float | str
"""A value that rules can compare."""
_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.]))"
    r"|(?P<text>'[^']*'|\"[^\"]*\")"
    r"|(?P<topic>/[A-Za-z]\w*(?:/\w+)*(?:\.\w+)*)"
    r"|(?P<parameter>~[A-Za-z]\w*)"
    r"|(?P<word>[A-Za-z_]\w*)"
    r"|(?P<sign>==|!=|<=|>=|<|>|\(|\)))"
)
_SIGNS: Final[Mapping[str, Callable[[Any, Any], bool]]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_KEYWORDS: Final = ("and", "or", "not", "true", "false")
_EXAMPLE: Final = "for example /battery/charging == true and ~gain > 3"


@dataclass(frozen=True, slots=True)
class Reference:
    """A variable of a rule: ``/topic.field`` or ``~parameter``, as written in the rule."""

    text: str

    @property
    def parameter(self) -> str:
        """The parameter's name; empty for a topic's field."""
        return self.text[1:] if self.text.startswith("~") else ""

    def candidates(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Possible splits into a topic and its fields, longest topic first; no field: the message's only one."""
        topic, dot, fields = self.text.partition(".")
        if dot:
            yield topic, tuple(fields.split("."))
            return
        parts = topic.strip("/").split("/")
        for count in range(len(parts), 0, -1):
            yield "/" + "/".join(parts[:count]), tuple(parts[count:])


_Values = Mapping[str, Scalar]
_Holds = Callable[[_Values], bool | None]
"""Whether a part of a rule is true; ``None`` if that depends on unknown values."""
_Value = Callable[[_Values], Scalar | None]


@dataclass(frozen=True, slots=True)
class ContextRule:
    """A parsed rule; ``references`` has each variable of the rule once."""

    text: str
    holds: _Holds
    """Whether the rule is true by the known values, which are by reference, as written in the rule."""
    references: tuple[Reference, ...]


def parse_rule(text: str, parameters: Collection[str], where: str = "rule") -> ContextRule:
    """Parse a rule.

    Args:
        text: A ``rule`` of the module's grammar.
        parameters: Names of the resource's parameters.
        where: Description of the rule, for errors.

    Raises:
        ConfigError: The rule has a syntax error or an unknown parameter, or is too long or nested too deeply.
    """
    if len(text) > limits.CONTEXT_RULE_MAX:
        raise ConfigError(where, f"{len(text)} characters", f"at most {limits.CONTEXT_RULE_MAX}")
    parser = _Parser(text, where)
    holds = parser.rule(0)
    parser.end()
    references = tuple(dict.fromkeys(parser.references))
    for reference in references:
        name = reference.parameter
        if name and name not in parameters:
            near = did_you_mean(name, parameters)
            remedy = f"did you mean ~{near}?" if near else "declare it before the context"
            raise ConfigError(where, f"there is no parameter {name}", remedy)
    return ContextRule(text, holds, references)


class _Parser:
    """A recursive-descent parser of one rule."""

    def __init__(self, text: str, where: str) -> None:
        self._text = text
        self._where = where
        self._at = 0
        self._kind = ""
        self._lexeme = ""
        self.references: list[Reference] = []
        self._next()

    def rule(self, depth: int) -> _Holds:
        return self._chain("or", lambda: self._chain("and", lambda: self._negation(depth)))

    def end(self) -> None:
        if self._kind:
            raise self._error(f"{self._lexeme!r} stands where the rule must end, or go on with and/or")

    def _chain(self, word: str, part: Callable[[], _Holds]) -> _Holds:
        parts = [part()]
        while self._lexeme == word:
            self._next()
            parts.append(part())
        decisive = word == "or"  # one true decides an "or", one false an "and"

        def holds(values: _Values) -> bool | None:
            found = [each(values) for each in parts]
            if decisive in found:
                return decisive
            return None if None in found else not decisive

        return parts[0] if len(parts) == 1 else holds

    def _negation(self, depth: int) -> _Holds:
        if depth > limits.CONTEXT_RULE_DEPTH:
            raise self._error(f"deeper than {limits.CONTEXT_RULE_DEPTH} brackets")
        if self._lexeme == "not":
            self._next()
            inner = self._negation(depth + 1)
            return lambda values: None if (found := inner(values)) is None else not found
        if self._lexeme == "(":
            self._next()
            inner = self.rule(depth + 1)
            if self._lexeme != ")":
                raise self._error("a bracket is not closed")
            self._next()
            return inner
        left, right, compare = self._value(), _constant(True), operator.eq
        if self._lexeme in _SIGNS:
            compare = _SIGNS[self._lexeme]
            self._next()
            right = self._value()
        return lambda values: _compare(compare, left(values), right(values))

    def _value(self) -> _Value:
        kind, piece = self._kind, self._lexeme
        if kind == "word" and piece not in ("true", "false"):
            near = did_you_mean(piece, _KEYWORDS) if piece not in _KEYWORDS else None
            raise self._error(f"{piece!r} is no value", f"did you mean {near}?" if near else "texts have quotes")
        if not kind or kind == "sign":
            raise self._error(f"a value is missing in front of {piece!r}" if piece else "a value is missing")
        self._next()
        if kind == "word":
            return _constant(piece == "true")
        if kind == "text":
            return _constant(piece[1:-1])
        if kind == "number":
            return _constant(float(piece))
        self.references.append(Reference(piece))
        return lambda values: values.get(piece)

    def _next(self) -> None:
        if not self._text[self._at :].strip():
            self._kind = self._lexeme = ""
            return
        match = _TOKEN.match(self._text, self._at)
        if match is None:
            raise self._error(f"{self._text[self._at :].strip()[:20]!r} cannot be read")
        self._at = match.end()
        self._kind = match.lastgroup or ""
        self._lexeme = match[self._kind]

    def _error(self, problem: str, remedy: str = _EXAMPLE) -> ConfigError:
        return ConfigError(self._where, f"{self._text!r}: {problem}", remedy)


def _constant(value: Scalar) -> _Value:
    return lambda _values: value


def _compare(compare: Callable[[Any, Any], bool], left: Scalar | None, right: Scalar | None) -> bool | None:
    """Compare two values; numbers and booleans as Python does, since a ROS ``bool`` may be 0 or 1."""
    if left is None or right is None or left != left or right != right:  # noqa: PLR0124 - NaN
        return None
    if isinstance(left, str) != isinstance(right, str):
        return compare is operator.ne  # a text equals only texts
    if isinstance(left, str) and compare not in (operator.eq, operator.ne):
        return False  # texts have no order
    return compare(left, right)


@dataclass(slots=True)
class ContextSelector:
    """Selects the context: the one chosen by hand, or else the first whose rule holds.

    Args:
        rules: Rules by context, in order of declaration; contexts without a rule are chosen by hand only.
        dwell: Least number of seconds between two changes of context by rules.
    """

    rules: Mapping[str, ContextRule]
    dwell: float = limits.CONTEXT_DWELL
    chosen: str = ""
    """The context chosen by hand; empty: the rules decide."""
    since: float = field(default=-math.inf)
    """When the present context began, monotonic seconds."""

    def select(self, current: str, values: Mapping[str, Scalar], now: float) -> str:
        """Select the context to be in; empty: none.

        Args:
            current: The present context; empty: none.
            values: Known values, as for ``ContextRule.holds``.
            now: Monotonic seconds.
        """
        if self.chosen:
            return self.chosen
        wanted = next((name for name, rule in self.rules.items() if rule.holds(values)), "")
        return wanted if wanted == current or now - self.since >= self.dwell else current
