from __future__ import annotations

import socket
from typing import TYPE_CHECKING

import pytest

from rmpa.ros.aio import liveness
from rmpa.ros.aio.liveness import listening_ports

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def listening() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        yield sock


def test_ports_that_somebody_listens_at_are_seen_and_others_are_not(listening: socket.socket) -> None:
    port = listening.getsockname()[1]
    with socket.create_connection(("127.0.0.1", port)) as client:
        ports = listening_ports()
        assert ports is not None
        assert port in ports
        assert client.getsockname()[1] not in ports
    listening.close()
    assert port not in (listening_ports() or ())


@pytest.mark.parametrize("piece", [1, 7, 100, 4096])
def test_lines_are_read_in_any_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    table = tmp_path / "tcp"
    table.write_text(
        "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n"
        "   0: 00000000:07E8 00000000:0000 0A 00000000:00000000 00:00000000 00000000     0        0 1075 1 0 100 0\n"
        "   1: 0100007F:9035 0100007F:1234 01 00000000:00000000 00:00000000 00000000     0        0 4661 1 0 100 0\n"
        " 100: 0000000000000000FFFF00000100007F:97DB 00000000000000000000000000000000:0000 0A 00000000:00000000\n"
    )
    monkeypatch.setattr(liveness, "_TABLES", (table, tmp_path / "none"))
    monkeypatch.setattr(liveness, "_PIECE", piece)
    assert listening_ports() == {0x07E8, 0x97DB}


def test_a_kernel_that_does_not_tell_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(liveness, "_TABLES", (tmp_path / "none",))
    assert listening_ports() is None
