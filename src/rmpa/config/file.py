"""The file ``rmpa.toml``: its shape, and where in it something is written."""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING, Any, Final, get_args

import msgspec
from msgspec import UNSET, UnsetType

from rmpa.config import limits
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

Key = tuple[str, ...]
"""A key of the file: ``("core", "port")``."""
Place = tuple[str | int, ...]
"""A key, or what is below it: ``("contract", 1, "topics", 0)``."""
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
    """``[core]``: where the ROS core listens, or which roscore is used instead of it."""

    mode: str | UnsetType = UNSET
    master: str | UnsetType = UNSET
    fresh: bool | UnsetType = UNSET
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


class ContractTable(_Table, kw_only=True):
    """``[[contract]]``: what the topics of one rule need; ``config.contract_rules`` reads the values."""

    topics: list[str] | UnsetType = UNSET
    types: list[str] | UnsetType = UNSET
    reliability: str | UnsetType = UNSET
    durability: str | UnsetType = UNSET
    history: str | UnsetType = UNSET
    depth: int | UnsetType = UNSET
    deadline: object | UnsetType = UNSET
    lifespan: object | UnsetType = UNSET
    liveliness: str | UnsetType = UNSET
    liveliness_lease_duration: object | UnsetType = UNSET
    priority: str | UnsetType = UNSET
    max_rate: object | UnsetType = UNSET
    outage: object | UnsetType = UNSET


class PeerTable(_Table, kw_only=True):
    """``[[peer]]``: what holds between us and peers of some names; ``config.peer_rules`` reads the values."""

    name: str | UnsetType = UNSET
    prefix: str | UnsetType = UNSET
    remap_in: dict[str, str] | UnsetType = UNSET
    remap_out: dict[str, str] | UnsetType = UNSET
    remap: list[dict[str, object]] | UnsetType = UNSET
    allow: list[str] | UnsetType = UNSET
    deny: list[str] | UnsetType = UNSET
    allow_types: list[str] | UnsetType = UNSET
    deny_types: list[str] | UnsetType = UNSET


class ServicesTable(_Table, kw_only=True):
    """``[services]``: which services cross, and how long a call may take."""

    allow: list[str] | UnsetType = UNSET
    deny: list[str] | UnsetType = UNSET
    loggers: bool | UnsetType = UNSET
    timeout: object | UnsetType = UNSET


class ServiceTable(_Table, kw_only=True):
    """``[[service]]``: what holds for services of some names; ``config.service_rules`` reads the values."""

    names: list[str] | UnsetType = UNSET
    timeout: object | UnsetType = UNSET


class NodesTable(_Table, kw_only=True):
    """``[nodes]``: what peers may do with this module's nodes."""

    kill: list[str] | UnsetType = UNSET


class ParamsTable(_Table, kw_only=True):
    """``[params]``: what peers may do with this module's parameters."""

    remote_get: list[str] | UnsetType = UNSET
    remote_set: list[str] | UnsetType = UNSET


class ParamTable(_Table, kw_only=True):
    """``[[param]]``: a parameter of a peer that is followed; ``config.param_rules`` reads the values."""

    key: str | UnsetType = UNSET
    from_: str | UnsetType = msgspec.field(default=UNSET, name="from")
    to: str | UnsetType = UNSET


class TimeTable(_Table, kw_only=True):
    """``[time]``: whose simulated time this module has, and who may have ours."""

    follow: str | UnsetType = UNSET
    share: bool | UnsetType = UNSET


class LimitsTable(_Table, kw_only=True):
    """``[limits]``: how much of one peer is taken."""

    nodes: int | UnsetType = UNSET
    topics: int | UnsetType = UNSET
    services: int | UnsetType = UNSET
    params: int | UnsetType = UNSET


class LanesTable(_Table, kw_only=True):
    """``[lanes]``: how the packets of each lane are marked."""

    express_dscp: int | UnsetType = UNSET
    express_priority: int | UnsetType = UNSET
    bulk_dscp: int | UnsetType = UNSET
    bulk_priority: int | UnsetType = UNSET


class RealtimeTable(_Table, kw_only=True):
    """``[realtime]``: what is asked of the kernel."""

    enabled: bool | UnsetType = UNSET
    priority: int | UnsetType = UNSET
    cpus: list[int] | UnsetType = UNSET
    lock_memory: bool | UnsetType = UNSET
    keep_awake: bool | UnsetType = UNSET


class RelayTable(_Table, kw_only=True):
    """``[relay]``: whether this module joins networks that are not routed to each other."""

    enabled: bool | UnsetType = UNSET


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
    contract: list[ContractTable] | UnsetType = UNSET
    peer: list[PeerTable] | UnsetType = UNSET
    services: ServicesTable = msgspec.field(default_factory=ServicesTable)
    service: list[ServiceTable] | UnsetType = UNSET
    nodes: NodesTable = msgspec.field(default_factory=NodesTable)
    params: ParamsTable = msgspec.field(default_factory=ParamsTable)
    param: list[ParamTable] | UnsetType = UNSET
    time: TimeTable = msgspec.field(default_factory=TimeTable)
    limits: LimitsTable = msgspec.field(default_factory=LimitsTable)
    lanes: LanesTable = msgspec.field(default_factory=LanesTable)
    realtime: RealtimeTable = msgspec.field(default_factory=RealtimeTable)
    relay: RelayTable = msgspec.field(default_factory=RelayTable)
    log: LogTable = msgspec.field(default_factory=LogTable)


def _keys(table: type[msgspec.Struct]) -> dict[str, type[msgspec.Struct] | None]:
    """A table's keys; a sub-table's struct beside those that are tables."""
    found: dict[str, type[msgspec.Struct] | None] = {}
    for info in msgspec.structs.fields(table):
        is_table = isinstance(info.type, type) and not get_args(info.type) and issubclass(info.type, msgspec.Struct)
        found[info.encode_name] = info.type if is_table else None
    return found


def known_keys() -> list[Key]:
    """Every key that a file may have: ``("name",)``, ``("core", "port")`` and so on.

    Each of ``LISTS`` is one: ``("contract",)`` has the list of all ``[[contract]]``, each a dict of its keys.
    """
    found: list[Key] = []
    for name, table in _keys(ConfigFile).items():
        found += [(name,)] if table is None else [(name, inner) for inner in _keys(table)]
    return found


LISTS: Final = {
    name: tuple(_keys(table))
    for name, table in (
        ("contract", ContractTable),
        ("param", ParamTable),
        ("service", ServiceTable),
        ("peer", PeerTable),
    )
}
"""The tables that there may be many of (``[[contract]]``), and the keys that each may have."""


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
        what = "an unknown table" if isinstance(_at(table, place), dict) else "an unknown key"
        raise ConfigError(dotted(place), what, suggestion, path, line_of(text, place))
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
    found.update(((name,), table[name]) for name in LISTS if name in table)
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


def dotted(place: Place) -> str:
    """A place as a user reads it, without the indices: the line says which one."""
    return ".".join(part for part in place if isinstance(part, str))


def _unknown(table: dict[str, Any]) -> Iterator[tuple[Place, str]]:
    """Unknown keys, each with what was probably meant."""
    everywhere = [key for key in known_keys() if key[0] not in LISTS]
    everywhere += [(name, key) for name, keys in LISTS.items() for key in keys]
    tables = _keys(ConfigFile)
    for name, value in table.items():
        if name not in tables:
            yield (name,), _meant(name, (), everywhere, list(tables))
        for place, inside, inner in _inside(name, value, tables.get(name)):
            for key in inside:
                if key not in inner:
                    yield (*place, key), _meant(key, (name,), everywhere, inner)


def _inside(name: str, value: object, struct: type[msgspec.Struct] | None) -> Iterator[tuple[Place, Any, list[str]]]:
    """The tables below one key of the file, each with its place and the keys that it may have."""
    if struct is not None and isinstance(value, dict):
        yield (name,), value, list(_keys(struct))
    if name in LISTS:
        for index, element in enumerate(value if isinstance(value, list) else ()):
            if isinstance(element, dict):
                yield (name, index), element, list(LISTS[name])


def _meant(word: str, table: Key, everywhere: list[Key], here: list[str]) -> str:
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
    return f"in a [[{key[0]}]]" if key[0] in LISTS else f"in [{key[0]}]"


def _wrong_type(error: msgspec.ValidationError, table: dict[str, Any], text: str, path: Path | None) -> ConfigError:
    message = str(error)
    match = _AT_PATH.search(message)
    place: Place = ()
    if match:
        place = tuple(int(part) if part.isdecimal() else part for part in re.findall(r"[^.\[\]]+", match[1]))
    value = _at(table, place)
    expected = re.search(r"Expected `([^`]*)`", message)
    wanted = " or ".join(_TYPES.get(t, t) for t in (expected[1].split(" | ") if expected else []))
    problem = f"{_shown(value)} is not {wanted}" if wanted else message
    remedy = ""
    if len(place) == 1 and place[0] in LISTS and isinstance(value, dict):
        problem, remedy = "one table, where a list of them is expected", f"write [[{place[0]}]], in two brackets"
    elif expected and expected[1] == "array" and isinstance(value, str):
        remedy = f'did you mean ["{value}"]?'
    return ConfigError(dotted(place) or "the file", problem, remedy, path, line_of(text, place))


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


def line_of(text: str, place: Place) -> int | None:
    """The line, from 1, on which what is at a place begins in a valid TOML text.

    ``tomllib`` does not tell. A prefix of whole lines parses exactly where no statement is open, so the first
    prefix that has the place ends with its statement, and the one before that shows where it begins. An element of
    a list is looked for within its statement.
    """
    lines = text.split("\n")
    begin = 0
    for end in range(1, len(lines) + 1):
        try:
            table = tomllib.loads("\n".join(lines[:end]))
        except (ValueError, RecursionError):
            continue
        if _at(table, place) is not None:
            return _element_line(lines, begin, end, place)
        begin = end
    return None


def _element_line(lines: list[str], begin: int, end: int, place: Place) -> int:
    """The line of a place in the statement between two lines: not its first only for an element of a list."""
    if begin + 1 == end:
        return end
    inline = _at(tomllib.loads("\n".join(lines[begin:end])), place) is not None
    indices = [part for part in (place if inline else place[-1:]) if isinstance(part, int)]
    if not indices:
        return begin + 1
    for stop in range(begin + 1, end):
        try:
            value: object = tomllib.loads("\n".join(lines[begin:stop]) + "\n]")
        except ValueError:
            continue
        while isinstance(value, dict) and value:
            value = next(iter(value.values()))
        if isinstance(value, list) and len(value) > indices[0]:
            return stop
    return end
