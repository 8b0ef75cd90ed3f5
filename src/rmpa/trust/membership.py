"""What a module has as a member of a secured mesh: certificate, group keys, deny list, contexts of TLS.

The authority is the member that has the CA's key: it invites, renews and revokes.
"""

from __future__ import annotations

import contextlib
import logging
import os
import ssl
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import msgspec
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RemoteProtocolError, StartError
from rmpa.core.identity import peer_name_problem
from rmpa.trust import certificates, limits
from rmpa.trust.certificates import (
    CURVE,
    DenyList,
    KeyList,
    ModuleCertificate,
    read_certificate,
    read_document,
    sign,
)
from rmpa.trust.packets import GroupKey, KeyRing, PacketTrust
from rmpa.trust.permissions import Document, TrustError, TrustReason, server_names
from rmpa.trust.store import (
    ALPN_JOIN,
    ALPN_LINK,
    CA_KEY,
    CERTIFICATE,
    DENY,
    KEY,
    KEYS,
    Issued,
    MemberFiles,
    member_context,
    unusable,
)
from rmpa.trust.tokens import CertificateGrant, Invitation, Token, fingerprint_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator
    from ipaddress import IPv4Address

    from rmpa.runtime.loop import SystemClock
    from rmpa.trust.certificates import CertificateRequest
    from rmpa.trust.store import TrustStore

_log = logging.getLogger(__name__)


def new_key() -> bytes:
    """A private key (PKCS #8, PEM) for a module or a CA."""
    return ec.generate_private_key(CURVE).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def private_key(data: bytes, where: str) -> ec.EllipticCurvePrivateKey:
    """Read a private key (PEM).

    Args:
        data: The PEM.
        where: The file, for the error.

    Raises:
        StartError: It is none.
    """
    try:
        key = serialization.load_pem_private_key(data, None)
    except (ValueError, TypeError):
        key = None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise unusable(where, "is broken: not a private key in PEM", "join again, or take it from a copy")
    return key


_REMEDY: Final = "join again: rmpa trust invite at the authority, rmpa trust join TOKEN here"


class Membership:
    """This module's part in a secured mesh. Its parts are replaced at a renewal and by newer documents.

    The machine's clock counts as *set* while it shows a time after the beginning of the module's own certificate.
    While it is not, no times are checked: neither of packets nor of certificates.

    Args:
        store: The files, which newer documents are written to.
        files: What is in them.
        clock: The machine's clocks, set or not.

    Raises:
        StartError: A file is broken, or they do not belong together.
    """

    def __init__(self, store: TrustStore, files: MemberFiles, clock: SystemClock) -> None:
        self.store = store
        self.files = files
        self._clock = clock
        with _named(store, CERTIFICATE):
            self._ca_key = certificates.ca_public_key(files.ca)
            self.certificate = read_certificate(files.certificate, files.ca)
        with _named(store, KEYS):
            # The list of group keys that holds.
            self.keys = read_document(files.keys, self._ca_key, KeyList)
        with _named(store, DENY):
            # The deny list that holds.
            self.deny = read_document(files.deny, self._ca_key, DenyList) if files.deny else DenyList()
        proves_from, age = self.keys.proves_from, self._age(self.keys, limits.KEY_SPREAD)
        self.ring = KeyRing(self.keys.keys, clock.now(), proves_from=proves_from, age=age)
        self.packets = PacketTrust(self.ring, self.wall)
        # Called after a newer deny list holds: links that match end at once.
        self.on_denied: list[Callable[[], None]] = []
        self._make_contexts()

    @classmethod
    def load(cls, store: TrustStore, clock: SystemClock) -> Membership:
        """Read the files of a member; arguments and errors as for the class."""
        return cls(store, store.load(), clock)

    def __repr__(self) -> str:
        """Name and numbers alone: secrets never come into a log."""
        return f"Membership({self.name!r}, deny={self.deny.number}, keys={self.keys.number})"

    @property
    def name(self) -> str:
        """The module's name, as its certificate proves it."""
        return self.certificate.name

    def number(self, kind: Document) -> int:
        """The number of the document that holds."""
        return self.deny.number if kind is Document.DENY else self.keys.number

    def document(self, kind: Document) -> bytes:
        """A document that holds, signed; empty: there is none yet."""
        return self.files.deny if kind is Document.DENY else self.files.keys

    def wall(self) -> float | None:
        """Seconds since 1970; ``None`` while the machine's clock is not set."""
        wall = self._clock.wall_ns() / 1e9
        return wall if wall > self.certificate.issued - limits.CERTIFICATE_BACKDATE else None

    def read_member(self, certificate: bytes | None) -> ModuleCertificate:
        """What the certificate (DER) of another module says, if it is one of this mesh.

        Raises:
            TrustError: There is none, or it is of another CA (``foreign``).
        """
        if certificate is None:
            raise TrustError(TrustReason.FOREIGN, "it has no certificate")
        return read_certificate(certificate, self.files.ca)

    def judge_member(self, certificate: ModuleCertificate, claimed: str | None) -> None:
        """Check the certificate of another module; ``claimed`` is the name in its hello, if that is known.

        Raises:
            TrustError: It is not valid yet (``clock``), ``expired``, of another module (``name``), or ``revoked``.
        """
        certificate.judge(self.wall(), claimed or "", self.deny)

    def request(self, hosts: Iterable[str] = ()) -> bytes:
        """A request (DER) for a newer certificate of this module and its key, with these hosts of its page."""
        key = private_key(self.files.key, str(self.store.path(KEY)))
        return certificates.make_request(key, self.name, hosts)

    def accept_document(self, kind: Document, data: bytes) -> bool:
        """Take a signed document if it is newer than the one that holds; return whether it is.

        A new group key signs ``limits.KEY_SPREAD`` after it was made, or at once if a revocation made it. A document
        that cannot be written holds all the same, until the agent ends.

        Raises:
            LimitExceeded: It is too long.
            RemoteProtocolError: It is malformed, or not signed by this mesh's authority.
        """
        form: type[DenyList | KeyList] = DenyList if kind is Document.DENY else KeyList
        newer = read_document(data, self._ca_key, form)
        if newer.number <= self.number(kind):
            return False
        if isinstance(newer, DenyList):
            self.deny, self.files = newer, replace(self.files, deny=data)
            for call in tuple(self.on_denied):  # before a slow disk is written
                call()
        else:
            self.keys, self.files = newer, replace(self.files, keys=data)
            self.ring.take(newer.keys, self._clock.now(), proves_from=newer.proves_from, age=self._age(newer, 0.0))
        try:
            self.store.write(DENY if kind is Document.DENY else KEYS, data)
        except StartError as error:
            _log.error("! %s [%s]", error, error.code)
        return True

    def take_grant(self, grant: CertificateGrant) -> None:
        """Take a newer certificate and the documents beside it; raises as ``renewed`` and ``accept_document``."""
        self.renewed(grant.certificate)
        for kind, data in ((Document.DENY, grant.deny), (Document.KEYS, grant.keys)):
            if data:
                self.accept_document(kind, data)

    def renewed(self, certificate: bytes) -> None:
        """Take a newer certificate (DER) of this module and its key: links that come up from now on have it.

        Raises:
            TrustError: It is of another CA, another module, another key, or not valid now.
            StartError: It cannot be written; the one before goes on.
        """
        found = read_certificate(certificate, self.files.ca)
        found.judge(self.wall(), self.name)
        if found.public_key != self.certificate.public_key:
            raise TrustError(TrustReason.FOREIGN, "the certificate is of another key")
        self.store.write(CERTIFICATE, ssl.DER_cert_to_PEM_cert(certificate).encode())
        self.certificate, self.files = found, replace(self.files, certificate=certificate)
        self._make_contexts()

    def _age(self, keys: KeyList, unknown: float) -> float:
        """Seconds since the newest group key was made; ``unknown`` where a clock is not set."""
        wall = self.wall()
        return unknown if wall is None or not keys.made else max(0.0, wall - keys.made)

    def _make_contexts(self) -> None:
        """Make the contexts for connections that are accepted, joins at the authority too, and for dialled ones."""
        files, ca = (self.store.path(CERTIFICATE), self.store.path(KEY)), self.files.ca
        joins = [ALPN_JOIN] if self.store.is_authority else []
        self.server_context = member_context(*files, ca, ALPN_LINK, *joins, server_side=True)
        self.client_context = member_context(*files, ca, ALPN_LINK, server_side=False)


@contextlib.contextmanager
def _named(store: TrustStore, name: str) -> Iterator[None]:
    """Turns an error about what is in a file into one that names the file."""
    try:
        yield
    except RemoteProtocolError as error:
        raise unusable(store.path(name), f"is broken: {error}", _REMEDY) from None


_SERIAL_BITS: Final = 159
_CLOCK: Final = "set it first (date, timedatectl): certificates with a wrong time are of no use elsewhere"


def found_mesh(store: TrustStore, name: str, label: str, wall: float) -> None:
    """Make a new mesh, whose authority and first member is this module.

    Args:
        store: Where its files are written.
        name: The module's name.
        label: What users call the mesh.
        wall: Seconds since 1970.

    Raises:
        StartError: The clock is not set, or a file cannot be written.
    """
    if wall < limits.EARLIEST_TIME:
        raise StartError("the clock of this machine", "is not set", _CLOCK, code="clock-not-set")
    ca_pem, key_pem = new_key(), new_key()
    ca_key, key = private_key(ca_pem, CA_KEY), private_key(key_pem, KEY)
    ca = certificates.make_ca(ca_key, label, _serial(), wall)
    request = certificates.read_request(certificates.make_request(key, name))
    certificate = certificates.issue(request, ca, ca_key, _serial(), wall)
    keys = KeyList(1, (GroupKey(1, os.urandom(limits.GROUP_KEY_BYTES)),), name)
    store.write(CA_KEY, ca_pem)
    store.save(MemberFiles(key_pem, certificate, ca, sign(keys, ca_key)))
    store.save_issued([_issued(name, wall, request.public_key)])


class MeshAuthority:
    """Issues certificates and signs documents; writes what it changes at once.

    Args:
        membership: This module's, whose store has the CA's key, and which newer documents are given to.
        is_linked: Whether a member that is linked has a name; by default none is, as no agent runs.

    Raises:
        StartError: The CA's key is another one, or a file is broken.
    """

    def __init__(self, membership: Membership, is_linked: Callable[[str], bool] = lambda _: False) -> None:
        self.membership = membership
        self._is_linked = is_linked
        self._store = store = membership.store
        self._ca_key = private_key(store.load_ca_key(), str(store.path(CA_KEY)))
        if self._ca_key.public_key() != certificates.ca_public_key(membership.files.ca):
            raise unusable(store.path(CA_KEY), "is not the key of ca.crt", "take it from a copy")
        self._issued = store.load_issued()
        # The tokens, by their ids: each lets one module join once.
        self.invitations = {each.token_id: each for each in store.load_tokens()}

    @property
    def issued(self) -> tuple[Issued, ...]:
        """The last certificate of each module, by name."""
        return tuple(sorted(self._issued.values(), key=lambda each: each.name))

    def invite(self, address: IPv4Address, port: int, lifetime: float, name: str = "") -> Token:
        """A new token.

        Args:
            address: Where the joining module reaches this one.
            port: The mesh port.
            lifetime: Seconds of its validity.
            name: The module that it is for, whose open tokens it replaces; empty for any.

        Raises:
            StartError: The clock is not set, or the file cannot be written.
            ValueError: No module can have that name, or nothing can be reached at the address.
        """
        if name and (problem := peer_name_problem(name)):
            raise ValueError(problem)
        secret, known = os.urandom(limits.TOKEN_SECRET_BYTES), self.invitations
        token = Token(int(self.wall() + lifetime), address, port, fingerprint_of(self.membership.files.ca), secret)
        self._end_open(name)
        while len(known) >= limits.TOKENS_MAX:
            del known[min(known, key=lambda each: (not known[each].used_by, known[each].expires))]
        known[token.token_id] = Invitation(token.token_id, token.key, token.expires, name)
        self.save_tokens()
        return token

    def _end_open(self, name: str) -> None:
        """Forget the tokens for a module, not for any, that were not used."""
        for each in tuple(self.invitations.values()):
            if name and each.name == name and not each.used_by:
                del self.invitations[each.token_id]

    def withdraw(self, token_id: bytes) -> bool:
        """Make a token that was not used void; return whether there was one."""
        invitation = self.invitations.get(token_id)
        if invitation is None or invitation.used_by:
            return False
        del self.invitations[token_id]
        self.save_tokens()
        return True

    def save_tokens(self) -> None:
        """Write the tokens, one of which was used."""
        self._store.save_tokens(self.invitations.values())

    def wall(self) -> float:
        """Seconds since 1970.

        Raises:
            StartError: The clock is not set.
        """
        wall = self.membership.wall()
        if wall is None:
            raise StartError("the clock of this machine", "is not set", _CLOCK, code="clock-not-set")
        return wall

    def _wall_for(self, name: str) -> float:
        """The time at which a certificate of a module is issued: behind its revocation, also in the same second."""
        entry = next((entry for entry in self.membership.deny.entries if entry.name == name), None)
        return self.wall() if entry is None else max(self.wall(), entry.before + 1.0)

    def issue(self, request: bytes, name: str = "") -> tuple[CertificateRequest, bytes]:
        """A certificate (DER) for a request (DER), which it returns too.

        Args:
            request: PKCS #10.
            name: The member that renews its certificate; empty for a module that joins.

        Raises:
            TrustError: The request is malformed or of another module, or a module with another key has joined
                under this name since.
            StartError: The clock is not set, or a file cannot be written.
        """
        asked = certificates.read_request(request)
        if name and asked.name != name:
            raise TrustError(TrustReason.NAME, f"{name} asks for a certificate of {asked.name}")
        last = self._issued.get(asked.name)
        if name and last is not None and last.key not in (b"", asked.public_key):
            raise TrustError(TrustReason.REVOKED, f"another module has joined as {name} since")
        ca = self.membership.files.ca
        hosts, wall = self._granted(asked), self._wall_for(asked.name)
        certificate = certificates.issue(asked, ca, self._ca_key, _serial(), wall, hosts=hosts)
        self._issued[asked.name] = _issued(asked.name, wall, asked.public_key, hosts)
        while len(self._issued) > limits.ISSUED_MAX:
            del self._issued[min(self._issued, key=lambda each: self._issued[each].expires)]
        self._store.save_issued(self.issued)
        deny = self.membership.deny
        if asked.name not in deny.members and deny.in_force(self.wall()):
            self._publish(msgspec.structs.replace(deny, number=deny.number + 1))
        return asked, certificate

    def grant(self, request: bytes, name: str = "") -> CertificateGrant:
        """A certificate, and what else a member has; arguments and errors as for ``issue``."""
        _, certificate = self.issue(request, name)
        member = self.membership
        return CertificateGrant(certificate, member.files.ca, member.files.keys, member.files.deny)

    def _granted(self, asked: CertificateRequest) -> tuple[str, ...]:
        """Of the hosts that a module asks for those that are of no other module: the first one that asks has them."""
        wall = self.wall()
        taken = {
            host
            for name, issued in self._issued.items()
            if name != asked.name
            for host in (*server_names(name), *(issued.hosts if issued.expires > wall else ()))
        }
        return tuple(host for host in asked.hosts if host not in taken)

    def judge_renewal(self, certificate: bytes) -> ModuleCertificate:
        """The certificate (DER) of a module that was away, if it may be renewed.

        Raises:
            TrustError: It is of another CA, ended too long ago, or was revoked.
        """
        found = self.membership.read_member(certificate)
        found.judge(self.wall(), deny=self.membership.deny, grace=limits.RENEWAL_GRACE)
        return found

    def renew_own(self, hosts: Iterable[str] = ()) -> None:
        """Renew the certificate of the authority itself, with these hosts of its page; raises as ``issue``."""
        _, certificate = self.issue(self.membership.request(hosts))
        self.membership.renewed(certificate)

    def is_member(self, name: str, again: str) -> bool:
        """Whether a module of a name is linked, or has a certificate that has not ended, be it present or not.

        Names that differ in case alone would have the same names for browsers.

        Args:
            name: The name.
            again: A module that may join again, or empty: its certificate does not count.
        """
        now, folded = self.wall(), name.casefold()
        issued = (each.name for each in self._issued.values() if each.expires > now)
        return self._is_linked(name) or any(each.casefold() == folded and each != again for each in issued)

    def join_file(self, request: bytes, again: str = "") -> tuple[CertificateRequest, CertificateGrant]:
        """The answer to a request (DER) in a join by files.

        Args:
            request: PKCS #10.
            again: The name of a member that may join again, as of an invitation for it.

        Raises:
            ConfigError: Another member has the name.
            RmpaError: As ``issue``.
        """
        asked = certificates.read_request(request)
        name = asked.name
        if self.is_member(name, again):
            text = f"a module named {name} is a member"
            remedy = f"if it is that one, and away: --module {name}; else rmpa trust revoke {name}, or another name"
            raise ConfigError("the request", text, remedy)
        return asked, self.grant(request)

    def revoke_known(self, name: str, linked: Collection[str] = (), *, force: bool = False) -> DenyList:
        """Revoke a module that a user names; return the new list.

        Args:
            name: The module's.
            linked: The names of the linked modules.
            force: Also if no certificate of that name is known here.

        Raises:
            ConfigError: It is this module, or no member is known by that name.
            StartError: The clock is not set, or a file cannot be written.
        """
        if name == self.membership.name:
            text = f"{name} is the authority itself"
            raise ConfigError("NAME", text, "a new authority is a new mesh: rmpa trust leave, rmpa trust init")
        known = {*self._issued, *linked} - {self.membership.name}
        if name not in known and not force:
            similar = did_you_mean(name, sorted(known))
            remedy = f"did you mean {similar}?" if similar else "rmpa trust status lists them"
            raise ConfigError("NAME", f"no module {name} has a certificate of this mesh", f"{remedy}; or add --force")
        try:
            return self.revoke(name)
        except ValueError as error:
            raise ConfigError("NAME", str(error)) from None

    def revoke(self, name: str) -> DenyList:
        """Refuse all certificates of a module from now on, and make a new group key; return the new list.

        Its open tokens are withdrawn. A file that cannot be written is only logged.

        Raises:
            StartError: The clock is not set.
            ValueError: No module can have that name, or the list is full.
        """
        last = self._issued.get(name)  # later than now, if the clock went back since
        deny = self.membership.deny.with_name(name, max(self.wall(), last.issued if last is not None else 0.0))
        self._issued.pop(name, None)
        deny = self._publish(deny)
        self.rotate(revoking=True)  # before files are written: a full disk must not leave the old key in use
        self._end_open(name)
        left, wall = self.invitations.values(), self.wall()
        if open_to_all := sum(not (each.used_by or each.name) and each.expires > wall for each in left):
            _log.warning(
                "! %d unused tokens are for any name: %s can join again with one of them [member-revoked]",
                open_to_all,
                name,
            )
        try:
            self._store.save_issued(self.issued)
            self.save_tokens()
        except StartError as error:
            _log.error("! %s is revoked, but not all files are written: %s [directory-unusable]", name, error)
        return deny

    def _publish(self, deny: DenyList) -> DenyList:
        """Sign a newer deny list, with the modules that have certificates now; return it."""
        wall = self.wall()
        members = tuple(each.name for each in self.issued if each.expires > wall)
        deny = msgspec.structs.replace(deny, members=members)
        self.membership.accept_document(Document.DENY, sign(deny, self._ca_key))
        return deny

    def rotate(self, *, revoking: bool = False) -> int:
        """Make a new group key; return its number.

        Args:
            revoking: Whether a module that has the keys before was revoked: from now on they only recognise.
        """
        member = self.membership
        ring, wall = member.ring, member.wall()
        key = GroupKey(ring.newest.number + 1, os.urandom(limits.GROUP_KEY_BYTES))
        keys = KeyList(
            member.keys.number + 1,
            (*ring.keys, key)[-limits.KEYS_MAX :],
            member.name,
            proves_from=key.number if revoking else member.keys.proves_from,
            made=0 if wall is None else int(wall),
        )
        member.accept_document(Document.KEYS, sign(keys, self._ca_key))
        return key.number


def request_pem(request: bytes) -> bytes:
    """A request (DER) as PEM, for a file."""
    pem = ssl.DER_cert_to_PEM_cert(request)
    return pem.replace(" CERTIFICATE-", " CERTIFICATE REQUEST-").encode()


def request_der(pem: bytes) -> bytes:
    """The request (DER) in a file.

    Raises:
        ValueError: It is not PEM of a request.
    """
    text = pem.decode("ascii").strip()
    if "BEGIN CERTIFICATE REQUEST" not in text:
        raise ValueError("it does not begin with BEGIN CERTIFICATE REQUEST")
    return ssl.PEM_cert_to_DER_cert(text.replace(" CERTIFICATE REQUEST-", " CERTIFICATE-"))


def _serial() -> int:
    return int.from_bytes(os.urandom(20), "big") >> (160 - _SERIAL_BITS) or 1


def _issued(name: str, wall: float, key: bytes, hosts: tuple[str, ...] = ()) -> Issued:
    return Issued(name, int(wall), int(wall) + limits.CERTIFICATE_LIFETIME, hosts, key)
