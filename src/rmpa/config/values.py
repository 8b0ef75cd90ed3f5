"""The types of values that settings have: how a raw value is read, and what JSON Schema says of it.

A raw value is a string of a command-line option or an environment variable, or a value of a TOML file. A reader
returns the typed value, or raises ``BadValue`` with what is wrong and what to write instead; ``config.read`` adds
where the value was written.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from rmpa.config import limits
from rmpa.core import limits as core_limits
from rmpa.core.identity import peer_name_from, peer_name_problem

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from enum import StrEnum

_T = TypeVar("_T")
_T_co = TypeVar("_T_co", covariant=True)
_Word = TypeVar("_Word", bound="StrEnum")
# A key of the file, or an element below it: ``("contract", 1, "topics", 0)``.
Place = tuple[str | int, ...]
# A JSON Schema (draft 7), or a part of one.
JsonSchema = dict[str, Any]
# Stands for the peer's name in a rule.
PEER: Final = "{peer}"
# A name in the place of ``{peer}``, for checks.
SOME_PEER: Final = "peer"
_BOOLEANS: Final = dict.fromkeys(("1", "true", "yes", "on"), True) | dict.fromkeys(("0", "false", "no", "off"), False)


@dataclass(frozen=True, slots=True)
class ValueType(Generic[_T_co]):
    """A type of values, declared once for all settings that have it.

    Attributes:
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

    Attributes:
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

    folded = {k.lower().replace("-", "_"): k for k in known}
    near = difflib.get_close_matches(word.lower().replace("-", "_"), folded, n=1, cutoff=0.65)
    return folded[near[0]] if near else None


def suggestion(word: str, known: Iterable[str], otherwise: str) -> str:
    """The remedy for a word that is not known: the nearest known one, or else another text."""
    near = did_you_mean(word, known)
    return f"did you mean {near}?" if near else otherwise


def shown(value: object) -> str:
    """A TOML value as errors show it, at most 60 characters long."""
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def text_type(read: Callable[[Any], _T], *examples: str, metavar: str = "") -> ValueType[_T]:
    """A type whose values are texts in TOML."""
    return ValueType(read, {"type": "string", "examples": list(examples)}, metavar)


def read_text(raw: object) -> str:
    """A string that is not empty."""
    if not isinstance(raw, str) or not raw.strip():
        raise BadValue(f"{raw!r} is not a text", "leave it out for the default")
    return raw


def text_like(pattern: str, what: str, remedy: str, *examples: str, metavar: str = "") -> ValueType[str]:
    """A text that a pattern fits as a whole; ``what`` names one with its article, for the text of errors."""

    def read(raw: object) -> str:
        text = read_text(raw).strip()
        if not re.fullmatch(pattern, text):
            raise BadValue(f"{text!r} is not {what}", remedy)
        return text

    return text_type(read, *examples, metavar=metavar)


def _read_name(raw: object) -> str:
    name = read_text(raw)
    if problem := peer_name_problem(name):
        raise BadValue(problem, better=peer_name_from(name))
    return name


TEXT: Final = ValueType(read_text, {"type": "string", "minLength": 1}, "TEXT")
NAME: Final = ValueType(_read_name, {"type": "string", "pattern": "^[A-Za-z][A-Za-z0-9_]*$"}, "NAME")
NAME_OR_EMPTY: Final = ValueType(
    lambda raw: _read_name(raw) if raw != "" else "",
    {"type": "string", "pattern": "^([A-Za-z][A-Za-z0-9_]*)?$"},
    "NAME",
)
# A network interface. It need not exist: interfaces come and go.
INTERFACE: Final = text_like(
    r"[^\s/]{1,15}",
    "the name of a network interface",
    "one looks like wlan0; `ip link` lists them",
    "wlan0",
    metavar="NAME",
)


def word_of(words: Iterable[str], what: str, remedy: str, metavar: str = "") -> ValueType[str]:
    """One of several words, in lower case; texts in upper case are read too.

    Args:
        words: The words.
        what: What one of them is, with its article, for the text of errors.
        remedy: What to do about a wrong one.
        metavar: What ``--help`` shows for it.
    """
    known = list(words)

    def read(raw: object) -> str:
        text = str(raw).strip().lower()
        if text not in known:
            raise BadValue(f"{raw!r} is not {what}", remedy, did_you_mean(text, known))
        return text

    return ValueType(read, {"type": "string", "enum": known}, metavar)


def member_of(kind: type[_Word], what: str) -> ValueType[_Word]:
    """A word of an enumeration; ``what`` names one with its article, for the text of errors."""
    one = word_of([str(word) for word in kind], what, f"it is one of {', '.join(kind)}")
    return ValueType(lambda raw: kind(one.read(raw)), one.json_schema)


def _read_bool(raw: object) -> bool:
    """``true`` or ``false``, also as 1, 0, yes, no, on, off."""
    value = _BOOLEANS.get(str(raw).strip().lower())
    if value is None:
        raise BadValue(f"{raw!r} is neither true nor false")
    return value


def whole_number(low: int, high: int, what: str, metavar: str = "N") -> ValueType[int]:
    """A whole number between two bounds, both allowed; ``what`` names it with its article, for the text of errors."""
    remedy = f"{what} is between {low} and {high}"

    def read(raw: object) -> int:
        text = str(raw).strip()
        # ASCII alone: int() would also take "1_0" and digits of other scripts; nine digits bound its cost.
        if isinstance(raw, bool) or not re.fullmatch(r"-?[0-9]{1,9}", text):
            raise BadValue(f"{raw!r} is not a whole number", remedy)
        if not low <= int(text) <= high:
            raise BadValue(f"{int(text)} is out of range", remedy)
        return int(text)

    return ValueType(read, {"type": "integer", "minimum": low, "maximum": high}, metavar)


BOOL: Final = ValueType(_read_bool, {"type": "boolean"})
DOMAIN: Final = whole_number(0, core_limits.DOMAIN_MAX, "a domain id")
PORT: Final = whole_number(1, 65535, "a port", "PORT")
DSCP: Final = whole_number(0, 63, "a DSCP (the TOS byte / 4; CS6 is 48)")
PACKET_PRIORITY: Final = whole_number(0, 6, "SO_PRIORITY without CAP_NET_ADMIN")
BOUND: Final = whole_number(1, limits.BOUND_MAX, "a limit")

# By unit: so many of it are a second. Dividing by these rounds only once, so that ``"100 ms"`` is exactly 0.1.
_SECONDS: Final = {"us": 1e6, "µs": 1e6, "ms": 1e3, "s": 1.0, "min": 1 / 60, "h": 1 / 3600}
# By unit: so many bytes it is.
_BYTES: Final = {"b": 1, "kb": 1e3, "mb": 1e6, "gb": 1e9, "kib": 1024, "mib": 1024**2} | {
    "kbit": 125,
    "mbit": 125e3,
    "gbit": 125e6,
}
_HUGE: Final = 1 << 63
# ROS 2's own word for a duration without a bound; it lifts the bound that an earlier rule has set.
_INFINITE: Final = "infinite"
# The word for a rate without a bound, likewise.
_UNLIMITED: Final = "unlimited"


def _quantity(raw: object, what: str, example: str, endless: str) -> tuple[float, str]:
    """The number and the unit (in lower case; empty for a plain number); infinite for the word for no bound."""
    if not isinstance(raw, str):
        if isinstance(raw, bool) or not isinstance(raw, int | float) or raw != raw:  # noqa: PLR0124 - NaN
            raise BadValue(f"{shown(raw)} is not {what}", example)
        # A whole number of hundreds of digits has no float; what is out of every range stays so.
        return float(max(-_HUGE, min(raw, _HUGE)) if isinstance(raw, int) else raw), ""
    text = raw.strip().lower()
    match = re.fullmatch(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)\s*([a-zµ]+(?:/s)?)", text)
    if text != endless and not match:
        raise BadValue(f"{raw!r} is not {what}", example)
    return (float(match[1]), match[2]) if match else (math.inf, "")


def _within(raw: object, value: float, low: float, high: float, bounds: str) -> float:
    if not low <= value <= high:
        raise BadValue(f"{shown(raw)} is out of range", bounds)
    return value


def _read_seconds(raw: object, what: str) -> float:
    """A duration in seconds, before its bounds are checked."""
    example = f'{what} is seconds as a number, or a text such as "100 ms"'
    if isinstance(raw, str):
        example += f"; units are {', '.join(_SECONDS)}"
    number, unit = _quantity(raw, "a duration", example, _INFINITE)
    if number and unit == "hz":
        raise BadValue(f"{raw!r} is a rate, not a duration", better=f"{1000 / number:g} ms")
    if unit and unit not in _SECONDS:
        raise BadValue(f"{raw!r} is not a duration", example)
    return number / _SECONDS[unit or "s"]


def read_duration(raw: object, what: str = "a duration") -> float | None:
    """Seconds as a number, or a text such as ``"100 ms"`` or ``"2 s"``; ``"infinite"`` is ``None``.

    Args:
        raw: As written.
        what: What the duration is, with its article, for the text of errors.

    Raises:
        BadValue: It is not a duration, or outside of 1 ms to a day.
    """
    seconds, low, high = _read_seconds(raw, what), core_limits.CONTRACT_TIME_MIN, core_limits.CONTRACT_TIME_MAX
    bounds = f'{what} is between {low:g} and {high:.0f} s; "{_INFINITE}" is none at all'
    return None if seconds == math.inf else _within(raw, seconds, low, high, bounds)


def _read_outage(raw: object) -> float:
    """How long messages are kept for a peer whose link is gone, in seconds; unlike other durations it has an end."""
    low, high = core_limits.OUTAGE_MIN, core_limits.OUTAGE_MAX
    bounds = f"an outage is between {low:g} and {high:.0f} s: messages are not kept for ever"
    return _within(raw, _read_seconds(raw, "an outage"), low, high, bounds)


def _read_timeout(raw: object) -> float:
    """How long a service call may take, in seconds; there is always an end."""
    seconds = read_duration(raw, "a timeout")
    if seconds is None or seconds > limits.SERVICE_TIMEOUT_MAX:
        remedy = f"at most {limits.SERVICE_TIMEOUT_MAX:g} s: an action can say more"
        raise BadValue(f"{raw!r} is too long for a call", remedy)
    return seconds


def read_rate(raw: object) -> float | None:
    """Messages a second as a number, or a text such as ``"10 Hz"``; ``"unlimited"`` is ``None``.

    Raises:
        BadValue: It is not a rate, or outside of the bounds in ``config.limits``.
    """
    example = 'a rate is messages a second as a number, or a text such as "10 Hz"'
    rate, unit = _quantity(raw, "a rate", example, _UNLIMITED)
    if rate and unit in _SECONDS:
        raise BadValue(f"{raw!r} is a duration, not a rate", better=f"{_SECONDS[unit] / rate:g} Hz")
    if unit not in {"", "hz"}:
        raise BadValue(f"{raw!r} is not a rate", example)
    low, high = core_limits.CONTRACT_RATE_MIN, core_limits.CONTRACT_RATE_MAX
    bounds = f'a rate is between {low:g} and {high:.0f} Hz; "{_UNLIMITED}" is none at all'
    return None if rate == math.inf else _within(raw, rate, low, high, bounds)


def read_bytes_a_second(raw: object) -> int | None:
    """Bytes a second as a number, or a text such as ``"100 KB/s"`` or ``"1 Mbit/s"``; ``"unlimited"`` is ``None``.

    Raises:
        BadValue: It is not such a quantity, or outside of the bounds in ``config.limits``.
    """
    what = "a number of bytes a second"
    example = 'a size is bytes a second as a number, or a text such as "100 KB/s" or "1 Mbit/s"'
    number, unit = _quantity(raw, what, example, _UNLIMITED)
    factor = _BYTES.get(unit.removesuffix("/s") or "b")
    if factor is None:
        raise BadValue(f"{raw!r} is not {what}", example)
    high = limits.GATEWAY_BYTES_MAX
    bounds = f'a size is between 1 and {high:,} bytes a second; "{_UNLIMITED}" is none at all'
    return None if number == math.inf else int(_within(raw, number * factor, 1, high, bounds))


def _number_or_text(*examples: object) -> JsonSchema:
    # Without "type": the reader's own error about a wrong type says more than that of config.read.
    return {"anyOf": [{"type": "number"}, {"type": "string"}], "examples": list(examples)}


def duration_of(what: str) -> ValueType[float | None]:
    """A duration that may be infinite; ``what`` names it with its article, for the text of errors."""
    return ValueType(lambda raw: read_duration(raw, what), _number_or_text(0.5, "100 ms", _INFINITE))


OUTAGE: Final = ValueType(_read_outage, _number_or_text(30, "5 min"))
TIMEOUT: Final = ValueType(_read_timeout, _number_or_text(60, "5 min"))
RATE: Final = ValueType(read_rate, _number_or_text(10, "10 Hz", _UNLIMITED))
BYTES_A_SECOND: Final = ValueType(
    read_bytes_a_second, _number_or_text(125_000, "100 KB/s", "1 Mbit/s", _UNLIMITED), "RATE"
)


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
    """The IPv4 multicast group of the beacons and its port before the domain is added, or none of it."""

    enabled: bool = True
    group: str = limits.MULTICAST_GROUP
    port: int = limits.MULTICAST_PORT

    def __str__(self) -> str:
        """``group:port``, or ``false``."""
        return f"{self.group}:{self.port}" if self.enabled else "false"


def _read_host(raw: object) -> str:
    """A host name or a numeric IPv4 address."""
    host = read_text(raw).strip()
    if ":" in host:
        raise BadValue(
            f"{host!r} is not an IPv4 address or a host name", "IPv6 is not supported, and no port goes here"
        )
    if re.fullmatch("[0-9.]+", host):
        try:
            return str(IPv4Address(host))
        except AddressValueError:
            raise BadValue(f"{host!r} is not an IPv4 address", "one looks like 192.168.1.20") from None
    if not re.fullmatch(r"(?=.{1,253}\Z)[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?", host):
        raise BadValue(f"{host!r} is not a host name")
    return host


def _read_host_port(raw: object) -> HostPort:
    """``HOST:PORT``, or ``HOST`` alone (port 0)."""
    text = read_text(raw).strip()
    host, colon, port = text.rpartition(":")
    if not colon:
        return HostPort(_read_host(text))
    if not host or ":" in host:
        raise BadValue(f"{text!r} is not HOST:PORT", "an example: 192.168.1.20:40001; IPv6 is not supported")
    try:
        return HostPort(_read_host(host), PORT.read(port))
    except BadValue as error:
        raise BadValue(f"{text!r} is not HOST:PORT: {error.problem}", error.remedy) from None


def _read_master_uri(raw: object) -> str:
    text = read_text(raw).strip()
    pattern = r"http://([^\s/:\[\]]+):([0-9]{1,5})/?"
    match = re.fullmatch(pattern, text)
    if match is None:
        better = f"http://{text.rstrip('/')}/" if re.fullmatch(pattern, f"http://{text}") else None
        raise BadValue(f"{raw!r} is not a master's URI", "one looks like http://localhost:11311/", better)
    _read_host(match[1])
    PORT.read(match[2])
    return text


def _read_multicast(raw: object) -> Multicast:
    """``GROUP:PORT`` or ``GROUP``; false (off) for none, true (on) for the default one."""
    if isinstance(raw, bool):
        return Multicast(raw)
    text = read_text(raw).strip()
    if text not in {"0", "1"} and text.lower() in _BOOLEANS:
        return Multicast(_BOOLEANS[text.lower()])
    host, colon, port = text.partition(":")
    try:
        group = IPv4Address(host)
    except AddressValueError:
        example = f"GROUP:PORT looks like {Multicast()}; off sends no multicast"
        raise BadValue(f"{host!r} is not an IPv4 multicast group", example) from None
    if not group.is_multicast:
        raise BadValue(f"{host} is not a multicast group", "groups are 224.0.0.0 to 239.255.255.255")
    try:
        return Multicast(True, str(group), PORT.read(port) if colon else limits.MULTICAST_PORT)
    except BadValue as error:
        raise BadValue(f"{text!r} is not GROUP:PORT: {error.problem}", error.remedy) from None


HOST: Final = text_type(_read_host, "127.0.0.1", "0.0.0.0", metavar="HOST")  # noqa: S104 - shown
HOST_PORT: Final = text_type(_read_host_port, "10.8.0.5:40001", metavar="HOST:PORT")
MASTER_URI: Final = text_type(_read_master_uri, "http://localhost:11311/", metavar="URI")
MULTICAST: Final = ValueType(_read_multicast, {"type": ["boolean", "string"]}, "GROUP:PORT")


def glob_over(what: str, *examples: str) -> ValueType[str]:
    """A glob over ROS names (``core.identity.matches``) of one kind; ``{peer}`` is allowed if an example has it."""
    with_peer = any(PEER in example for example in examples)

    def read(raw: object) -> str:
        glob = read_text(raw).strip()
        checked = glob.replace(PEER, SOME_PEER) if with_peer else glob
        if not re.fullmatch("[A-Za-z0-9_/*?]+", checked):
            remedy = f"a {what} has letters, digits, _ and /; globs add *, ** and ?"
            raise BadValue(f"{glob!r} is not a glob over {what}s", remedy)
        for mistake in ("//", "***"):
            if mistake in checked:
                raise BadValue(f"{glob!r} matches no {what}: it has {mistake} in it")
        if not checked.startswith(("/", "**")):
            raise BadValue(f"{glob!r} matches no {what}: {what}s begin with /", better=f"/{glob}")
        return glob

    return text_type(read, *examples, metavar="GLOB")


def _read_type_glob(raw: object) -> str:
    glob = read_text(raw).strip()
    if not re.fullmatch("[A-Za-z0-9_*?]+(/[A-Za-z0-9_*?]*)?", glob):
        remedy = "types look like sensor_msgs/Image or sensor_msgs/*"
        raise BadValue(f"{glob!r} is not a glob over message types", remedy)
    if "/" not in glob and "**" not in glob:
        raise BadValue(f"{glob!r} matches no message type: types have a package in front", better=f"*/{glob}")
    return glob


TOPIC_GLOB: Final = glob_over("topic", "/camera/**")
TYPE_GLOB: Final = text_type(_read_type_glob, "sensor_msgs/*", metavar="GLOB")
PEER_GLOB: Final = text_like(
    r"(?!.*\*\*)[A-Za-z0-9_*?]+",
    "a glob over peers' names",
    "such as robot1, robot* or robot?; * is every peer",
    "robot*",
    metavar="GLOB",
)
SERVICE_GLOB: Final = glob_over("service", "/**")
NODE_GLOB: Final = glob_over("node", "/**")
PARAM_GLOB: Final = glob_over("parameter", "/**")


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
            value = read_at(index, item.read, element)
            if value in found:
                raise BadValue(f"{element!r} is there twice", "delete one of them", at=(index,))
            found.append(value)
        if if_empty and not found:
            raise BadValue("an empty list fits nothing", if_empty)
        return tuple(found)

    schema = {"type": "array", "items": item.json_schema, "uniqueItems": True} | ({"minItems": 1} if if_empty else {})
    return ValueType(read, schema, item.metavar)


def read_at(part: str | int, read: Callable[[Any], _T], raw: object) -> _T:
    """Read a part of a setting; a ``BadValue`` gets the part's key or index in front of its own place."""
    try:
        return read(raw)
    except BadValue as error:
        error.at = (part, *error.at)
        raise
