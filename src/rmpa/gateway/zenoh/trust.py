"""The session of a gateway, secured by its module's certificate, and the same as a configuration for zenohd."""

from __future__ import annotations

import json
import logging
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from rmpa.agent.trust import trust_store
from rmpa.core.errors import RemoteProtocolError, StartError
from rmpa.gateway.zenoh.access import access_table
from rmpa.gateway.zenoh.config import MeshCertificates, gateway_config, zenohd_entries
from rmpa.gateway.zenoh.session import open_session
from rmpa.trust.limits import CERTIFICATE_LIFETIME, RENEWAL_SHARE
from rmpa.trust.store import CA, CERTIFICATE, DENY, KEY

if TYPE_CHECKING:
    from rmpa.config.rules import GatewaySettings
    from rmpa.config.settings import Settings
    from rmpa.gateway.zenoh.config import ZenohConfig
    from rmpa.gateway.zenoh.session import OpenSession

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
    from rmpa.trust.certificates import ca_public_key  # noqa: PLC0415 - they need the extra rmpa[trust]
    from rmpa.trust.documents import read_deny_list  # noqa: PLC0415

    try:
        deny = read_deny_list(files.deny, ca_public_key(files.ca))
    except RemoteProtocolError as error:
        raise StartError(str(store.path(DENY)), f"is broken: {error}", "see rmpa trust status") from None
    ended = time.time() - CERTIFICATE_LIFETIME
    return tuple(sorted(entry.name for entry in deny.entries if entry.before > ended))


def foreign_keys(settings: GatewaySettings) -> tuple[str, ...]:
    """Key expressions of neighbours that are no sites: each certificate of the mesh may use them."""
    return ("@ros2_lv/**", f"{settings.ros2.domain}/**") if settings.ros2.enabled else ()
