"""The session of a gateway, secured by its module's certificate, and the same as a configuration for zenohd."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from rmpa.agent.trust import trust_store
from rmpa.core.errors import StartError
from rmpa.gateway.zenoh.access import access_table
from rmpa.gateway.zenoh.config import MeshCertificates, gateway_config, zenohd_entries
from rmpa.gateway.zenoh.session import open_session
from rmpa.trust.io.store import CA, CERTIFICATE, KEY
from rmpa.trust.limits import CERTIFICATE_LIFETIME, RENEWAL_SHARE

if TYPE_CHECKING:
    from rmpa.config.gateway_rules import GatewaySettings
    from rmpa.config.settings import Settings
    from rmpa.gateway.zenoh.config import ZenohConfig
    from rmpa.gateway.zenoh.session import OpenSession

_log = logging.getLogger(__name__)
_LISTEN: Final = ("tls/0.0.0.0:7447",)
"""Where zenohd listens if the settings name no endpoint."""
_HEAD: Final = """\
// For zenohd 1.10 or later; made by rmpa gateway zenoh-config from [gateway], [trust] and [[permission]].
// Both sides show a certificate of the mesh. zenohd reads this file and the certificates once, at its start: start
// it again when the certificate is renewed (each {days:g} days) or a permission has changed.
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
    table = access_table(settings.trust, known_modules(settings), foreign_keys(settings.gateway))
    return replace(config, access_control=table.entries), table.notes


async def open_trusted_session(settings: Settings) -> OpenSession:
    """Open the session that the settings ask for.

    Raises:
        StartError: It may not be opened without certificates, an address is taken, or no router answers.
    """
    config, notes = session_config(settings)
    for note in notes:
        _log.warning("! zenoh: %s", note)
    return await open_session(config)


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


def foreign_keys(settings: GatewaySettings) -> tuple[str, ...]:
    """Key expressions of neighbours that are no sites: each certificate of the mesh may use them."""
    keys: list[str] = []
    if settings.ros2.enabled:
        keys += ["@ros2_lv/**", f"{settings.ros2.domain}/**"]
    if settings.ros1_bridge:
        namespace = settings.ros1_bridge_namespace
        keys.append("ros1_discovery_info/**")
        if namespace != "*":
            keys.append(f"*/*/{namespace}/**")
    return tuple(keys)
