"""A secured fleet: a router with rules, and gateways with certificates of one mesh, on loopback."""

from __future__ import annotations

import time
from pathlib import Path

from rmpa.config.peer_rules import PermissionRule
from rmpa.config.rules import GatewaySettings
from rmpa.config.settings import Settings, TrustSettings
from rmpa.gateway.zenoh.session import OpenSession, open_trusted_session
from tests.gateway.zenoh_bed import free_port
from tests.trust.io.member_files import SecuredMesh


class Fleet:
    """A router with a certificate and rules, and gateways that connect to it."""

    def __init__(self, folder: Path) -> None:
        self.mesh = SecuredMesh(folder)
        self.endpoint = f"tls/127.0.0.1:{free_port()}"
        self._opened: list[OpenSession] = []

    def settings(self, name: str, gateway: GatewaySettings, trust: TrustSettings | None = None) -> Settings:
        self.mesh.save(name, time.time())
        return Settings(name=name, state_dir=str(self.mesh.folder), gateway=gateway, trust=trust or TrustSettings())

    async def router(self, *rules: PermissionRule, default: str = "deny") -> OpenSession:
        gateway = GatewaySettings(listen=(self.endpoint,), router=True)
        return await self.open(self.settings("fleet", gateway, TrustSettings(default=default, rules=rules)))

    async def open(self, settings: Settings) -> OpenSession:
        opened = await open_trusted_session(settings)
        self._opened.append(opened)
        return opened

    async def gateway(self, name: str) -> OpenSession:
        return await self.open(self.settings(name, GatewaySettings(connect=(self.endpoint,))))

    async def close(self) -> None:
        for opened in reversed(self._opened):
            await opened.close()
