"""Keys, tokens and attachments of messages between sites, and since when a site is away.

The attachment of each message between sites.

Little-endian::

     0 version    1 byte    1
     1 flags      1 byte    bit 0: latched
     2 sequence   8 bytes   counts the messages of a source, from 1: a gap is a loss
    10 stamp      8 bytes   when its gateway received it, nanoseconds since 1970; signed
    18 md5       16 bytes   the md5 sum of the message type
    34 node       1 + n     its publisher, UTF-8
     … path       1         sites that it passed, each 1 + n bytes of UTF-8, the first one is its origin
     … run        8 bytes   the run of its exporter, in which the sequence counts from 1; may be missing

The md5 sum is here and not in the key, because a gateway knows it only once a node has subscribed.
"""

from __future__ import annotations

import re
import struct
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_global_name, is_type_name, peer_name_problem
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.ros.wire.tcpros import Buffer

VERSION: Final = 1
_LATCHED: Final = 1
_HEAD: Final = struct.Struct("<BBQq16s")
_RUN: Final = struct.Struct("<Q")
_NUMBERS: Final = struct.Struct("<Qq")
_COMMON: Final = 18
"""From here on, and before the numbers, all attachments of one source are the same."""
_SOURCES_KEPT: Final = 256
"""Sources that a reader remembers; then it begins anew."""


@dataclass(frozen=True, slots=True)
class SiteAttachment:
    """What goes with a message between sites.

    Args:
        sequence: The number of the message at its source, from 1.
        stamp: When its gateway received it, in nanoseconds since 1970.
        md5: The md5 sum of its type, 32 hexadecimal digits.
        node: Its publisher, ``/like/this``.
        path: The sites that it passed, its origin first; at most ``limits.PATH_MAX``.
        latched: Whether its publisher is latched.
        run: The run of its exporter, by which sequence numbers are told apart; 0: not told.
    """

    sequence: int
    stamp: int
    md5: str
    node: str
    path: tuple[str, ...]
    latched: bool = False
    run: int = 0

    def serialize(self) -> bytes:
        """The bytes of the attachment."""
        writer = AttachmentWriter(self.md5, self.node, self.path, latched=self.latched, run=self.run)
        return writer.write(self.sequence, self.stamp)

    @classmethod
    def parse(cls, data: Buffer) -> SiteAttachment:
        """Read an attachment; bytes behind the run are ignored, so that later versions may add to it.

        Raises:
            RemoteProtocolError: It is shorter than it says, of another version, or has a name that is none in ROS.
        """
        sequence, stamp, source = AttachmentReader().read(bytes(data))
        return cls(sequence, stamp, source.md5, source.node, source.path, source.latched, source.run)


class AttachmentWriter:
    """Writes the attachments of one source; all but sequence and stamp is made once.

    Args:
        md5: The md5 sum of its type, 32 hexadecimal digits.
        node: Its publisher.
        path: The sites that its messages passed, with this one.
        latched: Whether its publisher is latched.
        run: The run of its exporter; 0: not told.
    """

    def __init__(self, md5: str, node: str, path: tuple[str, ...], *, latched: bool = False, run: int = 0) -> None:
        self._flags = _LATCHED if latched else 0
        self._md5 = bytes.fromhex(md5)
        told = _RUN.pack(run) if run else b""
        self._tail = b"".join((_text(node), bytes([len(path)]), *map(_text, path), told))

    def write(self, sequence: int, stamp: int) -> bytes:
        """The attachment of one message."""
        return _HEAD.pack(VERSION, self._flags, sequence, stamp, self._md5) + self._tail


@dataclass(frozen=True, slots=True)
class MessageSource:
    """What the attachments of one source have in common; the fields are those of ``SiteAttachment``."""

    md5: str
    node: str
    path: tuple[str, ...]
    latched: bool
    run: int


class AttachmentReader:
    """Reads the attachments of sources; what is the same in all of one source's is read once."""

    def __init__(self) -> None:
        self._known: dict[bytes, MessageSource] = {}

    def read(self, data: bytes) -> tuple[int, int, MessageSource]:
        """Read an attachment; bytes behind the run are ignored, so that later versions may add to it.

        Returns:
            The sequence, the stamp, and the source.

        Raises:
            RemoteProtocolError: It is shorter than it says, of another version, or has a name that is none in ROS.
        """
        if len(data) < _HEAD.size:
            raise RemoteProtocolError(
                f"an attachment of a site has {len(data)} bytes; the least are {_HEAD.size + 2}"
            )
        common = data[:2] + data[_COMMON:]
        source = self._known.get(common)
        if source is None:
            source = _read_source(data)
            if len(self._known) >= _SOURCES_KEPT:
                self._known.clear()
            self._known[common] = source
        sequence, stamp = _NUMBERS.unpack_from(data, 2)
        return sequence, stamp, source


def _read_source(data: bytes) -> MessageSource:
    version, flags, _, _, md5 = _HEAD.unpack_from(data)
    if version != VERSION:
        raise RemoteProtocolError(f"an attachment of a site is of version {version}; this gateway reads {VERSION}")
    node, path, run = _read_tail(data[_HEAD.size :])
    return MessageSource(md5.hex(), node, path, bool(flags & _LATCHED), run)


def _read_tail(tail: bytes) -> tuple[str, tuple[str, ...], int]:
    """Node, path and run."""
    raw = memoryview(tail)
    node, at = _read(raw, 0)
    if not is_global_name(node):
        raise RemoteProtocolError(f"an attachment of a site has the node {node[:80]!r}, which is no global name")
    if at >= len(raw):
        raise RemoteProtocolError("an attachment of a site ends before its path")
    count, at = raw[at], at + 1
    if not 0 < count <= limits.PATH_MAX:
        raise RemoteProtocolError(f"a message passed {count} sites; 1 to {limits.PATH_MAX} are allowed")
    path = []
    for _ in range(count):
        site, at = _read(raw, at)
        if peer_name_problem(site) is not None:
            raise RemoteProtocolError(f"an attachment of a site names the site {site[:80]!r}")
        path.append(site)
    run = _RUN.unpack_from(raw, at)[0] if len(raw) >= at + _RUN.size else 0
    return node, tuple(path), run


def _text(text: str) -> bytes:
    raw = text.encode()
    return bytes([len(raw)]) + raw


def _read(raw: memoryview, at: int) -> tuple[str, int]:
    end = at + 1 + raw[at] if at < len(raw) else len(raw) + 1
    if end > len(raw):
        raise RemoteProtocolError("an attachment of a site ends within a name")
    try:
        return str(raw[at + 1 : end], "utf-8"), end
    except UnicodeDecodeError as error:
        raise RemoteProtocolError(f"an attachment of a site has a name that is not UTF-8: {error}") from error


# The keys of a site's sources in Zenoh, and the liveliness tokens that announce them.
#
# ::
#
#     rmpa/1/<site>/<module>/t/<package>%<Type>/<topic>          messages
#     rmpa/1/<site>/<module>/s/<package>%<Type>/<service>        calls (queryable)
#     rmpa/1/<site>/<module>/up/<instance>                       token: the module
#     rmpa/1/<site>/<module>/up/<instance>/<t or s>/<package>%<Type>/<%node>/<%name>      token: a source
#     rmpa/1/<site>/<module>/to/<other>/<t or s>/…               messages or calls of a source for one other site
#     alone
#     rmpa/1/<site>/<module>/to/<instance>/<other>/<t or s>/…    token: such a source
#     rmpa/1/<site>/-gateway/<rank>/<instance>                   token: a gateway; the lowest rank leads
#
# Names of sites and modules are ROS base names, so they need no escape, and none is ``-gateway``. In the last
# chunks of
# a token ``/`` is ``%``, which no ROS name has. The type of a service that no program has asked for is ``-`` in its
# token: a ROS master does not know it. Queryables of services have ``*`` in the place of the type.
#
# A source that rules let out to some sites alone, or with other limits to some, is *addressed*: for each site that
# may
# have it there are a key and a token, which name that site. A gateway follows the tokens that are for all and those
# that name its site. Releases without addressed sources ignore their tokens.


ROOT: Final = "rmpa/1"
"""The first two chunks of each key; the number is that of the format."""
_UP: Final = "up"
TO: Final = "to"
"""The chunk before the one other site that a source is for."""
GATEWAY: Final = "-gateway"
"""Stands in the place of the module in the tokens of gateways."""
UNKNOWN_TYPE: Final = "*"
"""The type of a service whose server was not asked."""
_UNKNOWN: Final = "-"
_INSTANCE: Final = re.compile(r"[0-9a-f]{32}")
_RANK_MAX: Final = 999


@dataclass(frozen=True, slots=True)
class SiteModule:
    """One run of a module at a site.

    Args:
        site: The site's name.
        name: The module's name.
        instance: Its run, 32 hexadecimal digits.
    """

    site: str
    name: str
    instance: str

    def token(self) -> str:
        """The module's liveliness token."""
        return f"{ROOT}/{self.site}/{self.name}/{_UP}/{self.instance}"


@dataclass(frozen=True, slots=True)
class SiteSource:
    """A topic of one publisher, or a service, of a module at a site.

    Args:
        module: The module.
        kind: What it is.
        type: ``package/Name``; ``*`` for a service whose server was not asked.
        node: The node, ``/like/this``.
        name: The topic or service, ``/like/this``.
        to: The one other site that it is for; empty: it is for all.
    """

    module: SiteModule
    kind: SourceKind
    type: str
    node: str
    name: str
    to: str = ""

    def token(self) -> str:
        """The source's liveliness token."""
        module = self.module
        head = f"{ROOT}/{module.site}/{module.name}/{TO}/{module.instance}/{self.to}" if self.to else module.token()
        type_name = _UNKNOWN if self.type == UNKNOWN_TYPE else _chunk(self.type)
        return "/".join((head, self.kind, type_name, _chunk(self.node), _chunk(self.name)))

    def key(self) -> str:
        """The key of its messages or calls: sources of one topic share it, and the attachment says which it is."""
        return data_key(self.module.site, self.module.name, self.kind, self.type, self.name, self.to)


@dataclass(frozen=True, slots=True)
class SiteGateway:
    """A gateway of a site.

    Args:
        site: The site's name.
        rank: Which one leads: the lowest; of equal ones the lowest instance.
        instance: Its run, 32 hexadecimal digits.
    """

    site: str
    rank: int
    instance: str

    def token(self) -> str:
        """The gateway's liveliness token."""
        return f"{ROOT}/{self.site}/{GATEWAY}/{self.rank:03}/{self.instance}"

    @property
    def order(self) -> tuple[int, str]:
        """By which gateways of one site are compared: the least leads."""
        return self.rank, self.instance


def data_key(site: str, module: str, kind: SourceKind, type_name: str, name: str, to: str = "") -> str:
    """The key of messages or calls; ``*`` may stand for the site, the module or the type.

    Args:
        site: The site that has the source.
        module: The module that has it.
        kind: What it is.
        type_name: Its type.
        name: The topic or service.
        to: The one other site that it is for; empty: it is for all.
    """
    audience = f"{TO}/{to}/" if to else ""
    return f"{ROOT}/{site}/{module}/{audience}{kind}/{_chunk(type_name)}/{name.strip('/')}"


def token_keys(own: str) -> tuple[str, ...]:
    """The key expressions of the tokens that a gateway of the site ``own`` follows; no token fits two of them."""
    return f"{ROOT}/*/{GATEWAY}/**", f"{ROOT}/*/*/{_UP}/**", f"{ROOT}/*/*/{TO}/*/{own}/**"


def parse_token(key: str) -> SiteModule | SiteSource | SiteGateway | None:
    """Read a liveliness token; ``None`` for one of a later version, which has other chunks behind the known ones.

    Raises:
        RemoteProtocolError: It has another form, or a name that ROS does not allow.
    """
    if len(key) > limits.KEY_MAX:
        raise RemoteProtocolError(f"a token of a site has {len(key)} characters; at most {limits.KEY_MAX} are read")
    chunks = key.split("/")
    if len(chunks) < 6 or "/".join(chunks[:2]) != ROOT:
        raise RemoteProtocolError(f"{key[:120]!r} is not a token of a site")
    site, module, what, instance = chunks[2:6]
    _check_name("site", site, limits.SITE_NAME_MAX, key)
    if not _INSTANCE.fullmatch(instance):
        raise RemoteProtocolError(f"{key[:120]!r}: {instance[:40]!r} is not a run of 32 hexadecimal digits")
    if module == GATEWAY:
        if not (what.isascii() and what.isdigit() and int(what[:4]) <= _RANK_MAX and len(what) <= 4):
            raise RemoteProtocolError(f"{key[:120]!r}: {what[:20]!r} is not a rank from 0 to {_RANK_MAX}")
        return SiteGateway(site, int(what), instance) if len(chunks) == 6 else None
    _check_name("module", module, limits.SITE_NAME_MAX, key)
    found = SiteModule(site, module, instance)
    if what == TO and len(chunks) > 6:
        _check_name("site", chunks[6], limits.SITE_NAME_MAX, key)
        return _source(found, chunks[7:], key, chunks[6])
    if what != _UP:
        return None
    if len(chunks) == 6:
        return found
    return _source(found, chunks[6:], key)


def _source(module: SiteModule, chunks: list[str], key: str, to: str = "") -> SiteSource | None:
    if len(chunks) != 4:
        return None
    try:
        kind = SourceKind(chunks[0])
    except ValueError:
        return None
    type_name, node, name = (chunk.replace("%", "/") for chunk in chunks[1:])
    if kind is SourceKind.SERVICE and type_name == _UNKNOWN:
        type_name = UNKNOWN_TYPE
    elif not is_type_name(type_name):
        raise RemoteProtocolError(f"{key[:200]!r}: {type_name[:80]!r} is not a type")
    for each in (node, name):
        if not is_global_name(each):
            raise RemoteProtocolError(f"{key[:200]!r}: {each[:80]!r} is not a global name")
    return SiteSource(module, kind, type_name, node, name, to)


def _check_name(what: str, name: str, longest: int, key: str) -> None:
    problem = peer_name_problem(name)
    if problem is not None or len(name) > longest:
        raise RemoteProtocolError(f"{key[:120]!r}: {name[:40]!r} is not the name of a {what}")


def _chunk(name: str) -> str:
    return name.replace("/", "%")


# Which sites were there and are not, and what they had: for "unreachable since". Without I/O.


_ENDING: Final = 2.0
"""Seconds within which a gateway that ends withdraws what it announced: that too is what its site had."""


class SiteHistory:
    """Remembers since when other sites are there or away.

    Args:
        now: Monotonic seconds.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._there: frozenset[str] = frozenset()
        self._since: dict[str, float] = {}
        self._sources: dict[str, set[SiteSource]] = {}
        self._withdrawn: dict[str, deque[tuple[float, SiteSource]]] = {}
        self._ended: set[str] = set()
        """The sites whose sources are those from before they were away."""

    @property
    def away(self) -> tuple[str, ...]:
        """The sites that were there and are not, by name."""
        return tuple(sorted(self._since.keys() - self._there))

    def since_ago(self, site: str) -> float | None:
        """Seconds since a site came or left; ``None``: it was never seen."""
        return self._now() - self._since[site] if site in self._since else None

    def source(self, source: SiteSource, *, there: bool) -> None:
        """A site announces a source, or withdraws it; not called for those that go together with their site."""
        site = source.module.site
        if site in self._ended:
            self._forget(site)
        known = self._sources.setdefault(site, set())
        if there:
            known.add(source)
            return
        known.discard(source)
        withdrawn = self._withdrawn.setdefault(site, deque(maxlen=limits.SITE_SOURCES_MAX))
        withdrawn.append((self._now(), source))
        while withdrawn[0][0] < self._now() - _ENDING:
            withdrawn.popleft()

    def had(self, name: str) -> tuple[tuple[str, str], ...]:
        """The sites that are away and had a topic or service of this name, each with its module."""
        away = self.away
        found = {
            (s.module.site, s.module.name) for site in away for s in self._sources.get(site, ()) if s.name == name
        }
        return tuple(sorted(found))

    def seen(self, sites: Iterable[str]) -> None:
        """These sites are there now, and no others."""
        there = frozenset(sites)
        for site in there ^ self._there:
            self._since[site] = self._now()
        for site in self._there - there:
            self._ended.add(site)
            withdrawn = self._withdrawn.pop(site, ())
            self._sources.setdefault(site, set()).update(s for at, s in withdrawn if at >= self._now() - _ENDING)
        self._there = there
        while len(self._since) > limits.SITES_REMEMBERED_MAX and (away := self.away):
            oldest = min(away, key=self._since.__getitem__)
            del self._since[oldest]
            self._forget(oldest)
        self._bound()

    def _bound(self) -> None:
        """Forget what the sites had that left first, if it is too much."""
        away = sorted(self.away, key=self._since.__getitem__)
        total = sum(len(self._sources.get(site, ())) for site in away)
        for site in away:
            if total <= limits.SITES_SOURCES_MAX:
                return
            total -= len(self._sources.get(site, ()))
            self._forget(site)

    def _forget(self, site: str) -> None:
        """Forget what a site had."""
        self._ended.discard(site)
        self._sources.pop(site, None)
        self._withdrawn.pop(site, None)
