"""Reads the rules of this machine's firewalls."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from rmpa.observe.check import SKIPPED, WARN, Check
from rmpa.observe.doctor.firewall import judge_rules, read_iptables, read_nft
from rmpa.observe.doctor.io.programs import ask_program

if TYPE_CHECKING:
    from rmpa.config.settings import Settings


def check_firewall(settings: Settings) -> list[Check]:
    """Whether the rules of nftables and iptables, and their front ends, let an agent's packets in."""
    numbers = frozenset({settings.discovery_port, *((settings.port,) if settings.port else ())})
    needed = f"UDP port {settings.discovery_port}, and the mesh's port (TCP and UDP"
    needed += f", {settings.port})" if settings.port else "; it is any one without --port)"
    found = []
    for words, read in ((("nft", "list", "ruleset"), read_nft), (("iptables", "-S"), read_iptables)):
        text = ask_program(*words)
        if text is not None:
            found.append(judge_rules(read(text, numbers), needed))
    if not found:
        why = "only root may read them" if os.geteuid() else "neither nft nor iptables is here, or they do not answer"
        found.append(Check("firewall", SKIPPED, why, "" if not os.geteuid() else "run it by sudo", where="rules"))
    return found + _front_ends(needed)


def _front_ends(needed: str) -> list[Check]:
    found = []
    with contextlib.suppress(OSError):
        if "ENABLED=yes" in Path("/etc/ufw/ufw.conf").read_text(encoding="utf-8", errors="replace"):
            text = f"is switched on: it must let in {needed}"
            found.append(Check("firewall", WARN, text, "`sudo ufw status` shows its rules", where="ufw"))
    if any(process.info["name"] == "firewalld" for process in psutil.process_iter(["name"])):
        text = f"runs: its zone must let in {needed}"
        found.append(Check("firewall", WARN, text, "`firewall-cmd --list-all` shows its zone", where="firewalld"))
    return found
