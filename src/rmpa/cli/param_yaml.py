"""Parameters as YAML, read and written as rosparam does: YAML 1.1 by PyYAML's rules, with angles and binary data."""

from __future__ import annotations

import ast
import io
import math
import operator
import re
from datetime import date, datetime
from typing import TYPE_CHECKING, Any, Final

from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.emitter import Emitter
from ruamel.yaml.error import YAMLError
from ruamel.yaml.representer import SafeRepresenter
from ruamel.yaml.resolver import VersionedResolver

from rmpa.core import limits
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from rmpa.ros.xmlrpc import XmlRpcValue

_INT_MAX: Final = (1 << 31) - 1
_CORE: Final = "tag:yaml.org,2002:"
# PyYAML's own rules (yaml/resolver.py) and rosparam's for angles: by the first characters, then by the whole.
_RULES: Final = (
    (
        f"{_CORE}bool",
        "yYnNtTfFoO",
        r"(?:yes|Yes|YES|no|No|NO|true|True|TRUE|false|False|FALSE|on|On|ON|off|Off|OFF)",
    ),
    (
        f"{_CORE}float",
        "-+0123456789.",
        (
            r"(?:[-+]?(?:[0-9][0-9_]*)\.[0-9_]*(?:[eE][-+][0-9]+)?|\.[0-9][0-9_]*(?:[eE][-+][0-9]+)?"
            r"|[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+\.[0-9_]*|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))"
        ),
    ),
    (
        f"{_CORE}int",
        "-+0123456789",
        (
            r"(?:[-+]?0b[0-1_]+|[-+]?0[0-7_]+|[-+]?(?:0|[1-9][0-9_]*)|[-+]?0x[0-9a-fA-F_]+"
            r"|[-+]?[1-9][0-9_]*(?::[0-5]?[0-9])+)"
        ),
    ),
    (f"{_CORE}merge", "<", r"<<"),
    (f"{_CORE}null", "~nN\0", r"(?:~|null|Null|NULL|)"),
    (
        f"{_CORE}timestamp",
        "0123456789",
        (
            r"(?:[0-9]{4}-[0-9]{2}-[0-9]{2}|[0-9]{4}-[0-9]{1,2}-[0-9]{1,2}(?:[Tt]|[ \t]+)[0-9]{1,2}:[0-9]{2}:[0-9]{2}"
            r"(?:\.[0-9]*)?(?:[ \t]*(?:Z|[-+][0-9]{1,2}(?::[0-9]{2})?))?)"
        ),
    ),
    ("!degrees", "d", r"deg\([^)]*\)"),
    ("!radians", "r", r"rad\([^)]*\)"),
)
_SAFE: Final = r"[ !#-\[\]-~]"
"""What stands between double quotes as it is."""
_OPERATORS: Final[dict[type[ast.AST], Callable[..., float]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}


_Table = dict[str | None, list[tuple[str, re.Pattern[str]]]]


def _table(rules: Iterable[tuple[str, str, str]]) -> _Table:
    found: _Table = {}
    for tag, firsts, pattern in rules:
        for first in firsts:
            found.setdefault("" if first == "\0" else first, []).append((tag, re.compile(rf"{pattern}\Z")))
    return found


class _Resolver(VersionedResolver):
    """Finds the type of what stands without quotes as PyYAML does, whatever the version."""

    rules = _table(_RULES)

    @property
    def versioned_resolver(self) -> _Table:
        """The types by the first character."""
        return self.rules


class _WritingResolver(_Resolver):
    """With what a reader other than ours would not take for a string."""

    rules = _table((*_RULES, (f"{_CORE}value", "=", "=")))


class _Constructor(SafeConstructor):
    """With rosparam's angles."""

    def construct_angle(self, node: Any) -> float:
        """``deg(90)``, ``rad(pi/2)``, ``!degrees 90`` or ``!radians pi/2`` in radians."""
        text = str(self.construct_scalar(node)).strip()
        inner = re.sub(r"^(?:deg|rad)\((.*)\)$", r"\1", text)
        try:
            angle = _calculate(ast.parse(inner.strip(), mode="eval").body)
        except (SyntaxError, ValueError, ZeroDivisionError, OverflowError, RecursionError, MemoryError):
            raise YAMLError(f"{text!r} is not an angle: one looks like deg(90) or rad(pi/2)") from None
        return math.radians(angle) if node.tag == "!degrees" else angle


_Constructor.add_constructor("!degrees", _Constructor.construct_angle)
_Constructor.add_constructor("!radians", _Constructor.construct_angle)


def _calculate(node: ast.AST) -> float:
    """The value of an expression of numbers and ``pi``."""
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return float(number)
        case ast.Name(id="pi"):
            return math.pi
        case ast.UnaryOp(op=sign, operand=operand) if type(sign) in _OPERATORS:
            return _OPERATORS[type(sign)](_calculate(operand))
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _OPERATORS:
            return _OPERATORS[type(sign)](_calculate(left), _calculate(right))
    raise ValueError("not a number")


class _Representer(SafeRepresenter):
    """Writes no anchors: two lists that are equal are two lists."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002 - ruamel's signature
        """Whether each is written in full."""
        return True

    def represent_float(self, data: Any) -> Any:
        """YAML 1.1 wants a point before the exponent."""
        text = repr(data).lower()
        if "e" not in text or "." in text:
            return super().represent_float(data)
        return self.represent_scalar(f"{_CORE}float", text.replace("e", ".0e"))


_Representer.add_representer(float, _Representer.represent_float)


def _safe(character: str) -> bool:
    return re.fullmatch(_SAFE, character) is not None


def _escape(character: str) -> str:
    """As PyYAML writes it between double quotes."""
    short = Emitter.ESCAPE_REPLACEMENTS.get(character)
    if short is not None:
        return f"\\{short}"
    code = ord(character)
    return f"\\x{code:02X}" if code < 0x100 else f"\\u{code:04X}" if code < 0x10000 else f"\\U{code:08X}"


class _Emitter(Emitter):
    """Chooses quotes and indents as PyYAML does."""

    def increase_indent(self, flow: bool = False, sequence: bool | None = None, indentless: bool = False) -> None:
        """Lines of a lone string are indented too."""
        top = self.indent is None
        super().increase_indent(flow, sequence, indentless)
        if top and flow:
            self.indent = self.best_map_indent

    def write_plain(self, text: Any, split: Any = True) -> None:
        """Broken at a single space, once the line is long enough."""
        if self.root_context:
            self.open_ended = True
        if text and not self.whitespace:
            self._put(" ")
        self.whitespace = self.indention = False
        for piece in re.split("( +)", text):
            if piece == " " and self.column > self.best_width and split:
                self.write_indent()
                self.whitespace = self.indention = False
            else:
                self._put(piece)

    def write_double_quoted(self, text: Any, split: Any = True) -> None:
        """Broken before a space or behind what is escaped; ruamel's own breaks would bring spaces in."""
        self.write_indicator('"', True)
        last = len(text) - 1
        for piece in re.finditer(rf"{_SAFE}+|(.)", text, re.DOTALL):
            if piece[1]:
                self._put(_escape(piece[1]))
                rest = piece.end()
                far = self.column - self.best_width
                if split and ((far > 1 and 1 < rest <= last) or (far > 0 and rest < last and _safe(text[rest]))):
                    self._break(text, rest)
                continue
            begin = piece.start()
            for space in re.finditer(" ", piece[0]):
                at = piece.start() + space.start()
                if split and 0 < at < last and self.column + at - begin > self.best_width:
                    self._put(text[begin:at])
                    self._break(text, at)
                    begin = at
            self._put(text[begin : piece.end()])
        self.write_indicator('"', False)

    def _break(self, text: str, rest: int) -> None:
        self._put("\\")
        self.write_indent()
        self.whitespace = self.indention = False
        if text[rest] == " ":
            self._put("\\")

    def _put(self, data: str) -> None:
        self.column += len(data)
        self.stream.write(data.encode(self.encoding) if self.encoding else data)

    def choose_scalar_style(self) -> Any:
        """Without quotes where possible, then single ones, then double ones."""
        event, about = self.event, self.analysis or self.analyze_scalar(self.event.value)
        self.analysis = about
        if event.style == '"':
            return '"'
        plain = about.allow_flow_plain if self.flow_level else about.allow_block_plain
        lone_key = self.simple_key_context and (about.empty or about.multiline)
        if not event.style and event.implicit[0] and plain and not lone_key:
            return ""
        if event.style == "|" and not self.flow_level and not self.simple_key_context and about.allow_block:
            return "|"
        if about.allow_single_quoted and not (self.simple_key_context and about.multiline):
            return "'"
        return '"'


def read_yaml(text: str, where: str) -> XmlRpcValue:
    """The value of a YAML text; an empty one is an empty string, for a shell's quotes are gone.

    Raises:
        RmpaError: It is not YAML, or cannot be a parameter: with ``where``, line and column.
    """
    return next(iter(read_documents(text or "''", where)), "")


def read_documents(text: str, where: str) -> list[XmlRpcValue]:
    """The values of all documents of a YAML text.

    Raises:
        RmpaError: As for ``read_yaml``.
    """
    if len(text) > limits.PARAM_TEXT_MAX:
        raise RmpaError(f"{where}: {len(text)} characters; a parameter may have {limits.PARAM_TEXT_MAX}")
    yaml = YAML(typ="safe", pure=True)
    yaml.Resolver, yaml.Constructor, yaml.version = _Resolver, _Constructor, (1, 1)
    try:
        documents = list(yaml.load_all(text))
    except (YAMLError, ValueError, RecursionError) as error:
        raise RmpaError(f"{where}{_place(error)}: not YAML: {_problem(error)}") from None
    for document in documents:
        for key, problem in _unsayable(document):
            raise RmpaError(f"{where}: {f'{key}: ' if key else ''}{problem}")
    return [_plain(document) for document in documents]


def _place(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    return f":{mark.line + 1}:{mark.column + 1}" if mark is not None else ""


def _problem(error: Exception) -> str:
    return str(getattr(error, "problem", None) or error).splitlines()[0]


def _unsayable(value: object, key: str = "", depth: int = 0) -> Iterator[tuple[str, str]]:
    """What in a value no parameter can be, with its key."""
    if depth > limits.PARAM_DEPTH_MAX:
        yield key.partition("[")[0], f"nested deeper than {limits.PARAM_DEPTH_MAX} levels"
    elif isinstance(value, dict):
        for name, member in value.items():
            if not isinstance(name, str):
                yield key, f"the key {name!r} is not a string; put it in quotes"
            else:
                yield from _unsayable(member, f"{key}/{name}", depth + 1)
    elif isinstance(value, list | tuple):
        for index, member in enumerate(value):
            yield from _unsayable(member, f"{key}[{index}]", depth + 1)
    elif value is None:
        yield key, "null is no value of a parameter; write '' for an empty string, or leave it out"
    elif isinstance(value, int) and not isinstance(value, bool) and not -_INT_MAX - 1 <= value <= _INT_MAX:
        yield key, f"{value} does not fit the 32 bits of a parameter; write it with a point, or in quotes"
    elif not isinstance(value, bool | int | float | str | bytes | date):
        yield key, f"a {type(value).__name__} cannot be a parameter"


def _plain(value: Any) -> Any:
    """A value of the types that XML-RPC has: a date has a time there."""
    if isinstance(value, dict):
        return {name: _plain(member) for name, member in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(member) for member in value]
    if isinstance(value, date) and not isinstance(value, datetime):
        return datetime(value.year, value.month, value.day)  # noqa: DTZ001 - XML-RPC's dates have no zone
    return value


def write_yaml(value: XmlRpcValue) -> str:
    """A value as ``rosparam dump`` writes it, keys in order."""
    yaml = YAML(typ="safe", pure=True)
    yaml.Resolver, yaml.Representer, yaml.Emitter = _WritingResolver, _Representer, _Emitter
    yaml.default_flow_style = False
    yaml.allow_unicode = False
    stream = io.StringIO()
    yaml.dump(_sorted(value), stream)
    return stream.getvalue()


def show_yaml(value: XmlRpcValue) -> str:
    """A value as ``rosparam get`` prints it: without the mark that ends a document of one scalar."""
    return write_yaml(value).removesuffix("...\n").rstrip("\n") + "\n"


def _sorted(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _sorted(value[name]) for name in sorted(value)}
    if isinstance(value, list):
        return [_sorted(member) for member in value]
    return value
