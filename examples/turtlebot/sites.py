"""The demo's two sites: which modules are where, and the processes that join them.

Each site has a multicast port of its own, so that its modules do not meet those of the other site. A gateway at each
site connects to a router, as it would from behind NAT; nobody connects to a site.
"""

from __future__ import annotations

SITES = {"office": ("joystick", "pc"), "field": ("velocity", "base")}
"""The modules of each site: the commands go from the office to the field, and the odometry comes back."""
ROUTER = "router"
"""The Zenoh router that both gateways connect to, such as one in a cloud."""
GATEWAYS = {f"{site}_gateway": site for site in SITES}
"""The gateway of each site."""
JOINING = (ROUTER, *GATEWAYS)
"""What runs besides the modules."""


def site_of(name: str) -> str:
    """The site of a module or a gateway; empty for the router, which is at none."""
    here = [site for site, modules in SITES.items() if name in modules]
    return here[0] if here else GATEWAYS.get(name, "")


def gateway_options(name: str, router_port: int) -> list[str]:
    """The options of ``rmpa gateway`` for the router or a site's gateway, without those of the mesh."""
    endpoint = f"tcp/127.0.0.1:{router_port}"
    if name == ROUTER:
        return ["--router", "--listen", endpoint]
    return ["--site", GATEWAYS[name], "--connect", endpoint]
