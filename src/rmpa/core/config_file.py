"""The file ``rmpa.toml``: its shape, and where in it something is written."""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING, Any, Final, get_args

import msgspec
from msgspec import UNSET, UnsetType

from rmpa.core import limits
from rmpa.core.config_values import did_you_mean
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

Key = tuple[str, ...]
_AT_LINE: Final = re.compile(r" \(at line (\d+), column \d+\)$")
_AT_PATH: Final = re.compile(r" - at `\$\.?([^`]*)`$")
_TYPES: Final = {
    "str": "a text in quotes",
    "int": "a whole number",
    "bool": "true or false",
    "array": "a list",
    "object": "a table",
    "float": "a number with a point",
}


class _Table(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    pass


class CoreTable(_Table, kw_only=True):
    """``[core]``: where the ROS core listens."""

    host: str | UnsetType = UNSET
    port: int | UnsetType = UNSET


class MeshTable(_Table, kw_only=True):
    """``[mesh]``: the links to the peers."""

    port: int | UnsetType = UNSET


class DiscoveryTable(_Table, kw_only=True):
    """``[discovery]``: how peers find each other."""

    interfaces: list[str] | UnsetType = UNSET
    seeds: list[str] | UnsetType = UNSET
    multicast: str | bool | UnsetType = UNSET


class BridgeTable(_Table, kw_only=True):
    """``[bridge]``: what may cross."""

    allow: list[str] | UnsetType = UNSET
    deny: list[str] | UnsetType = UNSET
    allow_types: list[str] | UnsetType = UNSET
    deny_types: list[str] | UnsetType = UNSET


class LogTable(_Table, kw_only=True):
    """``[log]``: what is written about it."""

    level: str | UnsetType = UNSET
    json: bool | UnsetType = UNSET


class ConfigFile(_Table, kw_only=True):
    """A whole ``rmpa.toml``."""

    name: str | UnsetType = UNSET
    domain: int | UnsetType = UNSET
    core: CoreTable = msgspec.field(default_factory=CoreTable)
    mesh: MeshTable = msgspec.field(default_factory=MeshTable)
    discovery: DiscoveryTable = msgspec.field(default_factory=DiscoveryTable)
    bridge: BridgeTable = msgspec.field(default_factory=BridgeTable)
    log: LogTable = msgspec.field(default_factory=LogTable)


def _keys(table: type[msgspec.Struct]) -> dict[str, type[msgspec.Struct] | None]:
    """A table's keys; a sub-table's struct beside those that are tables."""
    found: dict[str, type[msgspec.Struct] | None] = {}
    for info in msgspec.structs.fields(table):
        is_table = isinstance(info.type, type) and not get_args(info.type) and issubclass(info.type, msgspec.Struct)
        found[info.encode_name] = info.type if is_table else None
    return found


def known_keys() -> list[Key]:
    """Every key that a file may have: ``("name",)``, ``("core", "port")`` and so on."""
    found: list[Key] = []
    for name, table in _keys(ConfigFile).items():
        found += [(name,)] if table is None else [(name, inner) for inner in _keys(table)]
    return found


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
    for key, suggestion in _unknown(table):
        what = "an unknown table" if isinstance(_at(table, key), dict) else "an unknown key"
        raise ConfigError(".".join(key), what, suggestion, path, line_of(text, key))
    try:
        parsed = msgspec.convert(table, ConfigFile)
    except msgspec.ValidationError as error:
        raise _wrong_type(error, table, text, path) from None
    found: dict[Key, object] = {}
    for key in known_keys():
        value: object = parsed
        for part in key:
            value = getattr(value, part)
        if value is not UNSET:
            found[key] = value
    return found


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


def _unknown(table: dict[str, Any]) -> Iterator[tuple[Key, str]]:
    """Unknown keys, each with what was probably meant."""
    everywhere = known_keys()
    tables = _keys(ConfigFile)
    for name, value in table.items():
        if name not in tables:
            yield (name,), _meant(name, (), everywhere, list(tables))
        struct = tables.get(name)
        if struct is None or not isinstance(value, dict):
            continue
        inner = list(_keys(struct))
        for key in value:
            if key not in inner:
                yield (name, key), _meant(key, (name,), everywhere, inner)


def _meant(word: str, table: Key, everywhere: list[Key], here: list[str]) -> str:
    near = did_you_mean(word, here)
    if near is not None:
        return f"did you mean {'.'.join((*table, near))}?"
    for key in everywhere:
        if key[-1] == word:
            home = f"in [{key[0]}]" if len(key) > 1 else "above the first table"
            return f"{word} belongs {home}"
    near = did_you_mean(word, [key[-1] for key in everywhere])
    if near is not None:
        key = next(key for key in everywhere if key[-1] == near)
        return f"did you mean {'.'.join(key)}?"
    return f"known here: {', '.join(here)}"


def _wrong_type(error: msgspec.ValidationError, table: dict[str, Any], text: str, path: Path | None) -> ConfigError:
    message = str(error)
    match = _AT_PATH.search(message)
    key: tuple[str | int, ...] = ()
    if match:
        key = tuple(int(part) if part.isdecimal() else part for part in re.findall(r"[^.\[\]]+", match[1]))
    value = _at(table, key)
    expected = re.search(r"Expected `([^`]*)`", message)
    wanted = " or ".join(_TYPES.get(t, t) for t in (expected[1].split(" | ") if expected else []))
    source = ".".join(part for part in key if isinstance(part, str))
    problem = f"{_shown(value)} is not {wanted}" if wanted else message
    return ConfigError(source or "the file", problem, "", path, line_of(text, key))


def _shown(value: object) -> str:
    shown = str(value).lower() if isinstance(value, bool) else repr(value)
    return shown if len(shown) <= 60 else shown[:57] + "..."


def _at(table: object, key: Sequence[str | int]) -> object:
    for part in key:
        in_table = isinstance(table, dict) and part in table
        in_list = isinstance(table, list) and isinstance(part, int) and part < len(table)
        if not in_table and not in_list:
            return None
        table = table[part]  # type: ignore[index] # one of the two, as just seen
    return table


def line_of(text: str, key: Sequence[str | int]) -> int | None:
    """The line, from 1, on which a key's statement begins in a valid TOML text.

    ``tomllib`` does not tell. A prefix of whole lines parses exactly where no statement is open, so the first
    prefix that has the key ends with its statement, and the one before that shows where it begins. Where the
    last part of ``key`` is an index, the line of that element of a list.
    """
    names = [part for part in key if isinstance(part, str)]
    lines = text.split("\n")
    begin = 0
    for end in range(1, len(lines) + 1):
        try:
            table = tomllib.loads("\n".join(lines[:end]))
        except (ValueError, RecursionError):
            continue
        if _at(table, names) is not None:
            last = key[-1] if key else None
            return _element_line(lines, begin, end, last) if isinstance(last, int) else begin + 1
        begin = end
    return None


def _element_line(lines: list[str], begin: int, end: int, index: int) -> int:
    """The line of one element of the list that is written between two lines."""
    for stop in range(begin + 1, end):
        try:
            value: object = tomllib.loads("\n".join(lines[begin:stop]) + "\n]")
        except ValueError:
            continue
        while isinstance(value, dict) and value:
            value = next(iter(value.values()))
        if isinstance(value, list) and len(value) > index:
            return stop
    return end
