"""docs/limits.md: its figures are the code's, and no bound that a user can meet is missing.

A new ``…_MAX`` of a room's ``limits.py`` belongs on the page; or into ``INTERNAL`` if no user can ever notice it.
Others may be on the page too, and are then compared with it.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Final, NamedTuple

import pytest

import rmpa
from rmpa.config.settings import SETTINGS, LimitSettings
from rmpa.core.limits import KIB, MIB

_SIZES: Final = {"KIB", "MIB", "INT32_MIN", "INT32_MAX", "UINT32_MAX"}
"""Units and ranges of numbers, which bound nothing."""


def all_limits() -> dict[str, list[float]]:
    """The bounds of all rooms, and of the rooms within the gateway; two rooms may have one of the same name."""
    root = Path(rmpa.__path__[0])
    found: dict[str, list[float]] = {}
    for file in (*root.glob("*/limits.py"), *root.glob("gateway/*/limits.py")):
        room = ".".join(file.parent.relative_to(root).parts)
        for name, value in vars(import_module(f"rmpa.{room}.limits")).items():
            if name.isupper() and name not in _SIZES:
                found.setdefault(name, []).append(value)
    return found


LIMITS: Final = all_limits()
DOCS: Final = Path(__file__).parents[2] / "docs"
PAGE: Final = DOCS / "limits.md"
OTHERS: Final = (DOCS / "rosbridge.md", DOCS / "design" / "monitor-protocol.md")
"""Pages with the bounds of one protocol, whose tests compare the figures."""
INTERNAL: Final = {
    "ADVERTISEMENT_MAX",
    "ANSWER_ADDRESSES_MAX",
    "ASK_BYTES_MAX",
    "ASK_EXPRESS_MAX",
    "ASK_NAME_MAX",
    "BACKOFF_MAX",
    "BEACON_ADDRESSES_MAX",
    "BEACON_GOSSIP_MAX",
    "BEACON_SOURCES_MAX",
    "BOUND_MAX",
    "CONTEXT_RULE_MAX",
    "CONTRACT_RATE_MAX",
    "CONTRACT_TIME_MAX",
    "BULK_WINDOW_MAX",
    "CONTROL_PATH_MAX",
    "CONTROL_PAYLOAD_MAX",
    "CONTROL_PINGS_MAX",
    "CONTROL_REQUEST_MAX",
    "CONTROL_TEXT_BYTES_MAX",
    "CONTROL_TEXT_MAX",
    "CONTROL_WAIT_MAX",
    "CORE_STATE_DEPTH_MAX",
    "CORE_STATE_NAME_MAX",
    "DATA_PAYLOAD_MAX",
    "DEFINITION_DEPTH_MAX",
    "DEFINITION_FIELDS_MAX",
    "DESCRIPTOR_MAX",
    "DOCTOR_OUTPUT_MAX",
    "DOMAIN_MAX",
    "EXPRESS_MESSAGE_MAX",
    "CANDIDATES_MAX",
    "CANDIDATE_RETRY_MAX",
    "HEADER_MAX",
    "HEADER_QUERIES_MAX",
    "HELLO_PAYLOAD_MAX",
    "LATCHED_NODES_MAX",
    "HTTP_HEADERS_MAX",
    "RECEIVED_TYPES_MAX",
    "LINK_LEASE_MAX",
    "LOG_KINDS_MAX",
    "LOOPBACK_RESTING_MAX",
    "MASTER_LOOK_MAX",
    "MASTER_WRITES_MAX",
    "MISMATCHES_MAX",
    "NOTIFY_RETRY_MAX",
    "PACKAGE_FILE_MAX",
    "PAYLOAD_BUFFERS_MAX",
    "RESOURCE_STAMPS_MAX",
    "LEASE_MAX",
    "ENDPOINT_RUNS_MAX",
    "SEED_RETRY_MAX",
    "TCPROS_MESSAGE_MAX",
    "TCPROS_RETRY_MAX",
    "TYPES_FOUND_MAX",
    "TYPES_MISSING_MAX",
    "XMLRPC_DEPTH_MAX",
    "CERTIFICATE_MAX",
    "CSR_MAX",
    "DENY_MAX",
    "DOCUMENT_MAX",
    "IDLE_CHECK_MAX",
    "INTERRUPTED_TOPICS_MAX",
    "ISSUED_MAX",
    "JOIN_ANSWER_MAX",
    "JOIN_REQUEST_MAX",
    "KEYS_MAX",
    "OLD_KEYS_MAX",
    "OPEN_RETRY_MAX",
    "RUNS_MAX",
    "TOKENS_MAX",
    "TOKEN_LIFETIME_MAX",
    "TOKEN_TEXT_MAX",
    "ENTITY_ID_MAX",
    "GATEWAY_BYTES_MAX",
    "GID_MAX",
    "KEY_MAX",
    "NODE_NAME_MAX",
    "QOS_NUMBER_MAX",
    "ROS2_PROBLEMS_MAX",
    "ROS2_PUBLISHERS_MAX",
    "SERVICE_DESCRIPTION_MAX",
    "SITE_WHY_MAX",
    "BATCH_MAX",
    "BLOCK_MAX",
    "CLOSE_MAX",
    "FLUSH_MAX",
    "RECONNECT_MAX",
    "CODECS_MAX",
    "FRAGMENTED_MESSAGES_MAX",
    "ID_MAX",
    "INLINE_MAX",
    "NAME_MAX",
    "TEXT_MAX",
    "TYPE_SIZE_MAX",
    "TYPE_VALUES_MAX",
    "WRITTEN_MAX",
    "ZENOH_KEY_MAX",
}
"""Of parsers, packets, retries and caches: nothing that a user could notice or mend."""

_NONE: Final = "\N{EN DASH}"


class Row(NamedTuple):
    line: int
    bound: str
    default: str
    setting: str
    happens: str
    told: str
    name: str


def rows() -> list[Row]:
    found = []
    for number, line in enumerate(PAGE.read_text(encoding="utf-8").splitlines(), 1):
        cells = [cell.strip() for cell in line.strip().strip("|").split(" | ")]
        if line.startswith("| ") and not line.startswith("| bound |"):
            assert len(cells) == 6, f"line {number}: {len(cells)} cells instead of 6"
            found.append(Row(number, *cells))
    return found


def figures(value: float) -> set[str]:
    """How a page may write it."""
    texts = {f"{value:,.0f}", f"{value:g} s"}
    for unit, size in (("KiB", KIB), ("MiB", MIB)):
        if value % size == 0:
            texts.add(f"{value / size:,.0f} {unit}")
    if value % 60 == 0:
        texts |= {f"{value / 60:g} min", f"{value / 3600:g} h"}
    return texts


@pytest.mark.parametrize("row", rows(), ids=lambda row: row.name)
def test_each_row_has_the_codes_figure(row: Row) -> None:
    names = re.findall(r"`([A-Z_0-9]+)`", row.name)
    assert names, f"line {row.line}: no name in the last column"
    for name in names:
        assert name in LIMITS, f"line {row.line}: there is no {name} in any limits.py"
        values = LIMITS[name]
        fits = any(row.default in figures(value) for value in values)
        assert fits, f"line {row.line}: {name} is {values}, not {row.default}"


@pytest.mark.parametrize("row", rows(), ids=lambda row: row.name)
def test_each_row_names_existing_settings(row: Row) -> None:
    assert row.happens not in ("", _NONE), f"line {row.line}: what happens at it?"
    assert row.told, f"line {row.line}: where is it told? ({_NONE} for nowhere)"
    known = {".".join(setting.key) for setting in SETTINGS}
    for setting in re.findall(r"`([a-z_]+\.[a-z_]+)`", row.setting):
        assert setting in known, f"line {row.line}: there is no setting {setting}"


def test_no_bound_is_missing() -> None:
    shown = {name for row in rows() for name in re.findall(r"`([A-Z_0-9]+)`", row.name)}
    for page in OTHERS:
        shown.update(re.findall(r"\| `([A-Z_0-9]+)` \|", page.read_text(encoding="utf-8")))
    bounds = {name for name in LIMITS if name.endswith("_MAX")}
    missing = bounds - shown - INTERNAL
    assert not missing, f"add a row to {PAGE.name}, or to INTERNAL here: {', '.join(sorted(missing))}"
    assert bounds >= INTERNAL, f"there is none of these any more: {', '.join(sorted(INTERNAL - bounds))}"
    assert not shown & INTERNAL, f"on the page and in INTERNAL: {', '.join(sorted(shown & INTERNAL))}"


def test_a_bound_of_the_gateway_has_one_row() -> None:
    section = PAGE.read_text(encoding="utf-8").partition("\n## The gateway\n")[2].partition("\n## ")[0]
    names = re.findall(r"\| `([A-Z_0-9]+)` \|\n", section)
    assert len(names) == len(set(names)), f"twice: {sorted({name for name in names if names.count(name) > 1})}"


def test_the_settings_of_the_page_are_those_that_there_are() -> None:
    text = PAGE.read_text(encoding="utf-8")
    block = text.partition("```toml\n[limits]\n")[2].partition("```")[0]
    written = {key: int(value) for key, value in (line.split(" = ") for line in block.splitlines())}
    defaults = LimitSettings()
    assert written == {
        key: getattr(defaults, key) for _, key in (s.key for s in SETTINGS if s.key[:1] == ("limits",))
    }
    for key in written:
        assert f"`RMPA_LIMIT_{key.upper()}`" in text
