"""The types of values that settings have: how a raw value is read, and what JSON Schema says of it.

A raw value is a string of a command-line option or an environment variable, or a value of a TOML file. A reader
returns the typed value, or raises ``BadValue`` with what is wrong and what to write instead; ``config.read`` adds
where the value was written.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from rmpa.config import limits
from rmpa.core import limits as core_limits
from rmpa.core.contract import Transport
from rmpa.core.identity import peer_name_from, peer_name_problem

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from enum import StrEnum

_T = TypeVar("_T")
_T_co = TypeVar("_T_co", covariant=True)
_Word = TypeVar("_Word", bound="StrEnum")
Place = tuple[str | int, ...]
"""A key of the file, or an element below it: ``("contract", 1, "topics", 0)``."""
JsonSchema = dict[str, Any]
"""A JSON Schema (draft 7), or a part of one."""

_LOG_LEVELS: Final = ("debug", "info", "warning", "error")
_CORE_MODES: Final = ("embedded", "external")
_CORE_KEEPS: Final = ("auto", "always", "never")
_MASTER: Final = re.compile(r"http://(?P<host>[^\s/:\[\]]+):(?P<port>[0-9]{1,5})/?")
_HOST: Final = re.compile(r"(?=.{1,253}\Z)[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?")
_NUMERIC: Final = re.compile(r"[0-9.]+")
_TOPIC_GLOB: Final = re.compile(r"[A-Za-z0-9_/*?]+")
_PEER_GLOB: Final = re.compile(r"[A-Za-z0-9_*?]+")
_INTERFACE: Final = re.compile(r"[^\s/]{1,15}")
_BOOLEANS: Final = {
    "1": True,
    "true": True,
    "yes": True,
    "on": True,
    "0": False,
    "false": False,
    "no": False,
    "off": False,
}


@dataclass(frozen=True, slots=True)
class ValueType(Generic[_T_co]):
    """A type of values, declared once for all settings that have it.

    Args:
        read: Reads a raw value; raises ``BadValue``.
        json_schema: What a value may be in TOML. ``config.read`` checks the ``type`` in it before ``read`` is called.
        metavar: What ``--help`` shows for the value of an option.
    """

    read: Callable[[Any], _T_co]
    json_schema: JsonSchema
    metavar: str = ""


@dataclass
class BadValue(ValueError):  # noqa: N818 - it becomes a ConfigError, which is the error
    """A value cannot be used.

    Args:
        problem: What is wrong with it.
        remedy: What to do, as a sentence part; may be empty.
        better: The value that was probably meant, if there is one.
        at: The part of the setting that is wrong: the index of a list's element, a key of a table, or both.
    """

    problem: str
    remedy: str = ""
    better: str | None = None
    at: Place = ()

    def __str__(self) -> str:
        """The problem alone."""
        return self.problem


def did_you_mean(word: str, known: Iterable[str]) -> str | None:
    """The known word that is nearest to a misspelt one, or ``None`` where none is near."""
    import difflib  # noqa: PLC0415 - only errors need it

    known = list(known)
    folded = {k.lower().replace("-", "_"): k for k in known}
    near = difflib.get_close_matches(word.lower().replace("-", "_"), folded, n=1, cutoff=0.6)
    return folded[near[0]] if near else None


def shown(value: object) -> str:
    """A TOML value as errors show it, at most 60 characters long."""
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


# --- texts and names ------------------------------------------------------------------------------------------------


def read_text(raw: object) -> str:
    """A string that is not empty."""
    if not isinstance(raw, str) or not raw.strip():
        raise BadValue(f"{raw!r} is not a text", "leave it out for the default")
    return raw


def read_name(raw: object) -> str:
    """A peer's name; the error for an invalid one offers the nearest valid one."""
    name = read_text(raw)
    if problem := peer_name_problem(name):
        raise BadValue(problem, better=peer_name_from(name))
    return name


def read_interface(raw: object) -> str:
    """The name of a network interface, such as ``wlan0``. It need not exist: interfaces come and go."""
    name = read_text(raw).strip()
    if not _INTERFACE.fullmatch(name):
        raise BadValue(
            f"{name!r} is not the name of a network interface", "one looks like wlan0; `ip link` lists them"
        )
    return name


TEXT: Final = ValueType(read_text, {"type": "string", "minLength": 1}, "TEXT")
NAME: Final = ValueType(read_name, {"type": "string", "pattern": "^[A-Za-z][A-Za-z0-9_]*$"}, "NAME")
NAME_OR_EMPTY: Final = ValueType(
    lambda raw: read_name(raw) if raw != "" else "",
    {"type": "string", "pattern": "^([A-Za-z][A-Za-z0-9_]*)?$"},
    "NAME",
)
INTERFACE: Final = ValueType(read_interface, {"type": "string", "examples": ["wlan0"]}, "NAME")


def word_of(known: Iterable[str], what: str, remedy: str, metavar: str) -> ValueType[str]:
    """One of several words, in lower case; texts in upper case are read too.

    Args:
        known: The words.
        what: What one of them is, with its article, for the text of errors.
        remedy: What to do about a wrong one.
        metavar: What ``--help`` shows for it.
    """
    words = list(known)

    def read(raw: object) -> str:
        text = str(raw).strip().lower()
        if text not in words:
            raise BadValue(f"{raw!r} is not {what}", remedy, did_you_mean(text, words))
        return text

    return ValueType(read, {"type": "string", "enum": words}, metavar)


LOG_LEVEL: Final = word_of(_LOG_LEVELS, "a log level", f"the levels are {', '.join(_LOG_LEVELS)}", "LEVEL")
CORE_KEEP: Final = word_of(
    _CORE_KEEPS,
    "a choice",
    "auto: if a node of the run before still runs, or the core died; always; never: begin empty, as roscore does",
    "WHEN",
)
CORE_MODE: Final = word_of(
    _CORE_MODES, "a kind of core", "embedded: the agent's own; external: a roscore that runs already", "MODE"
)


def member_of(kind: type[_Word], what: str) -> ValueType[_Word]:
    """A word of an enumeration; ``what`` names one with its article, for the text of errors."""
    words = [word.value for word in kind]
    one = word_of(words, what, f"it is one of {', '.join(words)}", "")
    return ValueType(lambda raw: kind(one.read(raw)), one.json_schema)


TRANSPORT: Final = member_of(Transport, "a transport")

# --- switches and numbers -------------------------------------------------------------------------------------------


def read_bool(raw: object) -> bool:
    """``true`` or ``false``, also as 1, 0, yes, no, on, off."""
    if isinstance(raw, bool):
        return raw
    value = _BOOLEANS.get(str(raw).strip().lower())
    if value is None:
        raise BadValue(f"{raw!r} is neither true nor false")
    return value


def whole_number(low: int, high: int, what: str, metavar: str = "N") -> ValueType[int]:
    """A whole number between two bounds, both allowed; ``what`` names it with its article, for the text of errors."""

    def read(raw: object) -> int:
        text = str(raw).strip()
        # ASCII alone: int() would also take "1_0" and digits of other scripts; nine digits bound its cost.
        if isinstance(raw, bool) or not re.fullmatch(r"-?[0-9]{1,9}", text):
            raise BadValue(f"{raw!r} is not a whole number", f"{what} is between {low} and {high}")
        value = int(text)
        if not low <= value <= high:
            raise BadValue(f"{value} is out of range", f"{what} is between {low} and {high}")
        return value

    return ValueType(read, {"type": "integer", "minimum": low, "maximum": high}, metavar)


BOOL: Final = ValueType(read_bool, {"type": "boolean"})
DOMAIN: Final = whole_number(0, core_limits.DOMAIN_MAX, "a domain id")
PORT: Final = whole_number(1, 65535, "a port", "PORT")
COMMAND_AGE: Final = whole_number(0, 60_000, "milliseconds (0: any age)", "MS")
PORT_OR_ANY: Final = whole_number(0, 65535, "a port (0: any)", "PORT")
DSCP: Final = whole_number(0, 63, "a DSCP (the TOS byte / 4; CS6 is 48)")
PACKET_PRIORITY: Final = whole_number(0, 6, "SO_PRIORITY without CAP_NET_ADMIN")
FIFO_PRIORITY: Final = whole_number(1, 99, "a priority of SCHED_FIFO")
BOUND: Final = whole_number(1, limits.BOUND_MAX, "a limit")

# --- addresses ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class HostPort:
    """An address as a user writes it: a host (name or number) and a port; 0 where none was given."""

    host: str
    port: int = 0

    def __str__(self) -> str:
        """``host:port`` or ``host``."""
        return f"{self.host}:{self.port}" if self.port else self.host


@dataclass(frozen=True, slots=True)
class Multicast:
    """The multicast of the beacons.

    Args:
        enabled: Whether beacons are sent to the group at all.
        group: The IPv4 multicast group.
        port: Its port, before the domain is added.
    """

    enabled: bool = True
    group: str = limits.MULTICAST_GROUP
    port: int = limits.MULTICAST_PORT

    def __str__(self) -> str:
        """``group:port``, or ``false``."""
        return f"{self.group}:{self.port}" if self.enabled else "false"


def read_host(raw: object) -> str:
    """A host name or a numeric IPv4 address."""
    host = read_text(raw).strip()
    if ":" in host:
        raise BadValue(
            f"{host!r} is not an IPv4 address or a host name", "IPv6 is not supported, and no port goes here"
        )
    if _NUMERIC.fullmatch(host):
        try:
            return str(IPv4Address(host))
        except AddressValueError:
            raise BadValue(f"{host!r} is not an IPv4 address", "one looks like 192.168.1.20") from None
    if not _HOST.fullmatch(host):
        raise BadValue(f"{host!r} is not a host name")
    return host


def read_host_port(raw: object) -> HostPort:
    """``HOST:PORT``, or ``HOST`` alone (port 0)."""
    text = read_text(raw).strip()
    host, colon, port = text.rpartition(":")
    if not colon:
        return HostPort(read_host(text))
    if not host or ":" in host:
        raise BadValue(f"{text!r} is not HOST:PORT", "an example: 192.168.1.20:40001; IPv6 is not supported")
    try:
        return HostPort(read_host(host), PORT.read(port))
    except BadValue as error:
        raise BadValue(f"{text!r} is not HOST:PORT: {error.problem}", error.remedy) from None


def read_master_uri(raw: object) -> str:
    """The URI of a ROS master."""
    text = read_text(raw).strip()
    match = _MASTER.fullmatch(text)
    if match is None:
        better = f"http://{text.rstrip('/')}/" if _MASTER.fullmatch(f"http://{text}") else None
        raise BadValue(f"{raw!r} is not a master's URI", "one looks like http://localhost:11311/", better)
    read_host(match["host"])
    PORT.read(match["port"])
    return text


def read_multicast(raw: object) -> Multicast:
    """``GROUP:PORT`` or ``GROUP``; false (off) for none, true (on) for the default one."""
    if isinstance(raw, bool):
        return Multicast(raw)
    text = read_text(raw).strip()
    if text not in {"0", "1"} and text.lower() in _BOOLEANS:
        return Multicast(_BOOLEANS[text.lower()])
    example = f"GROUP:PORT looks like {limits.MULTICAST_GROUP}:{limits.MULTICAST_PORT}; off sends no multicast"
    host, colon, port = text.partition(":")
    try:
        group = IPv4Address(host)
    except AddressValueError:
        raise BadValue(f"{host!r} is not an IPv4 multicast group", example) from None
    if not group.is_multicast:
        raise BadValue(f"{host} is not a multicast group", "groups are 224.0.0.0 to 239.255.255.255")
    try:
        return Multicast(True, str(group), PORT.read(port) if colon else limits.MULTICAST_PORT)
    except BadValue as error:
        raise BadValue(f"{text!r} is not GROUP:PORT: {error.problem}", error.remedy) from None


HOST: Final = ValueType(read_host, {"type": "string", "examples": ["127.0.0.1", "0.0.0.0"]}, "HOST")  # noqa: S104 - shown
HOST_PORT: Final = ValueType(read_host_port, {"type": "string", "examples": ["10.8.0.5:40001"]}, "HOST:PORT")
MASTER_URI: Final = ValueType(read_master_uri, {"type": "string", "examples": ["http://localhost:11311/"]}, "URI")
MULTICAST: Final = ValueType(read_multicast, {"type": ["boolean", "string"]}, "GROUP:PORT")

# --- globs ----------------------------------------------------------------------------------------------------------


def read_topic_glob(raw: object) -> str:
    """A glob over topics, as ``core.identity.matches`` reads it."""
    glob = read_text(raw).strip()
    if not _TOPIC_GLOB.fullmatch(glob):
        raise BadValue(
            f"{glob!r} is not a glob over topics", "a topic has letters, digits, _ and /; globs add *, ** and ?"
        )
    if "//" in glob or "***" in glob:
        raise BadValue(f"{glob!r} matches no topic: it has {'//' if '//' in glob else '***'} in it")
    if not glob.startswith(("/", "**")):
        raise BadValue(f"{glob!r} matches no topic: topics begin with /", better=f"/{glob}")
    return glob


def read_type_glob(raw: object) -> str:
    """A glob over message types."""
    glob = read_text(raw).strip()
    if not _TOPIC_GLOB.fullmatch(glob) or glob.startswith("/") or glob.count("/") > 1:
        raise BadValue(
            f"{glob!r} is not a glob over message types", "types look like sensor_msgs/Image or sensor_msgs/*"
        )
    if "/" not in glob and "**" not in glob:
        raise BadValue(f"{glob!r} matches no message type: types have a package in front", better=f"*/{glob}")
    return glob


def read_peer_glob(raw: object) -> str:
    """A glob over peers' names."""
    glob = read_text(raw).strip()
    if not _PEER_GLOB.fullmatch(glob) or "**" in glob:
        raise BadValue(
            f"{glob!r} is not a glob over peers' names", "such as robot1, robot* or robot?; * is every peer"
        )
    return glob


def _glob_over(what: str) -> ValueType[str]:
    """A glob over other ROS names than topics; the errors name what it is for."""

    def read(raw: object) -> str:
        try:
            return read_topic_glob(raw)
        except BadValue as error:
            problem, remedy = (text.replace("topic", what) for text in (error.problem, error.remedy))
            raise BadValue(problem, remedy, error.better) from None

    return ValueType(read, {"type": "string", "examples": ["/**"]}, "GLOB")


TOPIC_GLOB: Final = ValueType(read_topic_glob, {"type": "string", "examples": ["/camera/**"]}, "GLOB")
TYPE_GLOB: Final = ValueType(read_type_glob, {"type": "string", "examples": ["sensor_msgs/*"]}, "GLOB")
PEER_GLOB: Final = ValueType(read_peer_glob, {"type": "string", "examples": ["robot*"]}, "GLOB")
SERVICE_GLOB: Final = _glob_over("service")
NODE_GLOB: Final = _glob_over("node")
PARAM_GLOB: Final = _glob_over("parameter")

# --- lists and tables -----------------------------------------------------------------------------------------------


def list_of(item: ValueType[_T], *, if_empty: str = "") -> ValueType[tuple[_T, ...]]:
    """A list without duplicates; a string is split at ``;`` and ``,``.

    Args:
        item: The type of its elements.
        if_empty: What to do about an empty list, where there must be elements.
    """

    def read(raw: object) -> tuple[_T, ...]:
        if isinstance(raw, str):
            raw = [part.strip() for part in re.split("[;,]", raw) if part.strip()]
        if not isinstance(raw, list | tuple):
            raise BadValue(f"{raw!r} is not a list")
        found: list[_T] = []
        for index, element in enumerate(raw):
            value = read_at((index,), item.read, element)
            if value in found:
                raise BadValue(f"{element!r} stands there twice", "delete one of them", at=(index,))
            found.append(value)
        if if_empty and not found:
            raise BadValue("an empty list fits nothing", if_empty)
        return tuple(found)

    schema = {"type": "array", "items": item.json_schema, "uniqueItems": True} | ({"minItems": 1} if if_empty else {})
    return ValueType(read, schema, item.metavar)


def read_at(place: Place, read: Callable[[Any], _T], raw: object) -> _T:
    """Read a part of a setting; a ``BadValue`` gets the place of the part in front of its own."""
    try:
        return read(raw)
    except BadValue as error:
        error.at = (*place, *error.at)
        raise


@dataclass(frozen=True, slots=True)
class RuleKey:
    """One key of the tables of a list such as ``[[contract]]``.

    Args:
        name: As it is written in the file.
        type: The type of its value.
        help: What it says, for the documentation and for editors.
        required: Whether each table must have it.
    """

    name: str
    type: ValueType[object]
    help: str
    required: bool = False


def read_keys(table: Mapping[str, object], keys: Iterable[RuleKey], example: str = "") -> dict[str, Any]:
    """The values of a table's keys, by name; keys that are missing are left out.

    Args:
        table: As written; ``config.read`` has checked the names of its keys.
        keys: Those that are known.
        example: What a complete table has, for the error about a required key that is missing.
    """
    for key in keys:
        if key.required and key.name not in table:
            raise BadValue(f"a rule without {key.name}", example)
    return {key.name: read_at((key.name,), key.type.read, table[key.name]) for key in keys if key.name in table}


def tables_of(
    keys: Iterable[RuleKey], read_table: Callable[[Any], _T], most: int = 0, instead: str = ""
) -> ValueType[tuple[_T, ...]]:
    """A list of tables (``[[contract]]``); errors name the table's index.

    Args:
        keys: The keys that each table may have.
        read_table: Reads one table.
        most: How many there may be; 0: any number.
        instead: What to do about more.
    """

    def read(raw: object) -> tuple[_T, ...]:
        if not isinstance(raw, list | tuple):
            raise BadValue(f"{shown(raw)} is not a list")
        if most and len(raw) > most:
            raise BadValue(f"{len(raw)} rules", f"at most {most}; {instead}")
        return tuple(read_at((index,), read_table, table) for index, table in enumerate(raw))

    return ValueType(read, {"type": "array", "items": table_schema(keys)})


def table_schema(keys: Iterable[RuleKey]) -> JsonSchema:
    """The JSON Schema of a table with these keys."""
    keys = tuple(keys)
    schema: JsonSchema = {
        "type": "object",
        "additionalProperties": False,
        "properties": {key.name: key.type.json_schema | {"description": key.help} for key in keys},
    }
    required = [key.name for key in keys if key.required]
    return schema | ({"required": required} if required else {})
