"""The identity of a peer: GUID, names, and serial numbers that wrap.

The identity of a peer, as in beacons and in the mesh's handshake.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from ipaddress import IPv4Address
from typing import TYPE_CHECKING, Final

from rmpa.core import limits
from rmpa.core.limits import UINT32_MAX

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable


# The GUID of what a gateway reaches outside the mesh: it is well-formed, but no module can have this address.
OUTSIDE_GUID: Final = "0.0.0.0:0#1"


# GUIDs. They identify a peer, and decide which of two peers dials (paper, section 4.2).


_TEXT: Final = re.compile(r"(?P<ip>[0-9.]+):(?P<port>[0-9]+)(?:#(?P<incarnation>[0-9]+))?")

_LOOPBACK: Final = 127
_MULTICAST: Final = 224


@dataclass(frozen=True, slots=True, order=True)
class Guid:
    """A 64-bit global unique identifier, ordered as an unsigned integer.

    The high 32 bits are the IPv4 address, the next 16 the mesh port, as in the paper; the low 16, which the
    paper leaves free, count incarnations, which distinguishes a restarted peer from its former run.

    Args:
        value: The 64 bits.

    Raises:
        ValueError: ``value`` does not fit in 64 bits.
    """

    value: int

    def __post_init__(self) -> None:
        if not 0 <= self.value < 1 << 64:
            raise ValueError(f"a GUID has 64 bits, not {self.value:#x}")

    @classmethod
    def of(cls, address: IPv4Address | str, port: int, incarnation: int = 0) -> Guid:
        """Join the three parts; ``port`` and ``incarnation`` are 16-bit numbers.

        Raises:
            ValueError: A part is out of its range.
        """
        if not (0 <= port < 1 << 16 and 0 <= incarnation < 1 << 16):
            raise ValueError(f"a port and an incarnation have 16 bits each, not {port} and {incarnation}")
        return cls(int(IPv4Address(address)) << 32 | port << 16 | incarnation)

    @classmethod
    def parse(cls, text: str) -> Guid:
        """Read the form that ``str`` writes, ``10.0.0.1:40001#7``; without ``#7`` the incarnation is 0.

        Raises:
            ValueError: The text is not a GUID.
        """
        match = _TEXT.fullmatch(text)
        if match is None:
            raise ValueError(f"{text!r} is not a GUID; one looks like 10.0.0.1:40001#7")
        return cls.of(match["ip"], int(match["port"]), int(match["incarnation"] or 0))

    @property
    def address(self) -> IPv4Address:
        """The IPv4 address in the high 32 bits."""
        return IPv4Address(self.value >> 32)

    @property
    def port(self) -> int:
        """The mesh port: TCP for links, UDP for unicast beacons."""
        return self.value >> 16 & 0xFFFF

    @property
    def incarnation(self) -> int:
        """The low 16 bits."""
        return self.value & 0xFFFF

    @property
    def endpoint(self) -> tuple[str, int]:
        """``(address, port)`` as sockets want it; shared by all incarnations of one peer."""
        high = self.value >> 32
        return f"{high >> 24}.{high >> 16 & 255}.{high >> 8 & 255}.{high & 255}", self.port

    @property
    def place(self) -> int:
        """Address and port as one number, in GUID order: all incarnations of one peer share it."""
        return self.value >> 16

    @property
    def dialable(self) -> bool:
        """Whether a single peer can be reached at its address; see the function ``dialable``."""
        return _is_unicast(self.value >> 56) and self.port != 0

    @property
    def is_loopback(self) -> bool:
        """Whether its address is a loopback address (127.x.x.x)."""
        return self.value >> 56 == _LOOPBACK

    def __str__(self) -> str:
        """``10.0.0.1:40001#7``."""
        return f"{self.address}:{self.port}#{self.incarnation}"


def dialable(address: IPv4Address, port: int) -> bool:
    """Whether a single peer can be reached there: no multicast, broadcast or "any" address, no port 0.

    A forged beacon with such an address could make its receivers send to a whole network.
    """
    return _is_unicast(int(address) >> 24) and port != 0


def _is_unicast(first: int) -> bool:
    """Whether an address with this first byte is a unicast address."""
    return 0 < first < _MULTICAST


_LEGAL: Final = re.compile(r"[~/A-Za-z][\w/]*", re.ASCII)
# The log of all nodes (wiki.ros.org/rosout).
ROSOUT: Final = "/rosout"
# Topics that stay in their module under every policy, and why.
NEVER_CROSSING: Final = {
    ROSOUT: "log messages do not cross unless bridge.rosout = true in both modules: `rmpa log` reads all",
    "/rosout_agg": "it has all messages of /rosout once more",
    "/clock": "time does not cross: with two clocks in one graph it would jump",
    "/rmpa/**": "the agent's own topics do not cross",
}
# The regular expression of a resolved name, ``/like/this``.
GLOBAL_NAME: Final = r"/([A-Za-z0-9_]+(/[A-Za-z0-9_]+)*)?"
# The regular expression of a message or service type, ``package/Name``.
TYPE_NAME: Final = r"[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*"
_GLOBAL: Final = re.compile(GLOBAL_NAME)
_TYPE: Final = re.compile(TYPE_NAME)


def is_legal_name(name: str) -> bool:
    """Whether a graph resource may have this name, before it is resolved (empty is legal: the namespace)."""
    return name == "" or (_LEGAL.fullmatch(name) is not None and "//" not in name)


def is_global_name(name: str) -> bool:
    """Whether this is a resolved name, ``/like/this``."""
    return _GLOBAL.fullmatch(name) is not None


def is_type_name(name: str) -> bool:
    """Whether this is a message or service type, ``package/Name``."""
    return _TYPE.fullmatch(name) is not None


def join_names(namespace: str, name: str) -> str:
    """``/ns`` and ``name`` to ``/ns/name``; a global ``name`` stays as it is."""
    if name.startswith("/"):
        return name
    return f"{namespace.rstrip('/')}/{name}" if namespace else name


def resolve_name(name: str, namespace: str = "/", node: str = "") -> str:
    """Resolve a graph name as a client library does.

    Args:
        name: As written: ``/global``, ``relative``, ``~private`` or empty (the namespace itself).
        namespace: The namespace to resolve relative names in.
        node: The node's own global name, for private names.

    Returns:
        A global name without a trailing slash.

    Raises:
        ValueError: ``name`` is not a legal name.
    """
    if not is_legal_name(name):
        raise ValueError(f"{name!r} is not a ROS name; allowed are letters, digits, _ and /, after a letter, / or ~")
    if name.startswith("~"):
        resolved = join_names(node or namespace, name[1:].lstrip("/"))
    else:
        resolved = join_names(namespace, name)
    return "/" + "/".join(part for part in resolved.split("/") if part)


@lru_cache(maxsize=4096)
def _compile_glob(pattern: str) -> re.Pattern[str]:
    # "/**/" also fits a single slash: any number of parts in between, or none. "/**" at the end fits no part, too.
    wild = {"/**/": "/(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    pattern = re.sub(r"(?:/\*\*)+(?=/|$)", "/**", pattern)
    begin, end = (pattern[:-3], "(?:/.*)?") if pattern.endswith("/**") and pattern != "/**" else (pattern, "")
    pieces = re.split(r"(/\*\*/|\*\*|\*|\?)", begin)
    return re.compile("".join(wild.get(piece) or re.escape(piece) for piece in pieces) + end)


def matches(pattern: str, name: str) -> bool:
    """Whether a name fits a glob: ``*`` and ``?`` stay within one part of the name, ``**`` crosses slashes.

    ``/camera/**`` also fits ``/camera`` itself, as people expect of a namespace; likewise ``/**/cmd_vel`` fits
    ``/cmd_vel``, and ``/a/**/b`` fits ``/a/b``.
    """
    return _compile_glob(pattern).fullmatch(name) is not None


def matches_any(patterns: Iterable[str], name: str) -> bool:
    """Whether a name fits one of several globs."""
    return any(matches(pattern, name) for pattern in patterns)


# Serial numbers of 32 bits, which wrap around and are compared as in RFC 1982. Of two numbers the later one is less
# than 2³¹ ahead of the other. Code that runs once for each message writes the expressions out with ``SERIAL_MASK``
# and ``SERIAL_HALF``, because a call takes longer than the arithmetic.


# ``number & SERIAL_MASK`` wraps a number.
SERIAL_MASK: Final = UINT32_MAX
# A number that is this far or farther ahead of another number counts as the earlier one of the two.
SERIAL_HALF: Final = 1 << 31


def serial_add(number: int, count: int) -> int:
    """The number ``count`` places after ``number``; ``count`` may be negative."""
    return number + count & SERIAL_MASK


def serial_distance(start: int, end: int) -> int:
    """How many places ``end`` is ahead of ``start``: 0 to 2³² - 1; from 2³¹ on it is the earlier one of the two."""
    return end - start & SERIAL_MASK


def is_later(number: int, than: int) -> bool:
    """Whether ``number`` comes after ``than``; false for equal numbers."""
    return 0 < number - than & SERIAL_MASK < SERIAL_HALF


def is_earlier(number: int, than: int) -> bool:
    """Whether ``number`` comes before ``than``; false for equal numbers, true for two that are exactly 2³¹ apart."""
    return number - than & SERIAL_MASK >= SERIAL_HALF


# The regular expression of a ROS base name (REP 144).
BASE_NAME: Final = r"[A-Za-z][A-Za-z0-9_]*"
_NAME: Final = re.compile(BASE_NAME)


def peer_name_problem(name: str) -> str | None:
    """The error text for an invalid peer name; ``None`` for a valid one.

    A peer's name becomes a part of its proxies' names in the ROS graph, so it is a ROS base name (REP 144).
    """
    if not name:
        return "a peer's name cannot be empty"
    if len(name) > limits.PEER_NAME_MAX:
        return f"a peer's name has at most {limits.PEER_NAME_MAX} characters"
    if not _NAME.fullmatch(name):
        return f"{name!r} is not a ROS base name (a letter, then letters, digits and _)"
    return None


def peer_name_from(text: str) -> str:
    """The nearest valid peer name for a host name: ``my-robot.local`` gives ``my_robot``."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text.partition(".")[0])[: limits.PEER_NAME_MAX - 2]
    if not name or not name[0].isalpha():
        name = f"m_{name}" if name else "module"
    return name


@dataclass(frozen=True, slots=True)
class Identity:
    """One run of one agent.

    Args:
        guid: Its GUID, with the address and port at which peers should contact it.
        instance: 128 random bits (16 bytes), new at each start; distinguishes two peers with the same GUID.
        name: Its name, a ROS base name, unique among its peers.
        domain: Only peers of the same domain join.
        addresses: Its other numeric IPv4 addresses, best first; may be empty.

    Raises:
        ValueError: A part is out of its range.
    """

    guid: Guid
    instance: bytes
    name: str
    domain: int = 0
    addresses: tuple[IPv4Address, ...] = ()

    def __post_init__(self) -> None:
        if len(self.instance) != limits.INSTANCE_ID_BYTES:
            raise ValueError(f"an instance id has {limits.INSTANCE_ID_BYTES} bytes, not {len(self.instance)}")
        if problem := peer_name_problem(self.name):
            raise ValueError(problem)
        if not 0 <= self.domain <= limits.DOMAIN_MAX:
            raise ValueError(f"a domain id is between 0 and {limits.DOMAIN_MAX}, not {self.domain}")

    @property
    def endpoints(self) -> tuple[tuple[str, int], ...]:
        """The addresses to dial, best first: the GUID's own, then the others, without duplicates."""
        port = self.guid.port
        return tuple(dict.fromkeys([self.guid.endpoint, *((str(a), port) for a in self.addresses)]))

    def is_same_run(self, other: Identity) -> bool:
        """Whether two identities are of one run of one agent.

        The instance alone does not tell: each member of a mesh hears it, and may claim it. In a secured mesh only the
        name is proved.
        """
        return self.instance == other.instance and self.name == other.name

    def is_same_module(self, other: Identity, *, secured: bool) -> bool:
        """Whether two identities are of one module, perhaps of two runs of its agent.

        Args:
            other: The other identity.
            secured: Whether the mesh is secured. There the name alone tells, because the certificate proves it;
                else the same address and port do as well, since a module may have got another name.
        """
        return self.name == other.name or (not secured and self.guid.place == other.guid.place)

    def __str__(self) -> str:
        """``base (10.0.0.1:40001#7)``."""
        return f"{self.name} ({self.guid})"


# The agent's own node; proxies have names below it: ``/rmpa/<peer>/<node>``.
OWN_NODE: Final = "/rmpa"


def is_meant(wanted: str, name: str, guid: str) -> bool:
    """Whether a user means a module: by its name, its GUID as text, or that without the incarnation."""
    return wanted in (name, guid, guid.partition("#")[0])


def is_own(node: str) -> bool:
    """Whether a local node is the agent's own or a proxy."""
    return node == OWN_NODE or node.startswith(OWN_NODE + "/")


def proxy_prefix(peer: Identity, taken: Collection[str]) -> str:
    """The namespace of one peer's proxies: ``/rmpa/<name>``.

    Args:
        peer: The peer.
        taken: Prefixes of other modules. Two modules of one name must not share a prefix, or their proxies would
            replace each other in the graph.
    """
    prefix = f"{OWN_NODE}/{peer.name}"
    if prefix in taken:
        address, port = peer.guid.endpoint
        prefix = f"{prefix}_{address.replace('.', '_')}_{port}"
    return prefix


def proxy_name(prefix: str, node: str) -> str:
    """The name of a node's proxy: ``/rmpa/joystick`` and ``/joy_node`` give ``/rmpa/joystick/joy_node``."""
    return prefix + node


def proxied_node(name: str) -> tuple[str, str] | None:
    """The peer's name and the node that a proxy stands for; ``None`` for a node of this module."""
    if not name.startswith(OWN_NODE + "/"):
        return None
    peer, slash, node = name[len(OWN_NODE) + 1 :].partition("/")
    return (peer, slash + node) if node else None


def proxied_peer(name: str) -> str | None:
    """The peer whose node a proxy stands for; ``None`` for a node of this module."""
    proxy = proxied_node(name)
    return proxy[0] if proxy is not None else None
