"""Parameters as YAML: PyYAML with the additions of rosparam (angles), and errors that name line and column."""

from __future__ import annotations

import ast
import math
import operator
import re
from datetime import date, datetime
from typing import TYPE_CHECKING, Any, Final

import yaml

from rmpa.core.errors import RmpaError
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_INT_MAX: Final = (1 << 31) - 1
_OPERATORS: Final[dict[type[ast.AST], Callable[..., float]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with rosparam's angles: ``deg(90)``, ``rad(pi/2)``, ``!degrees 90``, ``!radians pi/2``.

    A key that stands twice in one mapping is an error: PyYAML alone would silently drop the first value.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The mapping's values by key.

        Raises:
            yaml.constructor.ConstructorError: A key stands twice; with its place.
        """
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    problem = f"found duplicate key {key.value!r}"
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """PyYAML's safe dumper without anchors: two equal lists are two lists in the parameter server."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002 - PyYAML's signature
        """Whether each value is written in full."""
        return True


def _construct_value(loader: _Loader, node: yaml.ScalarNode) -> str:
    """The text of a lone ``=``: PyYAML resolves it to a type that it cannot construct."""
    return str(loader.construct_scalar(node))


def _construct_angle(loader: _Loader, node: yaml.ScalarNode) -> float:
    """The angle in radians.

    Raises:
        yaml.constructor.ConstructorError: The text is no angle; with its place.
    """
    text = str(loader.construct_scalar(node)).strip()
    inner = re.sub(r"^(?:deg|rad)\((.*)\)$", r"\1", text)
    try:
        angle = _calculate(ast.parse(inner.strip(), mode="eval").body)
    except (SyntaxError, ValueError, ZeroDivisionError, OverflowError, RecursionError, MemoryError):
        problem = f"{text!r} is not an angle: one looks like deg(90) or rad(pi/2)"
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None
    return math.radians(angle) if node.tag == "!degrees" else angle


_Loader.add_constructor("tag:yaml.org,2002:value", _construct_value)
for _tag, _first, _pattern in (("!degrees", "d", r"^deg\([^)]*\)$"), ("!radians", "r", r"^rad\([^)]*\)$")):
    _Loader.add_constructor(_tag, _construct_angle)
    _Loader.add_implicit_resolver(_tag, re.compile(_pattern), [_first])


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


def read_yaml(text: str, where: str) -> XmlRpcValue:
    """The value of a YAML text; an empty text is an empty string, since the shell removes the quotes.

    Raises:
        RmpaError: It is not YAML, or cannot be a parameter: with ``where``, line and column.
    """
    return next(iter(read_documents(text or "''", where)), "")


def read_documents(text: str, where: str) -> list[XmlRpcValue]:
    """The values of all documents of a YAML text.

    Raises:
        RmpaError: As for ``read_yaml``.
    """
    if len(text) > limits.HTTP_BODY_MAX:
        bound = f"{limits.HTTP_BODY_MAX} ({limits.HTTP_BODY_MAX >> 20} MiB)"
        raise RmpaError(f"{where}: {len(text)} characters, above the {bound} that a core takes at once; split it")
    try:
        documents = list(yaml.load_all(text, _Loader))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise RmpaError(f"{where}{_place(error)}: not YAML: {_problem(error)}") from None
    for document in documents:
        for key, problem in _unstorable(document):
            raise RmpaError(f"{where}: {f'{key}: ' if key else ''}{problem}")
    return [_plain(document) for document in documents]


def _place(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    return f":{mark.line + 1}:{mark.column + 1}" if mark is not None else ""


def _problem(error: Exception) -> str:
    return str(getattr(error, "problem", None) or error).splitlines()[0]


def _unstorable(value: object, key: str = "", depth: int = 0) -> Iterator[tuple[str, str]]:
    """The parts of a value that no parameter can hold: key and problem of each."""
    if depth > limits.PARAM_DEPTH_MAX:
        yield key.partition("[")[0], f"nested deeper than {limits.PARAM_DEPTH_MAX} levels"
    elif isinstance(value, dict):
        for name, member in value.items():
            if not isinstance(name, str):
                yield key, f"the key {name!r} is not a string; put it in quotes"
            else:
                yield from _unstorable(member, f"{key}/{name}", depth + 1)
    elif isinstance(value, list | tuple):
        for index, member in enumerate(value):
            yield from _unstorable(member, f"{key}[{index}]", depth + 1)
    elif value is None:
        yield key, "null is no value of a parameter; write '' for an empty string, or leave it out"
    elif isinstance(value, int) and not isinstance(value, bool) and not -_INT_MAX - 1 <= value <= _INT_MAX:
        yield key, f"{value} does not fit the 32 bits of a parameter; write it with a point, or in quotes"
    elif not isinstance(value, bool | int | float | str | bytes | date):
        yield key, f"a {type(value).__name__} cannot be a parameter"


def _plain(value: Any) -> Any:
    """A value in the types of XML-RPC, where a date always has a time."""
    if isinstance(value, dict):
        return {name: _plain(member) for name, member in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(member) for member in value]
    if isinstance(value, date) and not isinstance(value, datetime):
        return datetime(value.year, value.month, value.day)  # noqa: DTZ001 - XML-RPC's dates have no zone
    return value


def write_yaml(value: XmlRpcValue) -> str:
    """A value as ``rosparam dump`` writes it, keys in order."""
    return yaml.dump(value, Dumper=_Dumper, default_flow_style=False)


def show_yaml(value: XmlRpcValue) -> str:
    """A value as ``rosparam get`` prints it: without the ``...`` that ends a document of one scalar."""
    return write_yaml(value).removesuffix("...\n").rstrip("\n") + "\n"
