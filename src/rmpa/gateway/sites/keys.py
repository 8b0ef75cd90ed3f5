"""The keys of a site's sources in Zenoh, and the liveliness tokens that announce them.

::

    rmpa/1/<site>/<module>/t/<package>%<Type>/<topic>          messages
    rmpa/1/<site>/<module>/s/<package>%<Type>/<service>        calls (queryable)
    rmpa/1/<site>/<module>/up/<instance>                       token: the module
    rmpa/1/<site>/<module>/up/<instance>/<t or s>/<package>%<Type>/<%node>/<%name>      token: a source
    rmpa/1/<site>/<module>/to/<other>/<t or s>/…               messages or calls of a source for one other site alone
    rmpa/1/<site>/<module>/to/<instance>/<other>/<t or s>/…    token: such a source
    rmpa/1/<site>/-gateway/<rank>/<instance>                   token: a gateway; the lowest rank leads

Names of sites and modules are ROS base names, so they need no escape, and none is ``-gateway``. In the last chunks of
a token ``/`` is ``%``, which no ROS name has. The type of a service that no program has asked for is ``-`` in its
token: a ROS master does not know it. Queryables of services have ``*`` in the place of the type.

A source that rules let out to some sites alone, or with other limits to some, is *addressed*: for each site that may
have it there are a key and a token, which name that site. A gateway follows the tokens that are for all and those
that name its site. Releases without addressed sources ignore their tokens.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_global_name, is_type_name, peer_name_problem
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind

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
