"""Expressions over topics, parameters and qualities: rules of contexts, alarms and profiles, values of attributes.

::

    rule       = conjunction { "or" conjunction }
    conjunction= negation { "and" negation }
    negation   = "not" negation | sum [ ("==" | "!=" | "<" | "<=" | ">" | ">=") sum ]
    sum        = product { ("+" | "-") product }
    product    = value { ("*" | "/") value }
    value      = "-" value | "(" rule ")" | number | 'text' | "text" | true | false
               | ~parameter | /topic | /topic/field | /topic.field.field | attribute
               | function "(" [ rule { "," rule } ] ")"

Example: ``/battery/charging == true and ~gain > 3``. In ``/battery/charging`` the longest part that is a published
topic is the topic, as for rostopic; ``/battery.charging`` is explicit. A topic alone means the message's only field
(``std_msgs/Bool``). A ``/`` in front of a letter begins a topic, so a division has a space behind it. A value that is
unknown (no message yet, no publisher) makes a comparison neither true nor false, and arithmetic unknown. A rule holds
only if it is true whatever the unknown values are (Kleene's logic).

Pure: an expression is parsed once, into a function of the values; nothing is evaluated as Python.
"""

from __future__ import annotations

import operator
import re
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from rmpa.config.values import did_you_mean, suggestion
from rmpa.core.errors import ConfigError
from rmpa.resource import limits

# A value that rules can compare.
Scalar = bool | int | float | str
_Value = Callable[[Mapping[str, Scalar]], Scalar | None]
_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.]))"
    r"|(?P<text>'[^']*'|\"[^\"]*\")"
    r"|(?P<reference>/[A-Za-z]\w*(?:/\w+)*(?:\.\w+)*|~[A-Za-z]\w*)"
    r"|(?P<word>[A-Za-z_]\w*(?:\.\w+)*)"
    r"|(?P<sign>==|!=|<=|>=|<|>|\(|\)|\+|-|\*|/|,))"
)
_COMPARISONS: Final[Mapping[str, Callable[[Any, Any], bool]]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_SUMS: Final[Mapping[str, Callable[[Any, Any], float]]] = {"+": operator.add, "-": operator.sub}
_PRODUCTS: Final[Mapping[str, Callable[[Any, Any], float]]] = {"*": operator.mul, "/": operator.truediv}
_CALCULATIONS: Final[Mapping[str, Callable[..., float]]] = {"min": min, "max": max, "abs": abs}
# Functions that the running resource answers, with the numbers of their arguments.
SOURCES: Final[Mapping[str, tuple[int, ...]]] = {
    # Processor time of a node's process as a share of one core; memory that it holds, bytes. Without a name: of the
    # resource's only node.
    "cpu": (0, 1),
    "memory": (0, 1),
    # Of the machine: the hottest thermal zone, or the zone of this type, in °C.
    "temperature": (0, 1),
    # The number in a value of /diagnostics: name of the status, key; or the level of the status, 0 to 3.
    "diagnostics": (1, 2),
    # Whether a node is registered at the core and answers.
    "running": (1,),
}
_KEYWORDS: Final = ("and", "or", "not", "true", "false")
_EXAMPLE: Final = "for example /battery/charging == true and ~gain > 3"


@dataclass(frozen=True, slots=True)
class SourceCall:
    """A value that only the running resource knows: ``cpu('driver')``, ``diagnostics('usb_cam', 'Temperature')``.

    Args:
        function: The function's name.
        arguments: Its arguments, which are constants.
    """

    function: str
    arguments: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Expression:
    """A parsed expression.

    Args:
        text: As it was written.
        value: The value by the known values, which are by reference; ``None``: it depends on unknown values.
        references: Each variable once, as written: ``/topic.field``, ``~parameter``, an attribute's name, or the text
            of a source.
        sources: The functions among the references, by their text.
    """

    text: str
    value: _Value
    references: tuple[str, ...]
    sources: Mapping[str, SourceCall] = field(hash=False)

    def __str__(self) -> str:
        """The text."""
        return self.text

    def holds(self, values: Mapping[str, Scalar]) -> bool | None:
        """Whether the expression, as a rule, is true; ``None``: that depends on unknown values."""
        return _truth(self.value(values))


def parse_expression(
    text: str, parameters: Collection[str], where: str = "rule", *, attributes: Collection[str] = ()
) -> Expression:
    """Parse an expression.

    Args:
        text: A ``rule`` of the grammar above.
        parameters: Names of the resource's parameters.
        where: Description of the expression, for errors.
        attributes: Names of the attributes that it may use.

    Raises:
        ConfigError: It has a syntax error or an unknown name, or is too long or nested too deeply.
    """
    if len(text) > limits.CONTEXT_RULE_MAX:
        raise ConfigError(where, f"{len(text)} characters", f"at most {limits.CONTEXT_RULE_MAX}")
    parser = _Parser(text, where, attributes)
    value = parser.parse()
    for name in (reference[1:] for reference in parser.references if reference.startswith("~")):
        if name not in parameters:
            near = did_you_mean(name, parameters)
            remedy = f"did you mean ~{near}?" if near else "declare it before the context"
            raise ConfigError(where, f"there is no parameter {name}", remedy)
    return Expression(text, value, tuple(parser.references), parser.found)


def split_reference(text: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Possible splits of a reference into a topic and its fields, longest topic first; no field: the only one."""
    topic, dot, fields = text.partition(".")
    if dot:
        yield topic, tuple(fields.split("."))
        return
    parts = topic.strip("/").split("/")
    for count in range(len(parts), 0, -1):
        yield "/" + "/".join(parts[:count]), tuple(parts[count:])


class _Parser:
    """A recursive-descent parser of one expression."""

    def __init__(self, text: str, where: str, attributes: Collection[str]) -> None:
        self._text = text
        self._where = where
        self._attributes = attributes
        self.references: dict[str, None] = {}
        self.found: dict[str, SourceCall] = {}
        self._tokens: deque[tuple[str, str]] = deque()
        at = 0
        while rest := text[at:].strip():
            if (match := _TOKEN.match(text, at)) is None:
                raise self._error(f"{rest[:20]!r} cannot be read")
            kind = match.lastgroup or ""
            self._tokens.append((kind, match[kind]))
            at = match.end()
        self._tokens.append(("", ""))

    def parse(self) -> _Value:
        value = self._rule(0)
        if self._tokens[0][0]:
            raise self._error(f"{self._tokens[0][1]!r} stands where the rule must end, or go on with and/or")
        return value

    def _take(self, *lexemes: str) -> str:
        """Remove the next token and return it if it is one of these; else nothing."""
        return self._tokens.popleft()[1] if self._tokens[0][1] in lexemes else ""

    def _close(self) -> None:
        if not self._take(")"):
            raise self._error("a bracket is not closed")

    def _rule(self, depth: int) -> _Value:
        return self._chain("or", lambda: self._chain("and", lambda: self._negation(depth)))

    def _chain(self, word: str, part: Callable[[], _Value]) -> _Value:
        parts = [part()]
        while self._take(word):
            parts.append(part())
        if len(parts) == 1:
            return parts[0]
        decisive = word == "or"  # one true decides an "or", one false an "and"

        def holds(values: Mapping[str, Scalar]) -> bool | None:
            found = [_truth(each(values)) for each in parts]
            if decisive in found:
                return decisive
            return None if None in found else not decisive

        return holds

    def _negation(self, depth: int) -> _Value:
        if depth > limits.CONTEXT_RULE_DEPTH:
            raise self._error(f"deeper than {limits.CONTEXT_RULE_DEPTH} brackets")
        if self._take("not"):
            inner = self._negation(depth + 1)
            return lambda values: None if (found := _truth(inner(values))) is None else not found
        left = self._sum(depth)
        if not (sign := self._take(*_COMPARISONS)):
            return left
        right = self._sum(depth)
        return lambda values: _compare(_COMPARISONS[sign], left(values), right(values))

    def _sum(self, depth: int) -> _Value:
        return self._calculation(_SUMS, lambda: self._calculation(_PRODUCTS, lambda: self._value(depth)))

    def _calculation(self, signs: Mapping[str, Callable[[Any, Any], float]], part: Callable[[], _Value]) -> _Value:
        value = part()
        while sign := self._take(*signs):
            value = _calculated(signs[sign], value, part())
        return value

    def _value(self, depth: int) -> _Value:
        if depth > limits.CONTEXT_RULE_DEPTH:
            raise self._error(f"deeper than {limits.CONTEXT_RULE_DEPTH} brackets")
        if self._take("-"):
            return _calculated(operator.neg, self._value(depth + 1))
        if self._take("("):
            inner = self._rule(depth + 1)
            self._close()
            return inner
        kind, piece = self._tokens[0]
        if not kind or kind == "sign":
            raise self._error(f"a value is missing in front of {piece!r}" if piece else "a value is missing")
        self._tokens.popleft()
        if kind == "word" and piece not in ("true", "false"):
            return self._name(piece, depth)
        if kind == "reference":
            return self._reference(piece)
        constant: Scalar = piece == "true" if kind == "word" else float(piece) if kind == "number" else piece[1:-1]
        return lambda _: constant

    def _reference(self, name: str) -> _Value:
        self.references[name] = None
        return lambda values: values.get(name)

    def _name(self, word: str, depth: int) -> _Value:
        """An attribute, or a function with its arguments."""
        if self._tokens[0][1] != "(":
            if word in self._attributes:
                return self._reference(word)
            near = did_you_mean(word, (*_KEYWORDS, *self._attributes)) if word not in _KEYWORDS else None
            remedy = f"did you mean {near}?" if near else "texts have quotes"
            raise self._error(f"{word!r} is no value", remedy)
        self._tokens.popleft()
        if word in _CALCULATIONS:
            return self._calculate(word, depth)
        if (counts := SOURCES.get(word)) is None:
            known = [*_CALCULATIONS, *SOURCES]
            remedy = suggestion(word, known, f"there are {', '.join(known)}")
            raise self._error(f"there is no function {word}", remedy)
        arguments = []
        while not self._take(")"):
            kind, piece = self._tokens.popleft()
            if kind not in ("text", "word", "reference"):
                raise self._error(f"an argument of {word} is a text", f"{word}('name')")
            arguments.append(piece[1:-1] if kind == "text" else piece)
            if not self._take(",") and self._tokens[0][1] != ")":
                raise self._error("a bracket is not closed")
        if len(arguments) not in counts:
            raise self._error(f"{word} takes {' or '.join(map(str, counts))} texts", f"it has {len(arguments)}")
        source = SourceCall(word, tuple(arguments))
        text = f"{word}({', '.join(map(repr, arguments))})"
        self.found[text] = source
        return self._reference(text)

    def _calculate(self, word: str, depth: int) -> _Value:
        parts = [self._rule(depth + 1)]
        while self._take(","):
            parts.append(self._rule(depth + 1))
        self._close()
        if (len(parts) == 1) != (word == "abs"):
            raise self._error(f"{word} takes {'one value' if word == 'abs' else 'two values or more'}", "")
        return _calculated(_CALCULATIONS[word], *parts)

    def _error(self, problem: str, remedy: str = _EXAMPLE) -> ConfigError:
        return ConfigError(self._where, f"{self._text!r}: {problem}", remedy)


def _calculated(calculate: Callable[..., float], *parts: _Value) -> _Value:
    """A calculation; unknown if a part is, or is a text, or there is no result (a division by zero)."""

    def value(values: Mapping[str, Scalar]) -> float | None:
        found = [each(values) for each in parts]
        if any(each is None or isinstance(each, str) for each in found):
            return None
        try:
            return float(calculate(*found))
        except ArithmeticError:
            return None

    return value


def _truth(value: Scalar | None) -> bool | None:
    return _compare(operator.eq, value, True)


def _compare(compare: Callable[[Any, Any], bool], left: Scalar | None, right: Scalar | None) -> bool | None:
    """Compare two values; numbers and booleans as Python does, since a ROS ``bool`` may be 0 or 1."""
    if left is None or right is None or left != left or right != right:  # noqa: PLR0124 - NaN
        return None
    if isinstance(left, str) != isinstance(right, str):
        return compare is operator.ne  # a text equals only texts
    if isinstance(left, str) and compare not in (operator.eq, operator.ne):
        return False  # texts have no order
    return compare(left, right)
