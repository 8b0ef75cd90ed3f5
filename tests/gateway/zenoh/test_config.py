"""From settings to Zenoh's configuration, without I/O."""

from __future__ import annotations

import pytest

from rmpa.config.rules import GatewaySettings
from rmpa.core.errors import StartError
from rmpa.gateway import limits
from rmpa.gateway.zenoh.config import MeshCertificates, gateway_config, zenohd_entries

FILES = MeshCertificates("ca.crt", "module.crt", "module.key")


@pytest.mark.parametrize(
    ("settings", "mode"),
    [
        (GatewaySettings(connect=("tls/fleet.example:7447",)), "client"),
        (GatewaySettings(connect=("tls/fleet.example:7447",), listen=("tls/0.0.0.0:7447",)), "peer"),
        (GatewaySettings(listen=("tls/0.0.0.0:7447",), router=True), "router"),
    ],
)
def test_what_only_connects_is_a_client_so_that_it_works_behind_nat(settings: GatewaySettings, mode: str) -> None:
    config = gateway_config(settings, FILES)
    assert config.mode is mode
    tls = config.entries()["transport/link/tls"]
    assert isinstance(tls, dict)
    assert (tls["enable_mtls"], tls["root_ca_certificate"]) == (True, "ca.crt")


@pytest.mark.parametrize(
    ("endpoint", "certificates", "why", "remedy"),
    [
        ("tcp/10.0.0.1:7447", None, "tcp is not encrypted", "tls/10.0.0.1:7447, or say --insecure"),
        ("tcp/10.0.0.1:7447", FILES, "tcp is not encrypted", "write tls/10.0.0.1:7447"),
        ("tls/10.0.0.1:7447", None, "joined no secured mesh", "rmpa trust join"),
        ("tcp/0.0.0.0:7447", None, "tcp is not encrypted", "--insecure"),
    ],
)
def test_an_endpoint_that_is_not_secure_is_refused_and_named(
    endpoint: str, certificates: MeshCertificates | None, why: str, remedy: str
) -> None:
    for settings in (GatewaySettings(connect=(endpoint,)), GatewaySettings(listen=(endpoint,))):
        with pytest.raises(StartError) as refused:
            gateway_config(settings, certificates)
        assert endpoint in str(refused.value)
        assert why in refused.value.problem
        assert remedy in refused.value.remedy
        assert refused.value.code == ("invalid-value" if certificates else "not-a-member")


@pytest.mark.parametrize("endpoint", ["tcp/localhost:7447", "tcp/127.0.0.1:7447", "tcp/[::1]:7447#iface=lo"])
def test_loopback_needs_no_certificate(endpoint: str) -> None:
    assert gateway_config(GatewaySettings(connect=(endpoint,)), None).certificates is None


@pytest.mark.parametrize(
    ("uplink", "buffer", "batch"), [(125_000, 15_625, 7812), (1000, 4096, 2048), (100_000_000, 12_500_000, 65_535)]
)
def test_a_thin_line_gets_small_buffers_below_the_priorities(uplink: int, buffer: int, batch: int) -> None:
    config = gateway_config(GatewaySettings(connect=("tls/10.0.0.1:7447",), uplink=uplink), FILES)
    entries = config.entries()
    assert entries["transport/link/tcp/so_sndbuf"] == entries["transport/link/tls/so_sndbuf"] == buffer
    assert entries["transport/link/tx/batch_size"] == batch
    tls = entries["transport/link/tls"]
    assert isinstance(tls, dict)
    assert tls["enable_mtls"] is True
    assert list(entries).index("transport/link/tls") < list(entries).index("transport/link/tls/so_sndbuf")


def test_insecure_lets_everything_connect() -> None:
    settings = GatewaySettings(connect=("tcp/10.0.0.1:7447",), insecure=True)
    assert "transport/link/tls" not in gateway_config(settings, None).entries()


def test_the_file_for_zenohd_has_the_same_entries_nested() -> None:
    config = gateway_config(GatewaySettings(listen=("tls/0.0.0.0:7447",)), FILES)
    nested = zenohd_entries(config)
    assert nested["mode"] == "router"
    transport = nested["transport"]
    assert isinstance(transport, dict)
    assert transport["link"]["tls"]["listen_certificate"] == "module.crt"
    assert transport["link"]["tx"]["lease"] == round(limits.LEASE * 1000)
