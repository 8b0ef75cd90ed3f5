"""The file ``rmpa.toml``: parsed, and its shape checked against the settings that ``config.settings`` declares."""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING, Any, Final

from rmpa.config import limits
from rmpa.config.schema import REMOVED
from rmpa.config.settings import SETTINGS
from rmpa.config.toml_lines import line_of, value_at
from rmpa.config.values import JsonSchema, Place, did_you_mean, shown
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from rmpa.config.schema import Key

_AT_LINE: Final = re.compile(r" \(at line (\d+), column \d+\)$")
_TYPES: Final[dict[str, tuple[type, str]]] = {
    "string": (str, "a text in quotes"),
    "integer": (int, "a whole number"),
    "boolean": (bool, "true or false"),
    "array": (list, "a list"),
    "object": (dict, "a table"),
}
"""By the name of a type in JSON Schema: the type of TOML values, and its name in errors."""
SCHEMAS: Final[dict[Key, JsonSchema]] = {s.key: s.type.json_schema for s in SETTINGS if s.key}
"""Every key that a file may have, ``("name",)``, ``("core", "port")`` and so on, and what its value may be.

Each of ``LISTS`` is one: ``("contract",)`` has the list of all ``[[contract]]``.
"""
LISTS: Final = {s.key: tuple(s.type.json_schema["items"]["properties"]) for s in SETTINGS if s.is_list_of_tables}
"""The tables that there may be many of (``("contract",)``), and the keys that each may have."""
_TABLES: Final = {
    key[:depth]: tuple(dict.fromkeys(other[depth] for other in SCHEMAS if other[:depth] == key[:depth]))
    for key in SCHEMAS
    for depth in range(len(key))
}
"""The keys and tables of each table; those of the file itself by ``()``."""


def parse_config(data: bytes, path: Path | None) -> dict[Key, object]:
    """Read a file's bytes.

    Args:
        data: UTF-8 text in TOML.
        path: For the text of errors.

    Returns:
        What it says, by key; only the types are checked.

    Raises:
        ConfigError: With line and key, if the text is not TOML, has an unknown key or a value of a wrong type.
    """
    if len(data) > limits.CONFIG_FILE_MAX:
        raise ConfigError(
            "the file", f"{len(data)} bytes, more than {limits.CONFIG_FILE_MAX}", "is it the right file?", path
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError("the file", "not UTF-8 text", "save it as UTF-8", path, line) from None
    table = _parse_toml(text, path)
    for place, suggestion in _unknown(table):
        what = "an unknown table" if isinstance(value_at(table, place), dict) else "an unknown key"
        raise ConfigError(dotted(place), what, REMOVED.get(dotted(place), suggestion), path, line_of(text, place))
    for place, value, types in _mistyped(table):
        problem, remedy = _type_mistake(place, value, types)
        raise ConfigError(dotted(place), problem, remedy, path, line_of(text, place))
    return {key: value for key in SCHEMAS if (value := value_at(table, key)) is not None}


def _parse_toml(text: str, path: Path | None) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ConfigError("the file", "lists or tables nested too deeply", "", path) from None
    except ValueError as error:  # TOMLDecodeError, and int() on thousands of digits
        message = str(error)
        match = _AT_LINE.search(message)
        line = int(match[1]) if match else text.rstrip().count("\n") + 1
        problem = f"not TOML: {_AT_LINE.sub('', message).removesuffix(' (at end of document)')}"
        raise ConfigError("the file", problem, _toml_remedy(text, line), path, line) from None


def _toml_remedy(text: str, line: int) -> str:
    lines = text.split("\n")
    written = lines[line - 1] if line <= len(lines) else ""
    match = re.match(r"\s*[\w.-]+\s*=\s*([^\s\"'\[{#][^#]*?)\s*(?:#.*)?$", written)
    if match and not re.match(r"(true|false|[-+0-9])", match[1]):
        return f'texts need quotes: "{match[1]}"'
    if re.match(r"\s*[\w.-]+\s*:", written):
        return "TOML writes key = value, not key: value"
    return ""


def dotted(place: Place) -> str:
    """A place as a user reads it, without the indices: the line says which one."""
    return ".".join(part for part in place if isinstance(part, str))


def _unknown(table: dict[str, Any]) -> Iterator[tuple[Place, str]]:
    """Unknown keys, each with what was probably meant."""
    everywhere = [key for key in SCHEMAS if key not in LISTS]
    everywhere += [(*name, key) for name, keys in LISTS.items() for key in keys]
    for place, key_of_table, inside, known in _tables((), table):
        for key in inside:
            if key not in known:
                yield (*place, key), _suggestion(key, key_of_table, everywhere, list(known))


def _tables(key: Key, value: object) -> Iterator[tuple[Place, Key, dict[str, Any], Sequence[str]]]:
    """A key's table and those in it: the place, the key, the table, and the keys that it may have."""
    if isinstance(value, dict) and (known := _TABLES.get(key)):
        yield key, key, value, known
        for name in value:
            yield from _tables((*key, name), value[name])
    for index, element in enumerate(value if key in LISTS and isinstance(value, list) else ()):
        if isinstance(element, dict):
            yield (*key, index), key, element, LISTS[key]


def _suggestion(word: str, table: Key, everywhere: list[Key], here: list[str]) -> str:
    """What to do about an unknown key: the key that was probably meant, or the table that it belongs in."""
    homes = [key for key in everywhere if key[-1] == word]
    near = did_you_mean(word, here)
    if near is not None and (table or not homes):
        return f"did you mean {'.'.join((*table, near))}?"
    if homes:
        return f"{word} belongs {_home(homes[0])}"
    near = did_you_mean(word, [key[-1] for key in everywhere])
    if near is not None:
        key = next(key for key in everywhere if key[-1] == near)
        return f"did you mean {'.'.join(key)}?"
    return f"known here: {', '.join(here)}"


def _home(key: Key) -> str:
    if len(key) == 1:
        return "above the first table"
    table = ".".join(key[:-1])
    return f"in a [[{table}]]" if key[:-1] in LISTS else f"in [{table}]"


def _mistyped(table: dict[str, Any]) -> Iterator[tuple[Place, object, list[str]]]:
    """Values of a wrong type: place, value, and the types (in JSON Schema's words) that it may have."""
    for place, value in _values((), table):
        if place not in _TABLES:
            yield from _mismatches(place, value, SCHEMAS[place])
        elif not isinstance(value, dict):
            yield place, value, ["object"]


def _values(key: Key, value: object) -> Iterator[tuple[Key, object]]:
    """Each value below a key that is not a table of settings; also what stands in the place of such a table."""
    if key in _TABLES and isinstance(value, dict):
        for name, inner in value.items():
            yield from _values((*key, name), inner)
    else:
        yield key, value


def _mismatches(place: Place, value: object, schema: JsonSchema) -> Iterator[tuple[Place, object, list[str]]]:
    """Mismatches of JSON Schema's ``type`` in a value and its elements; all else is checked by the readers."""
    expected = schema.get("type", [])
    types = [expected] if isinstance(expected, str) else expected
    if types and type(value) not in [_TYPES[name][0] for name in types]:
        yield place, value, types
    elif isinstance(value, list):
        for index, element in enumerate(value):
            yield from _mismatches((*place, index), element, schema.get("items", {}))
    elif isinstance(value, dict):
        known, other = schema.get("properties", {}), schema.get("additionalProperties")
        for key, inner in value.items():
            yield from _mismatches((*place, key), inner, known.get(key) or other or {})


def _type_mistake(place: Place, value: object, types: list[str]) -> tuple[str, str]:
    """The problem and the remedy for a value of a wrong type."""
    if place in LISTS and isinstance(value, dict):
        return "one table, where a list of them is expected", f"write [[{dotted(place)}]], in two brackets"
    problem = f"{shown(value)} is not {' or '.join(_TYPES[name][1] for name in types)}"
    return problem, f'did you mean ["{value}"]?' if types == ["array"] and isinstance(value, str) else ""
