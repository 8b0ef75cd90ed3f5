"""The authority of a mesh: the module that has the CA's key invites, renews and revokes.

The authority of a mesh: the module that has the CA's key invites, renews and revokes.
"""

from __future__ import annotations

import logging
import os
import ssl
from typing import TYPE_CHECKING, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, StartError
from rmpa.trust import certificates, limits
from rmpa.trust import store as files_of
from rmpa.trust.certificates import DenyList, KeyList, sign
from rmpa.trust.membership import new_key, private_key
from rmpa.trust.packets import GroupKey
from rmpa.trust.permissions import Document, TrustError, TrustReason, server_names
from rmpa.trust.store import Issued, MemberFiles
from rmpa.trust.tokens import CertificateGrant, Token, fingerprint_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable
    from ipaddress import IPv4Address

    from rmpa.trust.certificates import CertificateRequest, ModuleCertificate
    from rmpa.trust.membership import Membership
    from rmpa.trust.store import TrustStore

_log = logging.getLogger(__name__)
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
        raise StartError("the clock of this machine", "is not set", _CLOCK)
    ca_pem, key_pem = new_key(), new_key()
    ca_key, key = private_key(ca_pem, files_of.CA_KEY), private_key(key_pem, files_of.KEY)
    ca = certificates.make_ca(ca_key, label, _serial(), wall)
    request = certificates.read_request(certificates.make_request(key, name))
    certificate = certificates.issue(request, ca, ca_key, _serial(), wall)
    keys = KeyList(1, (GroupKey(1, os.urandom(limits.GROUP_KEY_BYTES)),), name)
    store.write(files_of.CA_KEY, ca_pem)
    store.save(MemberFiles(key_pem, certificate, ca, sign(keys, ca_key)))
    store.save_issued([_issued(name, wall, request.public_key)])


class MeshAuthority:
    """Issues certificates and signs documents; writes what it changes at once.

    Args:
        membership: This module's, whose store has the CA's key, and which newer documents are given to.

    Raises:
        StartError: The CA's key is another one, or a file is broken.
    """

    def __init__(self, membership: Membership) -> None:
        self.membership = membership
        self._store = store = membership.store
        self._ca_key = private_key(store.load_ca_key(), str(store.path(files_of.CA_KEY)))
        if self._ca_key.public_key() != certificates.ca_public_key(membership.files.ca):
            raise StartError(str(store.path(files_of.CA_KEY)), "is not the key of ca.crt", "take it from a copy")
        self._issued = store.load_issued()
        # The tokens.
        self.book = store.load_tokens()

    @property
    def issued(self) -> tuple[Issued, ...]:
        """The last certificate of each module, by name."""
        return tuple(sorted(self._issued.values(), key=lambda each: each.name))

    # --- invitations ------------------------------------------------------------------------------------------

    def invite(self, address: IPv4Address, port: int, lifetime: float, name: str = "") -> Token:
        """A new token.

        Args:
            address: Where the joining module reaches this one.
            port: The mesh port.
            lifetime: Seconds of its validity.
            name: The module that it is for; empty for any.

        Raises:
            StartError: The clock is not set, or the file cannot be written.
            ValueError: No module can have that name, or nothing can be reached at the address.
        """
        secret = os.urandom(limits.TOKEN_SECRET_BYTES)
        token = Token(int(self.wall() + lifetime), address, port, fingerprint_of(self.membership.files.ca), secret)
        self.book.invite(token, name)
        self.save_tokens()
        return token

    def withdraw(self, token_id: bytes) -> bool:
        """Make a token that was not used void; return whether there was one."""
        withdrawn = self.book.withdraw(token_id)
        if withdrawn:
            self.save_tokens()
        return withdrawn

    def save_tokens(self) -> None:
        """Write the tokens, one of which was used."""
        self._store.save_tokens(self.book)

    # --- certificates -----------------------------------------------------------------------------------------

    def wall(self) -> float:
        """Seconds since 1970.

        Raises:
            StartError: The clock is not set.
        """
        wall = self.membership.wall()
        if wall is None:
            raise StartError("the clock of this machine", "is not set", _CLOCK)
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
        member = self.membership
        return certificates.verify(
            certificate, member.files.ca, self.wall(), deny=member.deny, grace=limits.RENEWAL_GRACE
        )

    def renew_own(self, hosts: Iterable[str] = ()) -> None:
        """Renew the certificate of the authority itself, with these hosts of its page; raises as ``issue``."""
        _, certificate = self.issue(self.membership.request(hosts))
        self.membership.renewed(certificate)

    def has_issued(self, name: str, again: str = "") -> bool:
        """Whether a module of a name has a certificate that has not ended, be it present or not.

        Names that differ in case alone would have the same names for browsers.

        Args:
            name: The name.
            again: A module that may join again: its certificate does not count.
        """
        now, folded = self.wall(), name.casefold()
        issued = (each.name for each in self._issued.values() if each.expires > now)
        return any(each.casefold() == folded and each != again for each in issued)

    def join_file(
        self, request: bytes, again: str = "", is_linked: Callable[[str], bool] = lambda _: False
    ) -> tuple[CertificateRequest, CertificateGrant]:
        """The answer to a request (DER) in a join by files.

        Args:
            request: PKCS #10.
            again: The name of a member that may join again, as of an invitation for it.
            is_linked: Whether a module that is linked has a name.

        Raises:
            ConfigError: Another member has the name.
            RmpaError: As ``issue``.
        """
        asked = certificates.read_request(request)
        name = asked.name
        if is_linked(name) or self.has_issued(name, again):
            text = f"a module named {name} is a member"
            remedy = f"if it is that one, and away: --module {name}; else rmpa trust revoke {name}, or another name"
            raise ConfigError("the request", text, remedy)
        return asked, self.grant(request)

    # --- documents --------------------------------------------------------------------------------------------

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
        self.membership.accept_document(Document.DENY, sign(deny, self._ca_key))
        self._issued.pop(name, None)
        self.rotate(revoking=True)  # before files are written: a full disk must not leave the old key in use
        unused = [each for each in self.book.invitations if not each.used_by]
        for invitation in unused:
            if invitation.name == name:
                self.book.withdraw(invitation.token_id)
        if open_to_all := sum(not each.name and each.expires > self.wall() for each in unused):
            _log.warning("! %d open tokens are for any name: %s can join again with one", open_to_all, name)
        try:
            self._store.save_issued(self.issued)
            self.save_tokens()
        except StartError as error:
            _log.error("! %s is revoked, but not all files are written: %s", name, error)
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
