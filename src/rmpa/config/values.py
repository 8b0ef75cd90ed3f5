"""Reads one setting from what a user wrote: a string of a flag or variable, or a value of a TOML file.

Each reader takes the raw value and returns the typed one, or raises ``BadValue`` with what is wrong and what to
write instead; where it was written is added by ``config.sources``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.config import limits
from rmpa.config.settings import HostPort
from rmpa.core import limits as core_limits
from rmpa.core.identity import peer_name_from, peer_name_problem

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

_T = TypeVar("_T")

LOG_LEVELS: Final = ("debug", "info", "warning", "error")
CORE_MODES: Final = ("embedded", "external")
_MASTER: Final = re.compile(r"http://(?P<host>[^\s/:\[\]]+):(?P<port>[0-9]{1,5})/?")
_HOST: Final = re.compile(r"(?=.{1,253}\Z)[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?")
_NUMERIC: Final = re.compile(r"[0-9.]+")
_TOPIC_GLOB: Final = re.compile(r"[A-Za-z0-9_/*?]+")
_INTERFACE: Final = re.compile(r"[^\s/]{1,15}")
_WORDS: Final = {
    "1": True,
    "true": True,
    "yes": True,
    "on": True,
    "0": False,
    "false": False,
    "no": False,
    "off": False,
}


@dataclass
class BadValue(ValueError):  # noqa: N818 - it becomes a ConfigError, which is the error
    """A value cannot be used.

    Args:
        problem: What is wrong with it.
        remedy: What to do, as a sentence part; may be empty.
        better: The value that was probably meant, if there is one.
        at: What inside of the setting it is about: the index of a list's element, a key of a table, both.
    """

    problem: str
    remedy: str = ""
    better: str | None = None
    at: tuple[str | int, ...] = ()

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


def read_text(raw: object) -> str:
    """A string that is not empty."""
    if not isinstance(raw, str) or not raw.strip():
        raise BadValue(f"{raw!r} is not a text", "leave it out for the default")
    return raw


def read_name(raw: object) -> str:
    """A peer's name; the nearest valid one is offered for an invalid one."""
    name = read_text(raw)
    if problem := peer_name_problem(name):
        raise BadValue(problem, better=peer_name_from(name))
    return name


def read_name_or_none(raw: object) -> str:
    """A peer's name, or an empty text for none."""
    return read_name(raw) if raw != "" else ""


def read_bool(raw: object) -> bool:
    """``true`` or ``false``, also as 1, 0, yes, no, on, off."""
    if isinstance(raw, bool):
        return raw
    value = _WORDS.get(str(raw).strip().lower())
    if value is None:
        raise BadValue(f"{raw!r} is neither true nor false")
    return value


def read_whole(raw: object, low: int, high: int, what: str) -> int:
    """A whole number between two bounds; ``what`` names it with its article, for the text of errors."""
    text = str(raw).strip()
    # ASCII alone: int() would also take "1_0" and digits of other scripts; nine digits bound its cost.
    if isinstance(raw, bool) or not re.fullmatch(r"-?[0-9]{1,9}", text):
        raise BadValue(f"{raw!r} is not a whole number", f"{what} is between {low} and {high}")
    value = int(text)
    if not low <= value <= high:
        raise BadValue(f"{value} is out of range", f"{what} is between {low} and {high}")
    return value


def read_domain(raw: object) -> int:
    """A domain id."""
    return read_whole(raw, 0, core_limits.DOMAIN_MAX, "a domain id")


def read_port(raw: object) -> int:
    """A TCP or UDP port that can be named."""
    return read_whole(raw, 1, 65535, "a port")


def read_port_or_any(raw: object) -> int:
    """A port, or 0: the system chooses one."""
    return read_whole(raw, 0, 65535, "a port (0: any)")


def read_dscp(raw: object) -> int:
    """A DSCP, the upper six bits of IP's TOS."""
    return read_whole(raw, 0, 63, "a DSCP (the TOS byte / 4; CS6 is 48)")


def read_packet_priority(raw: object) -> int:
    """An SO_PRIORITY that a user may set."""
    return read_whole(raw, 0, 6, "SO_PRIORITY without CAP_NET_ADMIN")


def read_realtime_priority(raw: object) -> int:
    """A priority of SCHED_FIFO."""
    return read_whole(raw, 1, 99, "a priority of SCHED_FIFO")


def read_cpu(raw: object) -> int:
    """The number of a CPU; whether it is there is only known while running."""
    return read_whole(raw, 0, limits.CPU_MAX, "the number of a CPU")


def read_bound(raw: object) -> int:
    """How many of something one peer may have."""
    return read_whole(raw, 1, limits.BOUND_MAX, "a limit")


def read_level(raw: object) -> str:
    """A log level."""
    text = str(raw).strip().lower()
    if text not in LOG_LEVELS:
        remedy = f"the levels are {', '.join(LOG_LEVELS)}"
        raise BadValue(f"{raw!r} is not a log level", remedy, did_you_mean(text, LOG_LEVELS))
    return text


def read_core_mode(raw: object) -> str:
    """Which ROS core the agent works with."""
    text = str(raw).strip().lower()
    if text not in CORE_MODES:
        remedy = "embedded: the agent's own; external: a roscore that runs already"
        raise BadValue(f"{raw!r} is not a kind of core", remedy, did_you_mean(text, CORE_MODES))
    return text


def read_master_uri(raw: object) -> str:
    """The URI of a ROS master."""
    text = read_text(raw).strip()
    match = _MASTER.fullmatch(text)
    if match is None:
        better = f"http://{text.rstrip('/')}/" if _MASTER.fullmatch(f"http://{text}") else None
        raise BadValue(f"{raw!r} is not a master's URI", "one looks like http://localhost:11311/", better)
    read_host(match["host"])
    read_port(match["port"])
    return text


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
        return HostPort(read_host(host), read_port(port))
    except BadValue as error:
        raise BadValue(f"{text!r} is not HOST:PORT: {error.problem}", error.remedy) from None


def read_interface(raw: object) -> str:
    """The name of a network interface, such as ``wlan0``; whether it exists is only known while running."""
    name = read_text(raw).strip()
    if not _INTERFACE.fullmatch(name):
        raise BadValue(
            f"{name!r} is not the name of a network interface", "one looks like wlan0; `ip link` lists them"
        )
    return name


@dataclass(frozen=True, slots=True)
class Multicast:
    """Where beacons go: whether to a group at all, and which group and port (before the domain is added)."""

    enabled: bool = True
    group: str = limits.MULTICAST_GROUP
    port: int = limits.MULTICAST_PORT


def read_multicast(raw: object) -> Multicast:
    """``GROUP:PORT`` or ``GROUP``; false (off) for none, true (on) for the default one."""
    if isinstance(raw, bool):
        return Multicast(raw)
    text = read_text(raw).strip()
    if text.lower() in {"off", "false", "no", "on", "true", "yes"}:
        return Multicast(_WORDS[text.lower()])
    example = f"GROUP:PORT looks like {limits.MULTICAST_GROUP}:{limits.MULTICAST_PORT}; off sends no multicast"
    host, colon, port = text.partition(":")
    try:
        group = IPv4Address(host)
    except AddressValueError:
        raise BadValue(f"{host!r} is not an IPv4 multicast group", example) from None
    if not group.is_multicast:
        raise BadValue(f"{host} is not a multicast group", "groups are 224.0.0.0 to 239.255.255.255")
    try:
        return Multicast(True, str(group), read_port(port) if colon else limits.MULTICAST_PORT)
    except BadValue as error:
        raise BadValue(f"{text!r} is not GROUP:PORT: {error.problem}", error.remedy) from None


def read_topic_glob(raw: object) -> str:
    """A glob over topics, as ``core.names.matches`` reads it."""
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


def read_list(raw: object, item: Callable[[object], _T]) -> tuple[_T, ...]:
    """A list whose elements ``item`` reads; a string is split at ``;`` and ``,``. Nothing may stand there twice."""
    if isinstance(raw, str):
        raw = [part.strip() for part in re.split("[;,]", raw) if part.strip()]
    if not isinstance(raw, list | tuple):
        raise BadValue(f"{raw!r} is not a list")
    found: list[_T] = []
    for index, element in enumerate(raw):
        try:
            value = item(element)
        except BadValue as error:
            error.at = (index, *error.at)
            raise
        if value in found:
            raise BadValue(f"{element!r} stands there twice", "delete one of them", at=(index,))
        found.append(value)
    return tuple(found)
