"""The files of a mesh's secrets, the contexts of TLS, and whether a module may start without trust.

The files of a member, and of the authority: ``trust/`` in the module's state directory.

The directory has mode 0700 and each file 0600 from the moment it exists; a file is written beside its place, synced,
and renamed. A set of files that is not whole or cannot be read is an error with a remedy: an agent never starts
without trust because its files are broken.
"""

from __future__ import annotations

import contextlib
import os
import ssl
import stat
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.config.module_name import GATEWAY_SUFFIX, as_owner, module_dir, other_state_dirs
from rmpa.core.errors import StartError
from rmpa.trust import limits
from rmpa.trust.tokens import Invitation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from rmpa.config.settings import TrustSettings

FOLDER: Final = "trust"
KEY: Final = "module.key"
CERTIFICATE: Final = "module.crt"
CA: Final = "ca.crt"
KEYS: Final = "keys.json"
DENY: Final = "deny.json"
CA_KEY: Final = "ca.key"
TOKENS: Final = "tokens.json"
ISSUED: Final = "issued.json"
AUTHORITY: Final = "authority.json"
# The key of a join by files, until its answer comes.
REQUEST_KEY: Final = "request.key"
# Files that each member must have.
_MEMBER: Final = (KEY, CERTIFICATE, CA, KEYS)
# Any of these is the sign of a module that has joined.
_SIGNS: Final = (*_MEMBER, DENY, CA_KEY, TOKENS, ISSUED, AUTHORITY)
_ALL: Final = (*_SIGNS, REQUEST_KEY)
_FILE_MAX: Final = limits.DOCUMENT_MAX
_JOIN: Final = "join again: rmpa trust invite at the authority, rmpa trust join TOKEN here; or rmpa trust leave"
_USER: Final = "run it as the user of the agent, or give the files and their folder back to that user"
_ELSEWHERE: Final = "choose another state directory: RMPA_STATE_DIR"
_OPEN: Final = os.O_CLOEXEC | os.O_NOFOLLOW


@dataclass(frozen=True, slots=True)
class MemberFiles:
    """What a member keeps.

    Args:
        key: Its private key (PEM).
        certificate: Its certificate (DER).
        ca: The CA's (DER).
        keys: The signed list of group keys.
        deny: The signed deny list; empty if nothing was revoked.
    """

    key: bytes = field(repr=False)
    certificate: bytes
    ca: bytes
    keys: bytes = field(repr=False)
    deny: bytes = b""


def unusable(what: Path | str, problem: str, remedy: str) -> StartError:
    """The error of a file of trust, or of a module that has none."""
    return StartError(str(what), problem, remedy, code="keys-unusable")


def _cannot(done: str, path: Path, error: OSError, remedy: str = "") -> StartError:
    """The error of a file or folder that cannot be read, written or removed."""
    return StartError(str(path), f"cannot be {done}: {error.strerror}", remedy, code="directory-unusable")


class Issued(msgspec.Struct, frozen=True):
    """One certificate that the authority has issued, the last of its module.

    Args:
        name: The module's.
        issued: When, seconds since 1970.
        expires: When it ends.
        hosts: The names and addresses of its page that it has, besides those that follow from its name.
        key: Its public key (SubjectPublicKeyInfo, DER).
    """

    name: str
    issued: int
    expires: int
    hosts: tuple[str, ...] = ()
    key: bytes = b""


class AuthorityPlace(msgspec.Struct, frozen=True):
    """Where a member last reached the authority.

    Args:
        name: The authority's; empty if it is not known yet.
        address: IPv4.
        port: Its mesh port.
    """

    name: str
    address: str
    port: int


class TrustStore:
    """Reads and writes the files of one module.

    Args:
        state: The state directory.
        module: The module's name.
    """

    def __init__(self, state: Path, module: str) -> None:
        self.folder = module_dir(state.absolute(), module) / FOLDER

    def path(self, name: str) -> Path:
        """Where a file is."""
        return self.folder / name

    @property
    def exists(self) -> bool:
        """Whether trust is on here: there is any of the files, whole or not.

        Raises:
            StartError: It cannot be known: a folder on the way cannot be searched, is none, or is a link that leads
                nowhere. That never counts as no.
        """
        return is_folder(self.folder) and any(_is_there(self.path(name)) for name in _SIGNS)

    @property
    def is_authority(self) -> bool:
        """Whether this module has the CA's key."""
        return _is_there(self.path(CA_KEY))

    def load(self) -> MemberFiles:
        """The files of a member.

        Raises:
            StartError: One is missing, cannot be read, belongs to another user, or others may read it.
        """
        found = {name: self._read(name) for name in _MEMBER}
        deny = self._read(DENY) if _is_there(self.path(DENY)) else b""
        return MemberFiles(found[KEY], self._der(CERTIFICATE, found), self._der(CA, found), found[KEYS], deny)

    def save(self, files: MemberFiles) -> None:
        """Write the files of a member; the certificate last, so that a set with one is whole.

        Raises:
            StartError: They cannot be written.
        """
        contents = {KEY: files.key, CA: _pem(files.ca), KEYS: files.keys, DENY: files.deny}
        for name, data in contents.items():
            if data:
                self.write(name, data)
        self.write(CERTIFICATE, _pem(files.certificate))

    def load_ca_key(self) -> bytes:
        """The CA's private key (PEM); raises as ``load``."""
        return self._read(CA_KEY, "only a copy brings it back; without one make a new mesh: rmpa trust init")

    def load_tokens(self) -> list[Invitation]:
        """The tokens of the authority; none if the file is missing.

        Raises:
            StartError: The file cannot be read or is broken.
        """
        if not _is_there(self.path(TOKENS)):
            return []
        remedy = "remove it: open tokens are then void"
        try:
            return msgspec.json.decode(self._read(TOKENS, remedy), type=list[Invitation])
        except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            raise unusable(self.path(TOKENS), f"is broken: {error!s:.200}", remedy) from None

    def save_tokens(self, invitations: Iterable[Invitation]) -> None:
        """Write the tokens of the authority; raises as ``save``."""
        self.write(TOKENS, msgspec.json.encode(list(invitations)))

    def load_issued(self) -> dict[str, Issued]:
        """The certificates of the authority, by name; none if the file is missing or broken: renewals fill it."""
        with contextlib.suppress(StartError, msgspec.MsgspecError, UnicodeError):
            return {each.name: each for each in msgspec.json.decode(self._read(ISSUED), type=list[Issued])}
        return {}

    def save_issued(self, issued: Iterable[Issued]) -> None:
        """Write the certificates of the authority; raises as ``save``."""
        self.write(ISSUED, msgspec.json.encode(list(issued)))

    def load_authority(self) -> AuthorityPlace | None:
        """Where the authority was last; ``None``: not known, or the file is broken."""
        with contextlib.suppress(StartError, msgspec.MsgspecError, UnicodeError):
            return msgspec.json.decode(self._read(AUTHORITY), type=AuthorityPlace)
        return None

    def save_authority(self, place: AuthorityPlace) -> None:
        """Write where the authority is; raises as ``save``."""
        self.write(AUTHORITY, msgspec.json.encode(place))

    def load_request_key(self) -> bytes:
        """The key (PEM) of a join by files; raises as ``load``."""
        return self._read(REQUEST_KEY, "begin again: rmpa trust join --request FILE")

    def check_writable(self) -> None:
        """Raise ``StartError`` if files cannot be written here."""
        self.write(REQUEST_KEY, b"-")
        self.forget(REQUEST_KEY)

    def forget(self, name: str) -> None:
        """Remove a file that is not needed any more, if it is there."""
        with contextlib.suppress(OSError), self._as_owner() as folder:
            (folder / name).unlink()

    def write(self, name: str, data: bytes) -> None:
        """Write one file atomically, for this user alone.

        Raises:
            StartError: It cannot be written.
        """
        try:
            self.folder.parents[1].mkdir(parents=True, exist_ok=True)
            with self._as_owner() as folder:
                _write(folder, name, data)
        except OSError as error:
            remedy = _USER if isinstance(error, PermissionError) else "is the disk full?"
            raise _cannot("written", self.path(name), error, remedy) from None

    def remove(self) -> list[str]:
        """Leave the mesh: remove all files; return the names of those that were there.

        Raises:
            StartError: One cannot be removed.
        """
        removed = [name for name in _ALL if _is_there(self.path(name))]
        if not is_folder(self.folder):
            return removed
        with self._as_owner() as folder:
            for name in removed:
                try:
                    (folder / name).unlink()
                except OSError as error:
                    raise _cannot("removed", self.path(name), error) from None
            with contextlib.suppress(OSError):
                folder.rmdir()
        return removed

    @contextlib.contextmanager
    def _as_owner(self) -> Iterator[Path]:
        """Change files with the rights of the owner of the state directory: the agent runs as that user."""
        state = self.folder.parents[1]
        with as_owner(state) as here:
            yield here / self.folder.relative_to(state)

    def _read(self, name: str, remedy: str = _JOIN) -> bytes:
        path = self.path(name)
        try:
            with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | _OPEN), "rb") as file:
                problem = _exposed(os.fstat(file.fileno()), self._owners())
                data = b"" if problem else file.read(_FILE_MAX + 1)
        except FileNotFoundError:
            raise unusable(path, "is missing", remedy) from None
        except OSError as error:
            raise _cannot("read", path, error, _USER if isinstance(error, PermissionError) else remedy) from None
        if problem:
            raise unusable(path, problem, f"if the others are trusted: chmod 600 {path}; else {remedy}")
        if not data or len(data) > _FILE_MAX:
            raise unusable(path, f"is broken: {len(data)} bytes", remedy)
        return data

    def _owners(self) -> set[int]:
        """The users that may own the files: this one and root; for root the owner of the state directory, too."""
        us = os.geteuid()
        return {us, 0} if us else {0, self.folder.parents[1].stat().st_uid}

    def _der(self, name: str, found: Mapping[str, bytes]) -> bytes:
        try:
            return ssl.PEM_cert_to_DER_cert(found[name].decode("ascii"))
        except ValueError:
            raise unusable(self.path(name), "is broken: not a certificate in PEM", _JOIN) from None


def modules_with_keys(state: Path) -> list[str]:
    """The modules with files of a secured mesh in a state directory.

    Raises:
        StartError: It cannot be known, as for ``TrustStore.exists``.
    """
    if not is_folder(state):
        return []
    try:
        names = _modules_in(state)
    except OSError as error:
        raise _cannot("read", state, error, _USER) from None
    return [name for name in names if TrustStore(state, name).exists]


def is_folder(path: Path) -> bool:
    """Whether there is a folder.

    Raises:
        StartError: It cannot be known, there is something else, or a link that leads nowhere.
    """
    try:
        if stat.S_ISDIR(path.stat().st_mode):
            return True
        problem, remedy = "is not a folder", f"remove it, if it is of no use: rm {path}"
    except FileNotFoundError:
        link = next((each for each in (path, *path.parents) if each.is_symlink() and not each.exists()), None)
        if link is None:
            return False
        path, remedy = link, "mount it, or remove the link"
        problem = f"leads to {link.readlink()}, which is not there"
    except NotADirectoryError:
        problem, remedy = "is below a file, not a folder", _ELSEWHERE
    except PermissionError as error:
        problem, remedy = f"cannot be searched: {error.strerror}", f"{_USER}; or {_ELSEWHERE}"
    except OSError as error:
        problem, remedy = f"cannot be searched: {error.strerror}", f"mend it, or {_ELSEWHERE}"
    raise unusable(path, f"{problem}, so whether this module has joined a secured mesh is not known", remedy)


def _is_there(path: Path) -> bool:
    """Whether there is a file; ``True`` also if that cannot be known, so that an error never turns trust off."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True
    return True


def _pem(certificate: bytes) -> bytes:
    return ssl.DER_cert_to_PEM_cert(certificate).encode()


def _exposed(info: os.stat_result, owners: set[int]) -> str:
    """Why a file may have been read or changed by others; empty: it was not."""
    if not stat.S_ISREG(info.st_mode):
        return "is not a file"
    if info.st_uid not in owners:
        return f"belongs to user {info.st_uid}"
    if info.st_mode & 0o077:
        return f"can be read by others (mode {stat.S_IMODE(info.st_mode):o})"
    return ""


def _write(folder: Path, name: str, data: bytes) -> None:
    temporary = folder / f".{name}.{os.getpid()}"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()  # of a run that was killed, with this process id
        with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _OPEN, 0o600), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(folder / name)
        _sync_folder(folder)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def _sync_folder(folder: Path) -> None:
    """Make a rename survive a power failure."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# The ``ssl.SSLContext`` of members, and of modules that join. TLS 1.3 alone, no resumption.


# Protocol of a link inside TLS (RFC 7301).
ALPN_LINK: Final = "rmpa/1"
# Protocol of a join, and of a renewal with a certificate that has ended.
ALPN_JOIN: Final = "rmpa-join/1"
# X509_V_FLAG_NO_CHECK_TIME of OpenSSL, which Python has no name for.
_NO_CHECK_TIME: Final = 0x200000


def member_context(certificate: Path, key: Path, ca: bytes, *alpn: str, server_side: bool) -> ssl.SSLContext:
    """The context of a member.

    The chain of the other side is verified; its name, times and revocation are judged behind the handshake, where
    the reason can be told.

    Args:
        certificate: The file of this module's certificate (PEM).
        key: The file of its key (PEM).
        ca: The CA's certificate (DER), the only one that is trusted.
        alpn: The protocols.
        server_side: Whether it is for accepted connections. A module that joins has no certificate yet.

    Raises:
        StartError: The key is not the certificate's, or a file cannot be used.
    """
    context = _context(server_side=server_side)
    context.verify_mode = ssl.CERT_OPTIONAL if server_side else ssl.CERT_REQUIRED
    context.verify_flags = ssl.VerifyFlags(context.verify_flags | _NO_CHECK_TIME)
    context.set_alpn_protocols(list(alpn))
    try:
        context.load_cert_chain(certificate, key)
        context.load_verify_locations(cadata=ca)
    except OSError as error:
        remedy = "join again: rmpa trust invite at the authority, rmpa trust join TOKEN here"
        raise unusable(certificate, f"does not fit {key.name}, or is broken: {error!s:.100}", remedy) from None
    return context


def join_context() -> ssl.SSLContext:
    """For a module that joins: the token's fingerprint decides on the server."""
    context = _context(server_side=False)
    context.verify_mode = ssl.CERT_NONE
    context.set_alpn_protocols([ALPN_JOIN])
    return context


def _context(*, server_side: bool) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server_side else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the module's name is its identity, and is compared with the hello's
    if server_side:
        context.num_tickets = 0  # a resumed session would outlive a revocation
    return context


# Whether a module may start without trust. Not beside keys of this user's other modules, unless that is said.
#
# A name or a state directory that was forgotten must not start a module of a secured mesh as an open one.


_SHOWN = 5


def check_open(
    trust: TrustSettings, state: Path | None, module: str, environ: Mapping[str, str], option: str = "--name"
) -> None:
    """Check that a module without files of trust may start, and that this is what the user wants.

    Args:
        trust: The settings: ``require`` forbids it, ``insecure`` permits it also beside other modules' keys.
        state: The state directory in use; ``None``: there is none.
        module: The module, which has no files of trust there.
        environ: Says where other state directories are.
        option: The command's option for a name, for errors.

    Raises:
        StartError: It may not; or another module, or another state directory, has keys of a secured mesh, or it
            cannot be known.
    """
    if trust.require:
        problem = f"the module {module} has joined no secured mesh"
        remedy = "join one: rmpa trust join TOKEN, with a token of rmpa trust invite at the authority"
        raise StartError("trust.require", problem, remedy, code="not-a-member")
    if trust.insecure:
        return
    here = modules_with_keys(state) if state is not None else []
    if here:
        start = [f"start as {name}: {option} {name}" for name in _startable(here, module)]
        raise _refused(module, f"{_listed(here)} here in {state}", start)
    # First where its own keys are.
    for place, there in sorted(keys_elsewhere(state, environ), key=lambda each: module not in each[1]):
        names = [module] if module in there else _startable(there, module)
        start = [f"start with RMPA_STATE_DIR={place} {option} {name}" for name in names]
        raise _refused(module, f"{_listed(there)} in {place}", start)


def keys_elsewhere(state: Path | None, environ: Mapping[str, str]) -> list[tuple[Path, list[str]]]:
    """The modules with keys in other state directories of this user than the one in use, as far as they are known."""
    return [(place, there) for place in other_state_dirs(environ, state) if (there := _keys_in(place))]


def _startable(names: list[str], module: str) -> list[str]:
    """As which module to start instead: a gateway is none, and has a name of its own."""
    modules = [name for name in names if not name.endswith(GATEWAY_SUFFIX)]
    return modules[:1] if len(modules) == 1 and not module.endswith(GATEWAY_SUFFIX) else []


def _refused(module: str, others: str, start: list[str]) -> StartError:
    problem = f"has no keys, and would start without trust, beside keys of {others}"
    join = f"let {module} join: rmpa trust join TOKEN --name {module}"
    open_word = "start it open: --insecure (insecure = true in [trust])"
    return unusable(f"the module {module}", problem, "; or ".join((*start, join, open_word)))


def _keys_in(place: Path) -> list[str]:
    """The modules with keys in a state directory that is not in use; none if it is another user's."""
    try:
        return [name for name in _modules_in(place) if _may_have_keys(place, name)]
    except OSError:
        return []


def _modules_in(state: Path) -> list[str]:
    return sorted(entry.name for entry in os.scandir(state) if entry.is_symlink() or entry.is_dir())


def _may_have_keys(place: Path, name: str) -> bool:
    """Whether a module has keys, or a folder of its own that is broken says that it may have."""
    try:
        return TrustStore(place, name).exists
    except StartError:
        return True


def _listed(names: list[str]) -> str:
    shown = ", ".join(names[:_SHOWN])
    return f"{shown} and {len(names) - _SHOWN} more" if len(names) > _SHOWN else shown
