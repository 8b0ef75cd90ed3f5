"""Signed, numbered documents of the authority: the deny list and the list of group keys (docs/design/trust.md).

A document is the JSON object ``{"signed": TEXT, "signature": BASE64}``: TEXT is a JSON object too, and the signature
(ECDSA P-256, SHA-256, DER) is over the kind's label, a zero byte and TEXT. So it can be checked before TEXT is
parsed, and no document can stand for one of the other kind. Of two documents the one with the higher number holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec

from rmpa.config.peer_rules import ACTION_CLIENT, ACTION_SERVER, PEER, Access, Effect, PermissionRule
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import matches, peer_name_problem
from rmpa.core.limits import UINT32_MAX
from rmpa.trust import limits
from rmpa.trust.packets import GroupKey

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.config.settings import TrustSettings

_ALGORITHM: Final = ec.ECDSA(hashes.SHA256())


class DocumentKind(StrEnum):
    """What a document is; the value is the label under its signature."""

    DENY = "rmpa deny 1"
    KEYS = "rmpa keys 1"


class DocumentError(RemoteProtocolError):
    """A document is malformed, or not signed by the authority."""


class _Signed(msgspec.Struct, frozen=True):
    signed: str
    signature: bytes


class DenyEntry(msgspec.Struct, frozen=True):
    """One revoked module.

    Args:
        name: The module's.
        before: Certificates of that name that were issued up to this time are refused; seconds since 1970.
    """

    name: str
    before: int


class DenyList(msgspec.Struct, frozen=True):
    """The names that were revoked.

    Args:
        number: Grows with each change; 0: nothing was ever revoked.
        entries: One for each name.
    """

    number: int = 0
    entries: tuple[DenyEntry, ...] = ()

    def denies(self, name: str, issued: float) -> bool:
        """Whether a certificate is refused.

        Args:
            name: The module that it is of.
            issued: When it was issued, seconds since 1970.
        """
        return any(entry.name == name and issued <= entry.before for entry in self.entries)

    def with_name(self, name: str, wall: float) -> DenyList:
        """The list after a revocation.

        Args:
            name: The module, whose present certificates are all refused.
            wall: When the last of them was issued, or later; seconds since 1970. The time of an entry never goes
                back.

        Raises:
            ValueError: No module can have that name, or the list is full.
        """
        if problem := peer_name_problem(name):
            raise ValueError(problem)
        before = max([int(wall), *(entry.before for entry in self.entries if entry.name == name)])
        entries = (*(entry for entry in self.entries if entry.name != name), DenyEntry(name, before))
        if len(entries) > limits.DENY_MAX:
            raise ValueError(f"a deny list has at most {limits.DENY_MAX} names; make a new mesh (rmpa trust init)")
        return DenyList(self.number + 1, entries)


class _KeyEntry(msgspec.Struct, frozen=True):
    number: int
    key: bytes

    def __repr__(self) -> str:
        return f"_KeyEntry({self.number})"


class KeyList(msgspec.Struct, frozen=True):
    """The group keys of a mesh. It is secret: only members get it, over their links.

    Args:
        number: Grows with each change.
        keys: By number.
        authority: The name of the authority, so that no other member can pass for it; empty: not known.
        proves_from: The number of the key that the last revocation made: a revoked module has those before.
        made: When the newest key was made, by the authority's clock in seconds since 1970; 0: it was not set.
    """

    number: int
    keys: tuple[_KeyEntry, ...]
    authority: str = ""
    proves_from: int = 0
    made: int = 0

    @classmethod
    def of(
        cls, number: int, keys: Iterable[GroupKey], authority: str = "", *, proves_from: int = 0, made: int = 0
    ) -> KeyList:
        """The list of these keys; arguments as for the class."""
        entries = tuple(_KeyEntry(key.number, key.secret) for key in keys)
        return cls(number, entries, authority, proves_from, made)

    @property
    def group_keys(self) -> tuple[GroupKey, ...]:
        """The keys."""
        return tuple(GroupKey(entry.number, entry.key) for entry in self.keys)

    def __repr__(self) -> str:
        """The numbers alone: secrets never come into a log."""
        return f"KeyList(number={self.number}, keys={[entry.number for entry in self.keys]})"


_T = TypeVar("_T", DenyList, KeyList)


def sign(document: DenyList | KeyList, key: ec.EllipticCurvePrivateKey) -> bytes:
    """A document with the CA's signature, as it is sent and stored."""
    kind = DocumentKind.DENY if isinstance(document, DenyList) else DocumentKind.KEYS
    text = msgspec.json.encode(document).decode()
    return msgspec.json.encode(_Signed(text, key.sign(_under_signature(kind, text), _ALGORITHM)))


def read_deny_list(data: bytes, key: ec.EllipticCurvePublicKey) -> DenyList:
    """Read a signed deny list.

    Args:
        data: As ``sign`` made it.
        key: The CA's key.

    Raises:
        LimitExceeded: It is too long.
        DocumentError: It is malformed, or not signed with that key.
    """
    found = _read(data, key, DocumentKind.DENY, DenyList)
    if len(found.entries) > limits.DENY_MAX:
        raise DocumentError(f"{len(found.entries)} names on a deny list")
    for entry in found.entries:
        if problem := peer_name_problem(entry.name):
            raise DocumentError(problem)
    return found


def read_key_list(data: bytes, key: ec.EllipticCurvePublicKey) -> KeyList:
    """Read a signed list of group keys; arguments and errors as for ``read_deny_list``."""
    found = _read(data, key, DocumentKind.KEYS, KeyList)
    if not 0 < len(found.keys) <= limits.KEYS_MAX:
        raise DocumentError(f"{len(found.keys)} group keys")
    if found.authority and (problem := peer_name_problem(found.authority)):
        raise DocumentError(problem)
    try:
        numbers = [each.number for each in found.group_keys]
    except ValueError as error:
        raise DocumentError(str(error)) from None
    if len(set(numbers)) != len(numbers):
        raise DocumentError("two group keys of one number")
    return found


def _read(data: bytes, key: ec.EllipticCurvePublicKey, kind: DocumentKind, form: type[_T]) -> _T:
    if len(data) > limits.DOCUMENT_MAX:
        raise LimitExceeded("a signed document", len(data), limits.DOCUMENT_MAX)
    try:
        envelope = msgspec.json.decode(data, type=_Signed)
        key.verify(envelope.signature, _under_signature(kind, envelope.signed), _ALGORITHM)
        document = msgspec.json.decode(envelope.signed, type=form)
    except InvalidSignature:
        raise DocumentError("the document is not signed by our authority") from None
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise DocumentError(f"the document cannot be read: {error!s:.200}") from None
    if not 0 <= document.number <= UINT32_MAX:
        raise DocumentError(f"the document's number is {document.number}")
    return document


def _under_signature(kind: DocumentKind, text: str) -> bytes:
    return kind.value.encode() + b"\x00" + text.encode()


# How signed documents reach every module: which linked peer lacks which document (docs/design/trust.md).
#
# Each module tells a new link the numbers of its documents (``trust.have``); the side with a higher number sends
# that
# document, deny list first. A module that takes a newer one sends it on to all that are not known to have it. So a
# document is everywhere after as many trips as the mesh is wide, and in a mesh that was split once it is whole
# again.


class Notice(StrEnum):
    """The notifications between two agents; the value is their name on the wire."""

    HAVE = "trust.have"
    """``{"deny": 7, "keys": 3}``: the numbers that the sender has; ``"authority": true`` at the authority."""
    DENY = "trust.deny"
    """``{"document": TEXT}``: the signed deny list."""
    KEYS = "trust.keys"
    """Likewise: the signed list of group keys."""


DOCUMENTS: Final = (Notice.DENY, Notice.KEYS)
"""The documents in the order in which they are sent: a module that was revoked gets no new key."""


class DocumentSpreading:
    """Knows what each linked peer has.

    Args:
        number: The number of the document that this module has.
    """

    def __init__(self, number: Callable[[Notice], int]) -> None:
        self._number = number
        self._known: dict[int, dict[Notice, int]] = {}

    def link_up(self, peer: int) -> None:
        """A peer is linked; it has not said what it has."""
        self._known[peer] = {}

    def link_down(self, peer: int) -> None:
        """A peer is not linked any more."""
        self._known.pop(peer, None)

    def have(self, peer: int, numbers: Mapping[Notice, int]) -> tuple[Notice, ...]:
        """A peer said what it has; return the documents that it is to be sent."""
        known = self._known.get(peer)
        if known is None:
            return ()
        for kind, number in numbers.items():
            known[kind] = max(number, known.get(kind, 0))
        return self._take(peer, DOCUMENTS)

    def received(self, peer: int, kind: Notice, number: int) -> None:
        """A peer sent a valid document, so it has it."""
        known = self._known.get(peer)
        if known is not None:
            known[kind] = max(number, known.get(kind, 0))

    def changed(self) -> list[tuple[int, tuple[Notice, ...]]]:
        """This module has newer documents: each peer that is known to lack some, and which."""
        return [(peer, lacking) for peer in list(self._known) if (lacking := self._take(peer, DOCUMENTS))]

    def _take(self, peer: int, kinds: tuple[Notice, ...]) -> tuple[Notice, ...]:
        """The documents that a peer lacks; they count as sent."""
        known = self._known[peer]
        lacking = tuple(kind for kind in kinds if kind in known and known[kind] < self._number(kind))
        for kind in lacking:
            known[kind] = self._number(kind)
        return lacking


def have_args(number: Callable[[Notice], int], *, is_authority: bool) -> dict[str, Any]:
    """The arguments of ``trust.have``."""
    args: dict[str, Any] = {kind.removeprefix("trust."): number(kind) for kind in DOCUMENTS}
    return args | {"authority": True} if is_authority else args


def read_have(args: Mapping[str, Any]) -> tuple[dict[Notice, int], bool]:
    """The numbers that a peer has, and whether it is the authority.

    Raises:
        RemoteProtocolError: They are malformed.
    """
    numbers = {kind: args.get(kind.removeprefix("trust.")) for kind in DOCUMENTS}
    checked = {
        kind: number
        for kind, number in numbers.items()
        if isinstance(number, int) and not isinstance(number, bool) and 0 <= number <= UINT32_MAX
    }
    if len(checked) != len(numbers):
        raise RemoteProtocolError("trust.have without the numbers of two documents")
    return checked, args.get("authority") is True


def read_document(args: Mapping[str, Any]) -> bytes:
    """The document in ``trust.deny`` or ``trust.keys``.

    Raises:
        RemoteProtocolError: There is none.
    """
    text = args.get("document")
    if not isinstance(text, str):
        raise RemoteProtocolError("a notification without its document")
    return text.encode()


# Decides what another module may do here, by the rules of ``[[permission]]``, and names the rule that decided.
#
# A rule fits if it is about the module (by a glob over its name, or a group) and one of its globs fits the name. A
# deny
# that fits wins over an allow, whatever the order of the rules; if none fits, ``trust.default`` holds.


_CLIENT_SENDS: Final = ("goal", "cancel")
"""An action's topics that its client publishes (wiki.ros.org/actionlib/DetailedDescription)."""
_SERVER_SENDS: Final = ("status", "feedback", "result")
"""An action's topics that its server publishes."""
_ACTION_TOPICS: Final = {
    (ACTION_CLIENT, Access.PUBLISH): _CLIENT_SENDS,
    (ACTION_CLIENT, Access.SUBSCRIBE): _SERVER_SENDS,
    (ACTION_SERVER, Access.PUBLISH): _SERVER_SENDS,
    (ACTION_SERVER, Access.SUBSCRIBE): _CLIENT_SENDS,
}
_DONE: Final = {
    Access.PUBLISH: "publish",
    Access.SUBSCRIBE: "subscribe to",
    Access.CALL: "call",
    Access.SERVE: "serve",
    Access.PARAM: "read or set",
    Access.KILL: "end",
}
"""Each access as a verb, for texts."""


@dataclass(frozen=True, slots=True)
class PermissionDecision:
    """Whether a module may do something here, and the rule that decided.

    Args:
        allowed: Whether it may.
        rule: The rule as text: ``[[permission]] 2 denies call of '/motors/**' to '*'``.
        number: The number of the rule in the file, from 1; ``None``: ``trust.default`` decided.
    """

    allowed: bool
    rule: str
    number: int | None = None


@dataclass(frozen=True, slots=True)
class _Pattern:
    """One glob over names, of one rule, for one module."""

    glob: str
    effect: Effect
    number: int
    text: str


class Permissions:
    """The permissions of other modules in this one.

    Args:
        settings: The rules, the groups and the default.
    """

    def __init__(self, settings: TrustSettings) -> None:
        self._known: dict[str, dict[Access, tuple[_Pattern, ...]]] = {}
        self.reload(settings)

    def reload(self, settings: TrustSettings) -> None:
        """Judge by other rules from now on."""
        self._settings = settings
        self._groups = {group.name: group.modules for group in settings.groups}
        self._known.clear()

    @property
    def direct(self) -> bool:
        """Whether nodes may connect to those of other machines directly, in plain text (``trust.direct``)."""
        return self._settings.direct

    def judge(self, access: Access, module: str, name: str) -> PermissionDecision:
        """Decide whether a module may do something.

        Args:
            access: What it would do.
            module: Its name, as its certificate proves it.
            name: The topic, service, parameter or node, by its name here.
        """
        for pattern in self._patterns(module)[access]:
            if matches(pattern.glob, name):
                return PermissionDecision(pattern.effect is Effect.ALLOW, pattern.text, pattern.number)
        if self._settings.default == Effect.ALLOW:
            return PermissionDecision(True, 'no [[permission]] fits, and trust.default = "allow"')
        return PermissionDecision(False, f"no [[permission]] lets {module} {_DONE[access]} {name}")

    def may_relay(self, module: str) -> PermissionDecision:
        """Decide whether a module may pass on what others offer: the origin that it names cannot be proved."""
        for glob in self._settings.relays:
            if matches(glob, module):
                return PermissionDecision(True, f"trust.relays has {glob!r}")
        return PermissionDecision(False, f"trust.relays does not have {module}")

    def groups_of(self, module: str) -> tuple[str, ...]:
        """The groups that a module is in, in the order of the file."""
        return tuple(name for name, globs in self._groups.items() if _first(globs, module) is not None)

    def _patterns(self, module: str) -> dict[Access, tuple[_Pattern, ...]]:
        """The globs of the rules about a module, by access, those that deny first."""
        known = self._known.get(module)
        if known is None:
            if len(self._known) >= limits.MODULES_REMEMBERED:
                self._known.clear()
            found: dict[Access, list[_Pattern]] = {access: [] for access in Access}
            for number, rule in enumerate(self._settings.rules, 1):
                for access, pattern in self._rule_patterns(number, rule, module):
                    found[access].append(pattern)
            # sorted() is stable: among denials, and among allowances, the order of the file stays.
            known = self._known[module] = {
                access: tuple(sorted(patterns, key=lambda p: p.effect is Effect.ALLOW))
                for access, patterns in found.items()
            }
        return known

    def _rule_patterns(self, number: int, rule: PermissionRule, module: str) -> Iterator[tuple[Access, _Pattern]]:
        """The globs of one rule, if it is about a module."""
        whom = self._fit(rule, module)
        if whom is None:
            return
        verb = "allows" if rule.effect is Effect.ALLOW else "denies"
        for key, globs in rule.names.items():
            for written in globs:
                text = f"[[permission]] {number} {verb} {key} of {written!r} to {whom}"
                filled = written.replace(PEER, module)
                if key not in (ACTION_CLIENT, ACTION_SERVER):
                    yield Access(key), _Pattern(filled, rule.effect, number, text)
                    continue
                for access, topic in action_topics(key, filled):
                    yield access, _Pattern(topic, rule.effect, number, text)

    def _fit(self, rule: PermissionRule, module: str) -> str | None:
        """Why a rule is about a module, as text; ``None``: it is not."""
        glob = _first(rule.modules, module)
        if glob is not None:
            return repr(glob)
        for name in rule.groups:
            if _first(self._groups.get(name, ()), module) is not None:
                return f"group {name!r}"
        return None


def refusal(access: Access, module: str, name: str, where: str = "there") -> str:
    """What a refused module is told: that it may not, and nothing of the rules."""
    return f"the permissions {where} do not let {module} {_DONE[access]} {name}"


def prohibition(access: Access, module: str, name: str) -> str:
    """That a module may not do something: ``arm2 may not publish /cmd_vel``."""
    return f"{module} may not {_DONE[access]} {name}"


def action_topics(key: str, name: str) -> Iterator[tuple[Access, str]]:
    """The five topics of an action, each with what the other module does with it.

    Args:
        key: ``ACTION_CLIENT`` if the other module is the client, ``ACTION_SERVER`` if it is the server.
        name: The action's name, or a glob.
    """
    for access in (Access.PUBLISH, Access.SUBSCRIBE):
        for topic in _ACTION_TOPICS[key, access]:
            yield access, f"{name.rstrip('/')}/{topic}"


def _first(globs: tuple[str, ...], name: str) -> str | None:
    """The first glob that fits."""
    return next((glob for glob in globs if matches(glob, name)), None)
