"""Keys, tokens, attachments and headers between sites.

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
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, TypeVar

import msgspec

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import is_global_name, is_type_name, peer_name_problem
from rmpa.gateway import limits
from rmpa.gateway.rules import SourceKind
from rmpa.ros.wire.tcpros import Buffer, TopicDescription, printable

if TYPE_CHECKING:
    from collections.abc import Callable


VERSION: Final = 1
_LATCHED: Final = 1
_HEAD: Final = struct.Struct("<BBQq16s")
_RUN: Final = struct.Struct("<Q")
_NUMBERS: Final = struct.Struct("<Qq")
# From here on, and before the numbers, all attachments of one source are the same.
_COMMON: Final = 18
# Sources that a reader remembers; then it begins anew.
_SOURCES_KEPT: Final = 256


class MessageSource(NamedTuple):
    """What the attachments of one source have in common.

    Attributes:
        md5: The md5 sum of its type, 32 hexadecimal digits.
        node: The publisher, ``/like/this``.
        path: The sites that its messages passed, its origin first; at most ``limits.PATH_MAX``.
        latched: Whether its publisher is latched.
        run: The run of its exporter, by which sequence numbers are told apart; 0: not told.
    """

    md5: str
    node: str
    path: tuple[str, ...]
    latched: bool = False
    run: int = 0

    def writer(self) -> Callable[[int, int], bytes]:
        """What writes its attachments, each of a message's number from 1, and of nanoseconds since 1970.

        All but these two is made once.

        Raises:
            ValueError: The md5 sum is none.
        """
        flags, md5 = _LATCHED if self.latched else 0, bytes.fromhex(self.md5)
        told = _RUN.pack(self.run) if self.run else b""
        tail = b"".join((_text(self.node), bytes([len(self.path)]), *map(_text, self.path), told))
        return lambda sequence, stamp: _HEAD.pack(VERSION, flags, sequence, stamp, md5) + tail


class AttachmentReader:
    """Reads the attachments of sources; what is the same in all of one source's is read once."""

    def __init__(self) -> None:
        self._known: dict[bytes, MessageSource] = {}

    def read(self, data: bytes) -> tuple[int, int, MessageSource]:
        """Read an attachment; bytes behind the run are ignored, so that later versions may add to it.

        Returns:
            The number of the message at its source, from 1, when its gateway received it, in nanoseconds since 1970,
            and the source.

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
    node, at = _read(data, _HEAD.size)
    if not is_global_name(node):
        raise RemoteProtocolError(f"an attachment of a site has the node {node[:80]!r}, which is no global name")
    if at >= len(data):
        raise RemoteProtocolError("an attachment of a site ends before its path")
    count, at = data[at], at + 1
    if not 0 < count <= limits.PATH_MAX:
        raise RemoteProtocolError(f"a message passed {count} sites; 1 to {limits.PATH_MAX} are allowed")
    path = []
    for _ in range(count):
        site, at = _read(data, at)
        if peer_name_problem(site) is not None:
            raise RemoteProtocolError(f"an attachment of a site names the site {site[:80]!r}")
        path.append(site)
    run = _RUN.unpack_from(data, at)[0] if len(data) >= at + _RUN.size else 0
    return MessageSource(md5.hex(), node, tuple(path), bool(flags & _LATCHED), run)


def _text(text: str) -> bytes:
    raw = text.encode()
    return bytes([len(raw)]) + raw


def _read(raw: bytes, at: int) -> tuple[str, int]:
    end = at + 1 + raw[at] if at < len(raw) else len(raw) + 1
    if end > len(raw):
        raise RemoteProtocolError("an attachment of a site ends within a name")
    try:
        return raw[at + 1 : end].decode(), end
    except UnicodeDecodeError as error:
        raise RemoteProtocolError(f"an attachment of a site has a name that is not UTF-8: {error}") from error


_T = TypeVar("_T")
_Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


def read_json(data: Buffer, kind: type[_T], what: str, most: int) -> _T:
    """Read a text of another gateway; unknown keys are ignored.

    Args:
        data: The text, JSON.
        kind: Its type.
        what: The same for errors, such as ``a text about parameters``.
        most: The most bytes that it may have.

    Raises:
        RemoteProtocolError: It is too long, or no such text.
    """
    if len(data) > most:
        raise LimitExceeded(what, len(data), most)
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RemoteProtocolError(f"not {what}: {printable(str(error))}") from None


class TopicHeader(msgspec.Struct, frozen=True):
    """What a gateway says of one publisher of its site, as JSON: the answer at ``…/d/t/<topic>``.

    The question's parameters are ``node`` (one publisher of several; without it any) and ``site`` (the site that
    asks).

    Attributes:
        type: The type, as the publisher's own header has it, and so on to ``latching``.
        md5sum: The md5 sum of the type.
        definition: Its definition.
        latching: Whether the publisher is latched.
        node: The publisher, in its module.
        run: The run of its exporter, by which sequence numbers are told apart.
        sequence: The number of the last message that was taken for the other sites.
        waiting: Messages that wait there for a slow link.
    """

    type: str
    md5sum: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{32}\Z")]
    definition: str = ""
    latching: bool = False
    node: str = ""
    run: _Count = 0
    sequence: _Count = 0
    waiting: _Count = 0

    @property
    def description(self) -> TopicDescription:
        """The publisher's own header."""
        return TopicDescription(self.type, self.md5sum, self.definition, self.latching)

    @classmethod
    def parse(cls, data: Buffer) -> TopicHeader:
        """Read an answer; unknown keys are ignored.

        Raises:
            RemoteProtocolError: It is too long, no JSON object, or type, md5 sum or a number is none.
        """
        found = read_json(data, cls, "the header of a publisher at another site", limits.HEADER_MAX)
        if not is_type_name(found.type):
            raise RemoteProtocolError(f"another site names the type {found.type[:80]!r}")
        return found


class SequenceCounter:
    """Counts the messages of one source of another site that were lost, by their numbers.

    They count from 1 in each run of its exporter. A latched message that comes once more (from a cache) has a number
    that is known.
    """

    def __init__(self) -> None:
        self._run: int | None = None
        self._last = self._announced = self._gaps = 0
        self._expects_first = False

    @property
    def lost(self) -> int:
        """Messages that were sent and have not come; those on their way count too until they come."""
        return self._gaps + max(0, self._announced - self._last)

    def take(self, run: int, sequence: int) -> bool:
        """Count a message that came.

        Args:
            run: The exporter's run.
            sequence: Its number.

        Returns:
            Whether it is new; else it is to be dropped.
        """
        if run != self._run:
            self._begin(run, sequence)
        elif sequence > self._last or self._expects_first:
            self._gaps += max(0, sequence - self._last - 1)
        else:
            return False
        self._last, self._expects_first = sequence, False
        return True

    def announced(self, run: int, sequence: int) -> None:
        """The exporter says how many messages it has sent; if none has come yet, what it sends later is expected."""
        if self._run is None:
            self._begin(run, sequence)
            self._expects_first = True
        elif run == self._run:
            self._announced = max(self._announced, sequence)

    def restart(self) -> None:
        """Nothing is subscribed any more: the next message begins anew, without a loss."""
        self._begin(None, 0)

    def _begin(self, run: int | None, sequence: int) -> None:
        self._gaps = self.lost
        self._run, self._last, self._announced, self._expects_first = run, sequence, sequence, False


# The keys of a site's sources in Zenoh, and the liveliness tokens that announce them::
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
# Names of sites and modules are ROS base names, so they need no escape, and none is ``-gateway``. In the last chunks
# of a token ``/`` is ``%``, which no ROS name has. The type of a service that no program has asked for is ``-`` in
# its token: a ROS master does not know it. Queryables of services have ``*`` in the place of the type.
#
# A source that rules let out to some sites alone, or with other limits to some, is *addressed*: for each site that
# may have it there are a key and a token, which name that site. A gateway follows the tokens that are for all and
# those that name its site. Releases without addressed sources ignore their tokens.


# The first two chunks of each key; the number is that of the format.
ROOT: Final = "rmpa/1"
_UP: Final = "up"
# The chunk before the one other site that a source is for.
TO: Final = "to"
# Stands in the place of the module in the tokens of gateways.
GATEWAY: Final = "-gateway"
# The type of a service whose server was not asked.
UNKNOWN_TYPE: Final = "*"
_UNKNOWN: Final = "-"
_INSTANCE: Final = re.compile(r"[0-9a-f]{32}")
_RANK: Final = re.compile(r"0?[0-9]{1,3}")


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

    @property
    def site(self) -> str:
        """The site that has it."""
        return self.module.site

    def token(self) -> str:
        """The source's liveliness token."""
        module = self.module
        head = f"{ROOT}/{module.site}/{module.name}/{TO}/{module.instance}/{self.to}" if self.to else module.token()
        type_name = _UNKNOWN if self.type == UNKNOWN_TYPE else _chunk(self.type)
        return "/".join((head, self.kind, type_name, _chunk(self.node), _chunk(self.name)))

    def key(self) -> str:
        """The key of its messages or calls: sources of one topic share it, and the attachment says which it is."""
        return data_key(self.module.site, self.module.name, self.kind, self.type, self.name, self.to)


@dataclass(frozen=True, slots=True, order=True)
class SiteGateway:
    """A gateway of a site; of those of one site the least leads.

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


# The key expression of the tokens of all gateways, those of other formats too: they are told that they do not meet.
ANY_GATEWAY: Final = f"{ROOT.partition('/')[0]}/*/*/{GATEWAY}/**"


def parse_token(key: str) -> SiteModule | SiteSource | SiteGateway | None:
    """Read a liveliness token; ``None`` for one of a later version, which has other chunks behind the known ones.

    Raises:
        RemoteProtocolError: It has another form, or a name that ROS does not allow.
    """
    chunks = key.split("/")
    site, module, what, instance = chunks[2:6] if len(chunks) > 5 else ("",) * 4
    whole = len(key) <= limits.KEY_MAX and "/".join(chunks[:2]) == ROOT and _INSTANCE.fullmatch(instance)
    names = [site, *chunks[6:7]] if what == TO else [site]
    if module != GATEWAY:
        names.append(module)
    elif not _RANK.fullmatch(what):
        whole = None
    if not whole or any(peer_name_problem(name) or len(name) > limits.SITE_NAME_MAX for name in names):
        raise RemoteProtocolError(f"{key[:120]!r} is not a token of a site")
    if module == GATEWAY:
        return SiteGateway(site, int(what), instance) if len(chunks) == 6 else None
    found = SiteModule(site, module, instance)
    if what == TO and len(chunks) > 6:
        return _source(found, chunks[7:], key, chunks[6])
    if what != _UP:
        return None
    return _source(found, chunks[6:], key) if len(chunks) > 6 else found


def _source(module: SiteModule, chunks: list[str], key: str, to: str = "") -> SiteSource | None:
    if len(chunks) != 4 or chunks[0] not in list(SourceKind):
        return None
    kind = SourceKind(chunks[0])
    type_name, node, name = (chunk.replace("%", "/") for chunk in chunks[1:])
    if kind is SourceKind.SERVICE and type_name == _UNKNOWN:
        type_name = UNKNOWN_TYPE
    elif not is_type_name(type_name):
        raise RemoteProtocolError(f"{key[:200]!r}: {type_name[:80]!r} is not a type")
    if not (is_global_name(node) and is_global_name(name)):
        raise RemoteProtocolError(f"{key[:200]!r} has a name that is no global name")
    return SiteSource(module, kind, type_name, node, name, to)


def _chunk(name: str) -> str:
    return name.replace("/", "%")
