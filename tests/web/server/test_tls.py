"""HTTPS and WSS with the user's certificate; the files of ``tls/`` were made for these tests alone."""

from __future__ import annotations

import asyncio
import ssl
import time
from pathlib import Path
from typing import TYPE_CHECKING

import aiohttp
import pytest

from rmpa.core.errors import ConfigError, StartError
from rmpa.trust.store import MemberFiles, TrustStore
from rmpa.web import limits
from rmpa.web.server.access import AccessPolicy, own_names
from rmpa.web.server.agent_watch import AgentWatch
from rmpa.web.server.app import WebServer
from rmpa.web.server.process import CertificateFiles, ServerCertificate, certificate_files, tls_context
from tests.waiting import DEADLINE
from tests.web.snapshots import FULL as SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

FILES = Path(__file__).with_name("tls")
CERT, KEY = str(FILES / "cert.pem"), str(FILES / "key.pem")
TOKEN = "secret-" * 6
HOSTS = own_names(("base",))


@pytest.fixture
async def server() -> AsyncIterator[WebServer]:
    watch = AgentWatch(lambda: SNAPSHOT)
    policy = AccessPolicy(0, own_names(("base",)), TOKEN)
    made = WebServer(watch, policy, "127.0.0.1", tls=tls_context(CertificateFiles(CERT, KEY)))
    await made.start()
    yield made
    await made.close()


async def test_a_page_comes_over_https_and_its_cookie_stays_there(server: WebServer) -> None:
    trusted = ssl.create_default_context(cafile=CERT)
    async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(ssl=trusted)) as session:
        url = f"https://127.0.0.1:{server.port}/?token={TOKEN}"
        async with session.get(url, allow_redirects=False) as response:
            assert response.status == 303
            cookie = response.headers["Set-Cookie"]
            assert "Secure" in cookie
            assert "HttpOnly" in cookie
        headers = {"Authorization": f"Bearer {TOKEN}", "Origin": f"https://127.0.0.1:{server.port}"}
        async with session.get(f"https://127.0.0.1:{server.port}/api/v1/agent", headers=headers) as response:
            assert response.status == 200
        forged = headers | {"Origin": f"http://127.0.0.1:{server.port}"}  # whoever is on the way can make that page
        async with session.get(f"https://127.0.0.1:{server.port}/api/v1/agent", headers=forged) as response:
            assert response.status == 403


async def test_http_at_an_https_port_gets_no_answer_and_harms_nothing(server: WebServer) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    answer = await asyncio.wait_for(reader.read(), DEADLINE)
    assert b"HTTP" not in answer
    writer.close()
    trusted = ssl.create_default_context(cafile=CERT)
    async with (
        aiohttp.ClientSession() as session,
        session.get(f"https://127.0.0.1:{server.port}/healthz", ssl=trusted) as response,
    ):
        assert response.status == 200


def test_without_a_certificate_it_is_http() -> None:
    assert tls_context(CertificateFiles()) is None


@pytest.mark.parametrize(
    ("cert", "key", "problem"),
    [
        ("/no/such.pem", KEY, "no such file"),
        (CERT, str(FILES / "other.pem"), "cannot be used with its key"),
        (CERT, str(FILES / "encrypted.pem"), "cannot be used with its key"),
        (KEY, KEY, "cannot be used with its key"),
        (CERT, "", "cannot be used with its key"),
    ],
)
def test_files_that_cannot_be_used_are_told(cert: str, key: str, problem: str) -> None:
    with pytest.raises(StartError, match=problem):
        tls_context(CertificateFiles(cert, key))


def test_the_users_certificate_wins_over_the_modules_own(tmp_path: Path) -> None:
    store = TrustStore(tmp_path, "base")
    assert certificate_files(CERT, KEY, store) == CertificateFiles(CERT, KEY)
    assert certificate_files("", "", None) == CertificateFiles()
    with pytest.raises(ConfigError, match="key without a certificate"):
        certificate_files("", KEY, store)


def test_a_broken_set_of_files_never_means_plain_http(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "base" / "trust"
    folder.mkdir(parents=True)
    (folder / "module.crt").write_text("something")
    with pytest.raises(StartError, match=r"module\.key: is missing; join again"):
        certificate_files("", "", TrustStore(tmp_path, "base"))
    assert "run it as the agent's user, or name a --cert" in caplog.text


def test_files_that_do_not_fit_yet_are_tried_again(tmp_path: Path) -> None:
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    cert.write_bytes(Path(CERT).read_bytes())
    key.write_bytes(Path(KEY).read_bytes())
    served = ServerCertificate(CertificateFiles(str(cert), str(key)))
    assert not served.renew()
    key.write_bytes((FILES / "other.pem").read_bytes())
    assert not served.renew()
    key.unlink()
    assert not served.renew()
    key.write_bytes(Path(KEY).read_bytes())
    assert served.renew()
    assert not served.renew()


async def test_the_modules_certificate_serves_browsers_that_trust_the_ca_and_its_renewal_is_served_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cryptography")
    from cryptography.hazmat.primitives import serialization

    from tests.trust.authority import Authority, new_key

    lab, wall = Authority(), time.time()
    store = TrustStore(tmp_path, "base")

    def join() -> None:
        key = new_key()
        plain = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
        files = MemberFiles(key.private_bytes(*plain), lab.module("base", wall, key), lab.certificate, b"{}")
        store.save(files)

    join()
    files = certificate_files("", "", store)
    monkeypatch.setattr(limits, "CERTIFICATE_LOOK_PERIOD", 0.02)
    certificate = ServerCertificate(files)
    server = WebServer(AgentWatch(lambda: SNAPSHOT), AccessPolicy(0, HOSTS), "127.0.0.1", tls=certificate.context)
    await server.start()
    certificate.start()
    browser = ssl.create_default_context(cadata=ssl.DER_cert_to_PEM_cert(lab.certificate))

    async def connect(host: str) -> asyncio.StreamWriter:
        while True:
            try:
                return (await asyncio.open_connection("127.0.0.1", server.port, ssl=browser, server_hostname=host))[1]
            except ConnectionResetError:  # seldom, and seen in this test alone: a browser tries again too
                await asyncio.sleep(0)

    async def serial(host: str) -> int:
        """The number of the certificate that a browser gets, which has checked it and the host's name."""
        writer = await connect(host)
        shown = writer.get_extra_info("peercert")
        writer.close()
        await writer.wait_closed()
        return int(shown["serialNumber"], 16)

    try:
        first = {await serial(host) for host in ("base", "base.local", "localhost", "127.0.0.1")}
        assert len(first) == 1
        with pytest.raises(ssl.SSLCertVerificationError, match="Hostname mismatch"):
            await serial("arm.local")
        join()
        async with asyncio.timeout(DEADLINE):
            while await serial("base.local") in first:
                await asyncio.sleep(0)
    finally:
        await certificate.close()
        await server.close()
