"""Zenoh's table of access, from ``[[permission]]``: which certificate may send and get which keys through a router.

A rule of ours is about modules, by their names; the common name of a certificate is that name, and a gateway connects
with the certificate of its own module. In the keys of sites stand the names of topics, services and parameters.
Zenoh's rules allow what one of them allows and none denies, as ours do.

Zenoh merges the rules of one common name, of which a denial wins; but of a name's and everybody's an allowance wins.
So where something is denied to some names, the table has names alone (``_Table._policy``).

What Zenoh cannot say: it compares common names as they are, so a glob over them becomes the names that are known. A
denial whose glob cannot be resolved is one for all; an allowance is left out. Both are told.
"""

from __future__ import annotations

import itertools
import json
import logging
import re
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from rmpa.agent.trust import trust_store
from rmpa.config.peer_rules import ACTION_CLIENT, ACTION_SERVER, Access, Effect
from rmpa.config.values import PEER
from rmpa.core.errors import RemoteProtocolError, StartError
from rmpa.core.identity import matches
from rmpa.gateway.zenoh.config import MeshCertificates, gateway_config, zenohd_entries
from rmpa.gateway.zenoh.session import open_session
from rmpa.trust.limits import CERTIFICATE_LIFETIME, RENEWAL_SHARE
from rmpa.trust.permissions import action_topics
from rmpa.trust.store import CA, CERTIFICATE, DENY, KEY

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from rmpa.config.peer_rules import PermissionRule
    from rmpa.config.rules import GatewaySettings
    from rmpa.config.settings import Settings, TrustSettings
    from rmpa.gateway.zenoh.config import ZenohConfig
    from rmpa.gateway.zenoh.session import OpenSession

_MODULE: Final = "rmpa/1/*/*"
_ADDRESSED: Final = f"{_MODULE}/to/*"
_TOPIC: Final = (
    *(f"{head}/t/*/{{}}{end}" for head in (_MODULE, _ADDRESSED) for end in ("", "/@adv/**")),
    f"{_MODULE}/d/t/{{}}",
)
_SERVICE: Final = (f"{_MODULE}/s/*/{{}}", f"{_ADDRESSED}/s/*/{{}}")
_PARAM: Final = (f"{_MODULE}/p/{{}}",)
_ASKED_BY_GATEWAYS: Final = f"{_MODULE}/p/-"
_IN: Final = "ingress"
_OUT: Final = "egress"
_ASKS: Final = {_IN: ("query",), _OUT: ("declare_queryable", "reply")}
_ANSWERS: Final = {_IN: ("declare_queryable", "reply"), _OUT: ("query",)}
_OFFERS: Final = {_IN: ("declare_queryable",), _OUT: ("declare_queryable",)}
_TOKENS: Final = ("liveliness_token", "liveliness_query", "declare_liveliness_subscriber")
_EVERYTHING: Final = ("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", *_TOKENS)
_BOTH: Final = {_IN: _EVERYTHING, _OUT: _EVERYTHING}
_FLOWS: Final[dict[Access, tuple[tuple[str, ...], dict[str, tuple[str, ...]]]]] = {
    # A cache of latched messages (@adv) is asked by the subscriber, and announced by a token of the publisher.
    Access.PUBLISH: (
        _TOPIC,
        {
            _IN: ("put", "delete", "declare_queryable", "reply", *_TOKENS),
            _OUT: ("declare_subscriber", "query", *_TOKENS),
        },
    ),
    Access.SUBSCRIBE: (
        _TOPIC,
        {
            _IN: ("declare_subscriber", "query", *_TOKENS),
            _OUT: ("put", "delete", "declare_queryable", "reply", *_TOKENS),
        },
    ),
    Access.CALL: (_SERVICE, _ASKS),
    Access.SERVE: (_SERVICE, _ANSWERS),
    Access.PARAM: (_PARAM, _ASKS),
}
"""By access: the keys, and the messages from and to the subject that it needs."""
_ALL_KEYS: Final = ("**", "**/@adv/**", "@ros2_lv/**")
"""All keys in use: ``**`` alone fits no chunk that begins with ``@``."""
_JudgedRule = tuple[int, "PermissionRule", tuple[tuple[str, ...], ...]]
"""Its number, the rule, and the subjects that it is about, each as common names; no names: everybody."""
_GLOB: Final = re.compile(r"[*?]")


@dataclass(frozen=True, slots=True)
class AccessTable:
    """Zenoh's ``access_control``.

    Args:
        entries: Its value in Zenoh's configuration.
        notes: What of the rules could not be said.
    """

    entries: dict[str, object]
    notes: tuple[str, ...]


def access_table(
    trust: TrustSettings, known: Sequence[str] = (), foreign: Sequence[str] = (), revoked: Sequence[str] = ()
) -> AccessTable:
    """Make the table.

    Args:
        trust: The rules, groups and the default.
        known: Names of modules that have certificates, for globs over them.
        foreign: Key expressions that every member may use, such as those of ROS 2.
        revoked: Names of modules that may do nothing: Zenoh checks no revocation list, so it still lets them connect.
    """
    return _Table(trust, known, foreign).made(revoked)


class _Table:
    def __init__(self, trust: TrustSettings, known: Sequence[str], foreign: Sequence[str]) -> None:
        self._trust = trust
        self._groups = {group.name: group.modules for group in trust.groups}
        self._known = known
        self._rules: list[dict[str, object]] = []
        self._subjects: dict[tuple[str, ...], str] = {}
        self._policies: list[dict[str, object]] = []
        self._notes: dict[str, None] = {}
        self._foreign = tuple(foreign)
        self._members: tuple[str, ...] = ()
        """All modules that are known or named, but for those that were revoked."""
        self._by_name = False
        """Whether everybody is ``_members``: others get nothing."""

    def made(self, revoked: Sequence[str]) -> AccessTable:
        default = self._trust.default
        rules = [(number, rule, tuple(self._subject_names(number, rule))) for number, rule in self._numbered()]
        named = {name for _, _, subjects in rules for names in subjects for name in names}
        self._members = tuple(sorted({*named, *self._known} - set(revoked)))
        everybody = [rule.effect for _, rule, names in rules if () in names]
        named_deny = bool(revoked) or any(rule.effect is Effect.DENY and any(names) for _, rule, names in rules)
        overlap = Effect.DENY in everybody if default == Effect.ALLOW else True
        if named_deny and overlap and everybody and not self._known:
            rules = self._widened(rules)
            revoked = self._not_enforced(revoked)
        else:
            self._by_name = named_deny and overlap
        if revoked:
            self._policy(tuple(revoked), self._rule("revoked", Effect.DENY, _ALL_KEYS, _BOTH))
        if default != Effect.ALLOW:
            self._base()
        elif self._by_name:
            default = Effect.DENY
            self._policy((), self._rule("all", Effect.ALLOW, (*_ALL_KEYS, *self._foreign), _BOTH))
        for number, rule, subjects in rules:
            if rule.effect is Effect.DENY or self._trust.default != Effect.ALLOW:
                self._add(number, rule, subjects)
        entries: dict[str, object] = {
            "enabled": True,
            "default_permission": str(default),
            "rules": self._rules,
            "subjects": [
                {"id": name, "cert_common_names": list(names)} if names else {"id": name}
                for names, name in self._subjects.items()
            ],
            "policies": self._policies,
        }
        return AccessTable(entries, tuple(self._notes))

    def _widened(self, rules: Sequence[_JudgedRule]) -> list[_JudgedRule]:
        """What is denied to some modules is denied to all: Zenoh would allow it to them as to everybody."""
        found: list[_JudgedRule] = []
        for number, rule, subjects in rules:
            wider = rule.effect is Effect.DENY and any(subjects)
            if wider:
                self._note(number, "denies it to all modules: rules are for all, and only the authority knows them")
            found.append((number, rule, ((),) if wider else subjects))
        return found

    def _not_enforced(self, revoked: Sequence[str]) -> tuple[str, ...]:
        if revoked:
            text = "which were revoked, until their certificates end; let the authority be the router"
            self._notes[f"rules for all modules let in {', '.join(revoked)}, {text}"] = None
        return ()

    def _numbered(self) -> Iterator[tuple[int, PermissionRule]]:
        return iter(enumerate(self._trust.rules, 1))

    def _base(self) -> None:
        """What each member needs: presence, definitions, and to offer answers; names are judged in queries."""
        both = {_IN: _TOKENS, _OUT: _TOKENS}
        asked = dict.fromkeys((_IN, _OUT), ("query", "reply", "declare_queryable"))
        rules = [
            *self._rule("presence", Effect.ALLOW, ("rmpa/1/**",), both),
            *self._rule("definitions", Effect.ALLOW, (f"{_MODULE}/d/m/*",), asked),
            *self._rule("questions of gateways", Effect.ALLOW, ("rmpa/1/*/-gateway/why",), asked),
            *self._rule("answers", Effect.ALLOW, tuple(f"{_MODULE}/{each}/**" for each in "dvp"), _OFFERS),
            *self._rule("own parameters", Effect.ALLOW, (f"{_MODULE}/p/**",), _ANSWERS),
        ]
        if self._foreign:
            rules += self._rule("foreign", Effect.ALLOW, self._foreign, _BOTH)
        self._policy((), rules)

    def _add(self, number: int, rule: PermissionRule, subjects: Sequence[tuple[str, ...]]) -> None:
        for name in subjects:
            rules: list[str] = []
            for access, globs in self._names(rule, name).items():
                found = _FLOWS.get(access)
                if found is None:
                    continue
                keys = tuple(
                    dict.fromkeys(
                        template.format(key)
                        for template in found[0]
                        for glob in globs
                        for key in self._keys(number, rule, glob)
                    )
                )
                if access is Access.PARAM and rule.effect is Effect.ALLOW and keys:
                    keys += (_ASKED_BY_GATEWAYS,)  # the name is in the question, and its gateway judges it
                label = f"permission {number}: {access}" + (f" of {name[0]}" if name and len(name) == 1 else "")
                rules += self._rule(label, rule.effect, keys, found[1])
            if rules:
                self._policy(name, rules)
                if not name and rule.effect is Effect.DENY and not self._by_name:
                    self._policy(self._members, rules)  # what else allows it to them holds beside everybody's denial

    def _subject_names(self, number: int, rule: PermissionRule) -> Iterator[tuple[str, ...]]:
        """The subjects of a rule, each as its common names; no names: everybody."""
        globs = [*rule.modules, *(glob for group in rule.groups for glob in self._groups.get(group, ()))]
        own_name = any(PEER in written for each in rule.names.values() for written in each)
        names: dict[str, None] = {}
        for glob in globs:
            if not _GLOB.search(glob):
                names[glob] = None
                continue
            if glob == "*" and not own_name:
                yield ()
                return
            fitting = [name for name in self._known if matches(glob, name)]
            if not fitting and rule.effect is Effect.DENY:
                self._note(number, f"denies it to all modules: none is known that fits {glob!r}")
                yield ()
                return
            if not fitting:
                self._note(number, f"is left out for {glob!r}: no module is known that fits it; name the modules")
            names.update(dict.fromkeys(fitting))
        if own_name:
            yield from ((name,) for name in names)
        elif names:
            yield tuple(names)

    def _names(self, rule: PermissionRule, subject: tuple[str, ...]) -> dict[Access, list[str]]:
        found: dict[Access, list[str]] = {}
        for key, globs in rule.names.items():
            for written in globs:
                glob = written.replace(PEER, subject[0] if subject else "*")
                if key in (ACTION_CLIENT, ACTION_SERVER):
                    for access, topic in action_topics(key, glob):
                        found.setdefault(access, []).append(topic)
                else:
                    found.setdefault(Access(key), []).append(glob)
        return found

    def _keys(self, number: int, rule: PermissionRule, glob: str) -> tuple[str, ...]:
        if "?" in glob and rule.effect is Effect.ALLOW:
            self._note(number, f"is left out for {glob!r}: Zenoh has no ?")
            return ()
        return key_expressions(glob)

    def _note(self, number: int, text: str) -> None:
        self._notes[f"[[permission]] {number} {text}"] = None

    def _rule(
        self, label: str, effect: Effect, keys: Sequence[str], flows: Mapping[str, tuple[str, ...]]
    ) -> list[str]:
        made = []
        for flow, messages in flows.items() if keys else ():
            name = f"{label} ({flow})"
            self._rules.append(
                {
                    "id": name,
                    "permission": str(effect),
                    "flows": [flow],
                    "messages": list(messages),
                    "key_exprs": list(keys),
                }
            )
            made.append(name)
        return made

    def _policy(self, names: tuple[str, ...], rules: list[str]) -> None:
        """Have rules hold for these common names; for everybody, if there are none.

        Zenoh allows what one of a certificate's subjects allows: what is denied to a name and allowed to everybody
        would be allowed. So with such a denial everybody is those that are known, each a subject of its own.
        """
        if not names and self._by_name:
            names = self._members
            if not names:
                return
        if names not in self._subjects:
            self._subjects[names] = f"subject {len(self._subjects) + 1}" if names else "everybody"
        self._policies.append({"rules": rules, "subjects": [self._subjects[names]]})


def key_expressions(glob: str) -> tuple[str, ...]:
    """The key expressions of Zenoh that fit the same names as a glob of ours; ``?`` becomes any characters.

    A ``**`` within a part of a name stands for the rest of that part, or for more parts: two key expressions.
    """
    choices = []
    for part in glob.strip("/").split("/"):
        if part == "**":
            choices.append(["**"])
            continue
        pieces = [piece.replace("?", "*") for piece in part.split("**")]
        joined = (
            "".join(itertools.chain(*itertools.zip_longest(pieces, between, fillvalue="")))
            for between in itertools.product(("*", "*/**/*"), repeat=len(pieces) - 1)
        )
        choices.append(list(joined))
    return tuple(dict.fromkeys(_canonical("/".join(parts)) for parts in itertools.product(*choices)))


def _canonical(key: str) -> str:
    chunks: list[str] = []
    for chunk in key.split("/"):
        each = chunk if chunk in ("*", "**") else re.sub(r"\*+", "$*", chunk)
        each = "*" if each == "$*" else each
        if chunks and chunks[-1] == "**" and each == "*":
            chunks.insert(-1, each)
        elif not (chunks and chunks[-1] == "**" and each == "**"):
            chunks.append(each)
    return "/".join(chunks)


# The session of a gateway, secured by its module's certificate, and the same as a configuration for zenohd.


_log = logging.getLogger(__name__)
_LISTEN: Final = ("tls/0.0.0.0:7447",)
"""Where zenohd listens if the settings name no endpoint."""
_HEAD: Final = """\
// For zenohd 1.10 or later; made by rmpa gateway zenoh-config from [gateway], [trust] and [[permission]].
// Both sides show a certificate of the mesh. zenohd reads this file and the certificates once, at its start: start
// it again when the certificate is renewed (each {days:g} days), a permission has changed, or a module has joined or
// was revoked.
"""


def mesh_certificates(settings: Settings) -> MeshCertificates | None:
    """The files of the gateway's module; ``None``: it has joined no secured mesh.

    Raises:
        StartError: They are not whole, or other users can read them.
    """
    store = trust_store(settings)
    if store is None or not store.exists:
        return None
    store.load()
    return MeshCertificates(str(store.path(CA)), str(store.path(CERTIFICATE)), str(store.path(KEY)))


def session_config(settings: Settings) -> tuple[ZenohConfig, tuple[str, ...]]:
    """What the gateway's session is opened with, and what of the permissions could not be said to Zenoh.

    What others connect to has Zenoh's table of access, made of ``[[permission]]``.

    Raises:
        StartError: As ``gateway_config`` and ``mesh_certificates``.
    """
    certificates = mesh_certificates(settings)
    config = gateway_config(settings.gateway, certificates)
    if certificates is None or not config.listen:
        return config, ()
    table = access_table(
        settings.trust, known_modules(settings), foreign_keys(settings.gateway), revoked_modules(settings)
    )
    return replace(config, access_control=table.entries), table.notes


async def open_trusted_session(settings: Settings) -> OpenSession:
    """Open the session that the settings ask for.

    Raises:
        StartError: It may not be opened without certificates, an address is taken, or no router answers.
    """
    config, notes = session_config(settings)
    for note in notes:
        _log.warning("! zenoh: %s", note)
    return await open_session(config, lambda: _changed(settings, config))


def _changed(settings: Settings, opened: ZenohConfig) -> bool:
    """Whether the table of access would be another one now: a module has joined, or was revoked."""
    try:
        return session_config(settings)[0].access_control != opened.access_control
    except StartError:
        return False  # files are being written


def zenohd_config(settings: Settings) -> str:
    """A configuration file (JSON5) for zenohd, as a router between sites.

    Raises:
        StartError: The module has joined no secured mesh, and ``insecure`` is not set; or its files are broken.
    """
    gateway = replace(settings.gateway, router=True, listen=settings.gateway.listen or _LISTEN)
    config, notes = session_config(replace(settings, gateway=gateway))
    renewal = CERTIFICATE_LIFETIME * RENEWAL_SHARE / 86_400
    text = _HEAD.format(days=renewal) + "".join(f"// Note: {note}\n" for note in notes)
    if config.certificates is None:
        text += "// INSECURE: no certificates, and no rules of access.\n"
    return text + json.dumps(zenohd_entries(config), indent=2) + "\n"


def known_modules(settings: Settings) -> tuple[str, ...]:
    """The modules with a certificate, which the mesh's authority knows; at other modules none."""
    store = trust_store(settings)
    if store is None or not store.is_authority:
        return ()
    try:
        return tuple(sorted(store.load_issued()))
    except StartError:
        return ()


def revoked_modules(settings: Settings) -> tuple[str, ...]:
    """The modules on the deny list whose certificates from before may still be valid.

    Zenoh knows a certificate by its name alone. So a name that was invited again stays out until those have ended.

    Raises:
        StartError: The files of trust are not whole, or the deny list is broken.
    """
    store = trust_store(settings)
    if store is None or not store.exists:
        return ()
    files = store.load()
    if not files.deny:
        return ()
    from rmpa.trust.certificates import DenyList, ca_public_key, read_document  # noqa: PLC0415 - the extra rmpa[trust]

    try:
        deny = read_document(files.deny, ca_public_key(files.ca), DenyList)
    except RemoteProtocolError as error:
        raise StartError(str(store.path(DENY)), f"is broken: {error}", "see rmpa trust status") from None
    ended = time.time() - CERTIFICATE_LIFETIME
    return tuple(sorted(entry.name for entry in deny.entries if entry.before > ended))


def foreign_keys(settings: GatewaySettings) -> tuple[str, ...]:
    """Key expressions of neighbours that are no sites: each certificate of the mesh may use them."""
    return ("@ros2_lv/**", f"{settings.ros2.domain}/**") if settings.ros2.enabled else ()
