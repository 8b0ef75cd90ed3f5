"""What ``rmpa --version`` says: the release, the commit, and which formats this program speaks."""

from __future__ import annotations

from pathlib import Path

import rmpa


def long_version() -> str:
    """The version with the commit: what the build wrote down, else what git says of the clone."""
    if rmpa.COMMIT:
        return f"{rmpa.VERSION} ({rmpa.COMMIT}, {rmpa.DATE})"
    source = Path(rmpa.__file__).parents[1]
    script = source.with_name("scripts") / "version"
    if source.name != "src" or not script.exists():
        return rmpa.__version__
    import runpy

    names = runpy.run_path(str(script))
    return str(names["long"](*names["build"]()))


def about() -> dict[str, object]:
    """What a bug report should tell: ``rmpa --version --json``."""
    import platform

    libc, libc_version = platform.libc_ver()
    return {
        "version": long_version(),
        "protocols": {name: number for name, (number, _) in protocols().items()},
        "python": platform.python_version(),
        "libc": f"{libc} {libc_version}",
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }


def protocols() -> dict[str, tuple[int | str, str]]:
    """The number of each format that other programs or later runs read, and what has it.

    docs/reference/compatibility.md shows them of each release; tests/golden has bytes of each.
    """
    from rmpa.discovery import beacon
    from rmpa.gateway.sites import keys
    from rmpa.mesh import frames
    from rmpa.resource import saved
    from rmpa.ros.core import state
    from rmpa.ros.types import descriptor
    from rmpa.trust import packets, store, tokens
    from rmpa.web import api
    from rmpa.web.monitor import messages

    return {
        "beacon": (beacon.VERSION, "how modules find each other (UDP)"),
        "link": (frames.VERSION, "how modules speak with each other (TCP): handshake, frames, control messages"),
        "secured link": (store.ALPN_LINK, "links with trust on, inside TLS 1.3"),
        "join": (store.ALPN_JOIN, "`rmpa trust join` and renewals"),
        "beacon proof": (packets.FORMAT, "the trailer of beacons with trust on"),
        "join token": (tokens.FORMAT, "what `rmpa trust invite` prints"),
        "sites": (keys.VERSION, "gateways over Zenoh: keys, tokens, attachments"),
        "monitor": (messages.SUBPROTOCOL, "the pages of `rmpa web`"),
        "REST": (api.PREFIX, "the JSON of `rmpa web`"),
        "resource": (descriptor.VERSION, "the descriptor of a Smart Resource, a topic"),
        "core file": (state.FORMAT, "`core-PORT.state`: registrations and parameters over a restart"),
        "resource file": (saved.FORMAT, "`RESOURCE.json`: what a Smart Resource keeps"),
    }
