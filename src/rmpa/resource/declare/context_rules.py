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

Pure: a rule is parsed into a tree once, and the tree is evaluated with the values; nothing is evaluated as Python.
"""

from __future__ import annotations

import math
import operator
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.resource import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping

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
_ORDERS: Final[Mapping[str, Callable[[float, float], bool]]] = {
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


@dataclass(frozen=True, slots=True)
class _Constant:
    value: Scalar


@dataclass(frozen=True, slots=True)
class _Compare:
    sign: str
    left: Reference | _Constant
    right: Reference | _Constant


@dataclass(frozen=True, slots=True)
class _Not:
    inner: _Node


@dataclass(frozen=True, slots=True)
class _BooleanOperation:
    """``and`` of all parts if ``conjunction`` is true, else ``or``."""

    conjunction: bool
    parts: tuple[_Node, ...]


_Node = _Compare | _Not | _BooleanOperation


@dataclass(frozen=True, slots=True)
class ContextRule:
    """A parsed rule; ``references`` has each variable of the rule once."""

    text: str
    root: _Node
    references: tuple[Reference, ...]

    def holds(self, values: Mapping[str, Scalar]) -> bool | None:
        """Whether the rule is true; ``None`` if that depends on unknown values.

        Args:
            values: The known values by reference, as written in the rule.
        """
        return _holds(self.root, values)


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
    root = parser.rule(0)
    parser.end()
    references = tuple(dict.fromkeys(parser.references))
    for reference in references:
        name = reference.parameter
        if name and name not in parameters:
            near = did_you_mean(name, parameters)
            remedy = f"did you mean ~{near}?" if near else "declare it before the context"
            raise ConfigError(where, f"there is no parameter {name}", remedy)
    return ContextRule(text, root, references)


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

    def rule(self, depth: int) -> _Node:
        return self._chain("or", lambda: self._chain("and", lambda: self._negation(depth)))

    def end(self) -> None:
        if self._kind:
            raise self._error(f"{self._lexeme!r} stands where the rule must end, or go on with and/or")

    def _chain(self, word: str, part: Callable[[], _Node]) -> _Node:
        parts = [part()]
        while self._lexeme == word:
            self._next()
            parts.append(part())
        return parts[0] if len(parts) == 1 else _BooleanOperation(word == "and", tuple(parts))

    def _negation(self, depth: int) -> _Node:
        if depth > limits.CONTEXT_RULE_DEPTH:
            raise self._error(f"deeper than {limits.CONTEXT_RULE_DEPTH} brackets")
        if self._lexeme == "not":
            self._next()
            return _Not(self._negation(depth + 1))
        if self._lexeme == "(":
            self._next()
            inner = self.rule(depth + 1)
            if self._lexeme != ")":
                raise self._error("a bracket is not closed")
            self._next()
            return inner
        left = self._value()
        if self._lexeme in ("==", "!=", *_ORDERS):
            sign = self._lexeme
            self._next()
            return _Compare(sign, left, self._value())
        return _Compare("==", left, _Constant(True))

    def _value(self) -> Reference | _Constant:
        kind, piece = self._kind, self._lexeme
        if kind == "word" and piece not in ("true", "false"):
            near = did_you_mean(piece, _KEYWORDS) if piece not in _KEYWORDS else None
            raise self._error(f"{piece!r} is no value", f"did you mean {near}?" if near else "texts have quotes")
        if not kind or kind == "sign":
            raise self._error(f"a value is missing in front of {piece!r}" if piece else "a value is missing")
        self._next()
        if kind == "word":
            return _Constant(piece == "true")
        if kind == "text":
            return _Constant(piece[1:-1])
        if kind == "number":
            return _Constant(float(piece))
        self.references.append(Reference(piece))
        return self.references[-1]

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


def _holds(node: _Node, values: Mapping[str, Scalar]) -> bool | None:
    match node:
        case _Not():
            inner = _holds(node.inner, values)
            return None if inner is None else not inner
        case _BooleanOperation():
            found = [_holds(part, values) for part in node.parts]
            decisive = not node.conjunction  # one true decides an "or", one false an "and"
            if decisive in found:
                return decisive
            return None if None in found else node.conjunction
    left, right = _look_up(node.left, values), _look_up(node.right, values)
    if left is None or right is None:
        return None
    if node.sign in ("==", "!="):
        return _equal(left, right) == (node.sign == "==")
    if isinstance(left, str) or isinstance(right, str):
        return False  # texts have no order
    return _ORDERS[node.sign](left, right)


def _look_up(value: Reference | _Constant, values: Mapping[str, Scalar]) -> Scalar | None:
    found = value.value if isinstance(value, _Constant) else values.get(value.text)
    return None if isinstance(found, float) and math.isnan(found) else found


def _equal(left: Scalar, right: Scalar) -> bool:
    """Compare numbers and booleans as Python does (a ROS ``bool`` may be 0 or 1); a text equals only texts."""
    return isinstance(left, str) == isinstance(right, str) and left == right


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
