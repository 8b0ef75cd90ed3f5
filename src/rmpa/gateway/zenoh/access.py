"""Which certificates may use a router, and the session of a gateway that is secured by its module's certificate.

Zenoh's table of access knows the name in a certificate alone. So a router has one rule: members may use the keys of
sites, and those that were revoked may use nothing. Which topics, services and parameters a site may have is judged by
the gateways at both ends, and by the modules.
"""

from __future__ import annotations

import json
import logging
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from rmpa.agent.trust import trust_store
from rmpa.config.peer_rules import Effect
from rmpa.core.errors import RemoteProtocolError, StartError
from rmpa.gateway.zenoh.config import MeshCertificates, gateway_config, zenohd_entries
from rmpa.gateway.zenoh.session import open_session
from rmpa.trust.limits import CERTIFICATE_LIFETIME, RENEWAL_SHARE
from rmpa.trust.store import CA, CERTIFICATE, DENY, KEY

if TYPE_CHECKING:
    from rmpa.config.settings import Settings
    from rmpa.gateway.zenoh.config import ZenohConfig
    from rmpa.gateway.zenoh.session import OpenSession

_log = logging.getLogger(__name__)
_MESSAGES: Final = (
    *("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)
# The keys of sites; ``**`` alone fits no chunk that begins with ``@``, as the caches of latched topics do.
_SITES: Final = ("rmpa/1/**", "rmpa/1/**/@adv/**")
_ALL: Final = ("**", "**/@adv/**", "@ros2_lv/**")
# Where zenohd listens if the settings name no endpoint.
_LISTEN: Final = ("tls/0.0.0.0:7447",)
_HEAD: Final = """\
// For zenohd 1.10 or later; made by rmpa gateway zenoh-config from [gateway] and [trust].
// Both sides show a certificate of the mesh. zenohd reads this file and the certificates once, at its start: start
// it again when the certificate is renewed (each {days:g} days), or a module was revoked.
"""


def session_config(settings: Settings) -> tuple[ZenohConfig, str]:
    """What the gateway's session is opened with, and what its table of access cannot say.

    Raises:
        StartError: As ``gateway_config``; or the certificates are not whole, or other users can read them.
    """
    store = trust_store(settings)
    certificates = None
    if store is not None and store.exists:
        store.load()
        certificates = MeshCertificates(*(str(store.path(name)) for name in (CA, CERTIFICATE, KEY)))
    config = gateway_config(settings.gateway, certificates)
    if certificates is None or not config.listen:
        return config, ""
    table, note = access_table(settings)
    return replace(config, access_control=table), note


def access_table(settings: Settings) -> tuple[dict[str, object], str]:
    """Zenoh's ``access_control``: members may use the keys of sites, revoked modules nothing.

    Zenoh allows a certificate what it allows to everybody, whatever is denied to its name. So once a module was
    revoked, the others are named, which the mesh's authority alone can do.

    Returns:
        The table, and what it cannot say.
    """
    keys = _ALL if settings.trust.default == Effect.ALLOW else _SITES
    if settings.gateway.ros2.enabled:
        domain = settings.gateway.ros2.domain
        keys = (*keys, "@ros2_lv/**", f"{domain}/**", f"{domain}/**/@adv/**")
    subject: dict[str, object] = {"id": "members"}
    note = ""
    if revoked := revoked_modules(settings):
        if known := known_modules(settings):
            subject["cert_common_names"] = sorted(set(known) - set(revoked))
        else:
            names = ", ".join(revoked)
            note = f"{names}: revoked, and let in until the certificate ends; let the authority be the router"
    rule = {"id": "sites", "permission": "allow", "flows": ["ingress", "egress"]}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [{**rule, "messages": list(_MESSAGES), "key_exprs": list(dict.fromkeys(keys))}],
        "subjects": [subject],
        "policies": [{"rules": ["sites"], "subjects": ["members"]}],
    }, note


async def open_trusted_session(settings: Settings) -> OpenSession:
    """Open the session that the settings ask for.

    Raises:
        StartError: It may not be opened without certificates, an address is taken, or no router answers.
    """
    config, note = session_config(settings)
    if note:
        _log.warning("! zenoh: %s", note)

    def changed() -> bool:
        """Whether the table of access would be another one now: a module was revoked, or has joined since."""
        try:
            return session_config(settings)[0].access_control != config.access_control
        except StartError:
            return False  # files are being written

    return await open_session(config, changed)


def zenohd_config(settings: Settings) -> str:
    """A configuration file (JSON5) for zenohd, as a router between sites.

    Raises:
        StartError: The module has joined no secured mesh, and ``insecure`` is not set; or its files are broken.
    """
    gateway = replace(settings.gateway, router=True, listen=settings.gateway.listen or _LISTEN)
    config, note = session_config(replace(settings, gateway=gateway))
    text = _HEAD.format(days=CERTIFICATE_LIFETIME * RENEWAL_SHARE / 86_400) + (f"// Note: {note}\n" if note else "")
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
