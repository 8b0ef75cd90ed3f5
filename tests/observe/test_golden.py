"""What users and programs read of checks, whole: lines of doctor and why, JSON, /diagnostics.

``.venv/bin/python -m tests.observe.test_golden`` writes the files anew, after a change of texts that is meant.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import click
import msgspec
import pytest

from rmpa.cli.agent import stage_lines
from rmpa.cli.doctor import check_json, check_lines, checks_summary
from rmpa.observe.doctor.machine import judge_shell
from rmpa.observe.doctor.network import judge_rules
from rmpa.observe.health import Health, diagnostic_status
from rmpa.ros.types.definitions import frame_array
from tests.observe import test_transport_text
from tests.observe.doctor import test_firewall, test_judgements, test_ros_environment
from tests.observe.samples import DIRECT, SNAPSHOT
from tests.observe.test_health import CASES as HEALTH
from tests.observe.why import test_services, test_topics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from rmpa.observe.check import Check

GOLDEN: Final = Path(__file__).with_name("golden")


def document(sections: Iterable[tuple[str, Iterable[str]]]) -> bytes:
    """The lines of each case below its name."""
    return "\n".join("\n".join((f"== {name}", *map(click.unstyle, lines), "")) for name, lines in sections).encode()


def checks() -> Iterator[tuple[str, list[Check]]]:
    for name in (*test_judgements.CASES, *test_judgements.AGENTS):
        yield name, test_judgements.results(name)
    for name, rules in test_firewall.RULES.items():
        yield f"firewall: {name}", [judge_rules(rules(), "UDP port 11411")]
    for name, shell in test_ros_environment.SHELLS.items():
        yield f"shell: {name}", [*judge_shell(shell)]


def doctor() -> bytes:
    """The lines of a terminal, and a result of ``--json``."""
    found = [*checks()]
    lines = [(name, [line for check in results for line in check_lines(check)]) for name, results in found]
    every = [check for _, results in found for check in results]
    some = [msgspec.json.encode(check_json(check)).decode() for check in every[:3]]
    return document((*lines, ("the summary", [checks_summary(every)]), ("JSON", some)))


def why() -> bytes:
    """The lines of a terminal, and what the control socket and the peers carry."""
    cases = test_topics.FLOWING | test_topics.FAILURES | test_topics.WARNINGS
    ways = {name: case.walk() for name, case in cases.items()}
    for name, (here, there, _) in (test_services.FLOWING | test_services.FAILURES).items():
        ways[f"service: {name}"] = (test_services.walk(here, there),)
    ways |= {f"module: {name}": (found,) for name, (found, _) in test_services.MODULES.items()}
    lines = [(name, [line for way in found for line in stage_lines(way)]) for name, found in ways.items()]
    some = [msgspec.json.encode(ways[name]).decode() for name in ("a topic", "direct", "service: a service")]
    return document((*lines, ("transports", test_transport_text.words()), ("JSON", some)))


def diagnostics() -> bytes:
    """The statuses of snapshots in turn, each where it is new, and one message as TCPROS sends it."""
    sections: list[tuple[str, list[str]]] = []
    before: set[tuple[str, ...]] = set()
    for name, steps in HEALTH.items():
        health, lines = Health(), []
        for now, snapshot in steps:
            lines.append(f"at {now:g} s")
            for check in health.judge(snapshot, now):
                values = (f"          {key}: {value}" for key, value in check.evidence.items())
                status = (f"  {check.level:<5} {check.name}: {check.message}", *values)
                lines += status if status not in before else status[:1]
                before.add(status)
        sections.append((name, lines))
    parts = [diagnostic_status(check, "base").serialize() for check in Health().judge(SNAPSHOT, 0.0)]
    return document((*sections, ("a message", [frame_array(7, 7_000_000_000, parts).hex()])))


def shown() -> bytes:
    """A direct route as ``--json`` has it: programs read these names."""
    route = SNAPSHOT.topics[0].routes[0]
    return b"\n".join(msgspec.json.format(msgspec.json.encode(one), indent=1) for one in (DIRECT, route)) + b"\n"


FILES: Final = {"doctor.txt": doctor, "why.txt": why, "diagnostics.txt": diagnostics, "route.json": shown}


@pytest.mark.parametrize(("file", "said"), FILES.items(), ids=FILES)
def test_output_is_byte_for_byte_the_same(file: str, said: Callable[[], bytes]) -> None:
    assert said().decode().splitlines() == (GOLDEN / file).read_text().splitlines()


if __name__ == "__main__":
    for name, made in FILES.items():
        (GOLDEN / name).write_bytes(made())
