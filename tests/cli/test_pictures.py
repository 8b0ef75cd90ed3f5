"""What the verbs say, line by line: on terminals of 80 and 120 columns, and in a pipe beside agents of many kinds."""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Callable
from typing import Any, Final

import pytest
from msgspec.structs import replace

from rmpa.cli.main import main
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.core.facts import FollowedInfo
from rmpa.observe.check import Check, CheckLevel
from rmpa.observe.control_client import ReloadReply
from rmpa.observe.sites import SiteInfo, SiteModuleInfo, SiteSourceInfo, SitesReport
from rmpa.observe.snapshot import PeerInfo, PingReply
from rmpa.observe.snapshot_builder import judge_refusal
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.resource import limits
from rmpa.ros.core.embedded import RosCore
from rmpa.trust.permissions import TrustReason
from tests.cli.conftest import Place, compare, with_core
from tests.cli.test_resource import remote, run, running
from tests.observe.samples import SNAPSHOT
from tests.observe.why import test_topics

__all__ = ["remote", "run", "running"]  # fixtures
FOLLOWED: Final = (
    FollowedInfo(key="/map/frame", owner="base", owner_key="/map_frame", state="followed", size=12),
    FollowedInfo(key="/c", owner="arm", owner_key="/c", state="refused", problem="it may not be read"),
)
ARM: Final = SiteModuleInfo(name="arm", instance="0" * 32, topics=2, services=1, shown=2)
HERE: Final = SiteInfo(name="office", state="this site", gateways=1)
JOINED: Final = SiteInfo(name="warehouse", state="joined", since_ago=12.0, gateways=2, modules=(ARM,))
REPORT: Final = SitesReport(
    gateway="gate", site="office", leads=True, rank=100, endpoints=("tcp/10.0.0.1:7447",), sites=(HERE, JOINED)
)
SOURCES: Final = (
    SiteSourceInfo(kind="topic", module="arm", node="/n", name="/scan", type="sensor_msgs/LaserScan", here="/scan"),
    SiteSourceInfo(
        kind="service", module="arm", node="/n", name="/stop", problem="gateway.rule 1 lets it not come in\x1b[2J"
    ),
)
LINES: Final = (
    "peer list",
    "peer list -v",
    "peer info joystick",
    "peer ping joystick -c 2 -i 0.01",
    "topic list",
    "topic list -v",
    "topic info /sonar/state",
    "topic find std_msgs/String",
    "service list",
    "service list -v",
    "service info /sonar/set_parameters",
    "node list",
    "node list -v",
    "node info /sonar",
    "param list /sonar",
    "param get /rosdistro",
    "param followed",
    "resource list",
    "resource info sonar",
    "profile list sonar",
    "profile explain sonar",
    "context list sonar",
    "site list",
    "why joystick:/cmd",
    "topic echo nobody:/x",
    "list",
)


class Terminal(io.StringIO):
    """Standard output of a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def shell(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """The variables of a shell, for verbs that run within this process."""
    for name in ("RMPA_AGENT", "ROS_MASTER_URI"):
        monkeypatch.delenv(name, raising=False)
    for name, value in (("RMPA_RUNTIME_DIR", str(place.path)), ("NO_COLOR", "1"), ("TERM", "dumb")):
        monkeypatch.setenv(name, value)


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.usefixtures("shell", "running", "remote")
def test_verbs_on_a_terminal(
    agent: Callable[..., None], core: RosCore, monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    agent(
        snapshot=with_core(core.uri),
        why=lambda _: test_topics.Case().walk(),
        site=lambda _: [REPORT],
        followed=lambda _: FOLLOWED,
        node=lambda _: (),
    )
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr(limits, "LEARNT_LEAST", 1 << 30)  # what was learnt would depend on the time
    said = ""
    for line in LINES:
        terminal = Terminal()
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", terminal)
            patch.setattr(sys, "stderr", terminal)
            main(line.split())
        # Ports and process ids have five digits, or the columns behind them would move.
        text = re.sub(r"\x1b\[[0-9;]*m", "", terminal.getvalue())
        text = re.sub(r"(127\.0\.0\.1|localhost):\d{5}", r"\1:40000", text)
        text = re.sub(r"\d\d:\d\d:\d\d( .*)\d\.\d{3} s", r"12:00:00\g<1>0.002 s", text)
        text = re.sub(r"Pid: \d+", "Pid: 40000", re.sub(r"took [\d.e-]+ s", "took 0.002 s", text))
        said += f"$ rmpa {line}\n{text}\n"
    compare(str(width), said)


def peer(name: str, state: str, **more: Any) -> PeerInfo:
    return PeerInfo(name=name, guid="10.9.0.1:40001#1", instance="22" * 16, state=state, since_ago=9.0, **more)


def stages(*checks: Check, **more: Any) -> tuple[Diagnosis, ...]:
    checks = (Check("peer", CheckLevel.OK, "joystick is known"), *checks)
    return (Diagnosis.of(checks, peer="joystick", to="base", **more),)


def refuse(error: RmpaError) -> Callable[[object], object]:
    def answer(_: object) -> object:
        raise error

    return answer


def sites(*reports: SitesReport) -> dict[str, Callable[[object], object]]:
    return {"site": lambda _: reports}


def _outside(name: str) -> PeerInfo:
    """A module of another mesh, or one to which this module, without keys, is pending."""
    reason = TrustReason.FOREIGN if name == "hand" else TrustReason.PLAIN
    state, text, invite = judge_refusal(reason, "base")
    return peer(name, state, last_error=text, invite=invite, addresses=("10.9.0.1:40001",))


RELAYED: Final = peer("pad", "relayed", via="base2", topics_in=3, last_error="no route to host")
SLOW: Final = replace(peer("slow", "linking"), since_ago=9.0)
CROWD: Final = (
    *(peer(f"arm{n}", "relayed") for n in range(999)),
    peer("arm999", "refused", last_error="another domain"),
)
FLOWS: Final = stages(Check("contract", CheckLevel.WARN, "3 lost", "`rmpa topic info`"), name="/cmd", node="/joy")
STOPS: Final = stages(
    Check("publisher", CheckLevel.FAIL, "no node of joystick\x1b[2J publishes /cmd", "start it"), name="/cmd"
)
# By name: what the agent shows and answers, and what is asked then.
KINDS: Final[dict[str, tuple[dict[str, Any], tuple[str, ...]]]] = {
    "peers": (
        {"ping": lambda args: PingReply(times=(0.0004,), remote=args["peer"])},  # by GUID: names may be equal
        (
            "peer list -v",
            "peer list --json",
            "peer list nothing*",
            "peer info 10.0.0.2:40002",
            "peer info joystik",
            "peer ping joystik",
            "peer ping joystick -c 2 -i 0.01 --json",
        ),
    ),
    "no_peers": ({"snapshot": replace(SNAPSHOT, peers=(), notes=())}, ("peer list", "peer list --json")),
    "relayed": (
        {"snapshot": replace(SNAPSHOT, peers=(RELAYED,), notes=()), "ping": refuse(RmpaError("no link to pad"))},
        ("peer list", "peer info pad", "peer ping pad -c 1"),
    ),
    "linking": (
        {"snapshot": replace(SNAPSHOT, peers=(replace(SLOW, name="new", since_ago=1.0), SLOW), notes=())},
        ("peer list",),
    ),
    "crowd": (
        {"snapshot": replace(SNAPSHOT, peers=CROWD, notes=())},
        ("peer list --limit 5", "peer list arm99?", "peer list --state refused"),
    ),
    "pending": (
        {
            "snapshot": replace(
                SNAPSHOT, peers=(), notes=(), strangers=tuple(_outside(n) for n in ("arm", "mast", "hand"))
            )
        },
        ("peer list", "peer info arm", "peer list --state pending"),
    ),
    "reload": (
        {
            "reload": lambda args: ReloadReply(
                file=f"check={args['check']}",
                changed=("bridge.deny", "[[peer]]"),
                restart=("mesh.port (1 instead of 0)",),
                notes=("contract: a rule that sets nothing",),
            )
        },
        ("reload", "reload --check", "reload --json"),
    ),
    "reload_of_nothing": ({"reload": lambda _: ReloadReply()}, ("reload", "reload --check")),
    "reload_of_a_mistake": (
        {"reload": lambda _: ReloadReply(problem="/etc/rmpa.toml:7: bridge.deny: no\x1b[2J")},
        ("reload", "reload --json"),
    ),
    "followed": ({"followed": lambda _: FOLLOWED}, ("param followed", "param followed --json")),
    "why": ({"why": lambda _: (*FLOWS, *STOPS)}, ("why /cmd", "why /cmd --json", "why joystick", "why 'a b'")),
    "why_it_flows": ({"why": lambda _: FLOWS}, ("why joystick:/cmd",)),
    "why_as_asked": (
        {"why": lambda args: stages(name=str(args), kind="module" if "module" in args else "topic")},
        ("why joystick:cmd", "why --service cmd", "why --module joystick"),
    ),
    "why_refused": ({"why": refuse(ConfigError("name", "is not a topic"))}, ("why /cmd",)),
    "sites": (sites(REPORT), ("site list", "site list --json")),
    "no_sites": (sites(), ("site list", "site list --json")),
    "a_site_alone": (sites(SitesReport(gateway="g", site="office", sites=(HERE,))), ("site list",)),
    "a_site_without_router": (
        sites(SitesReport(gateway="g", site="a", problem="no router", sites=(HERE, JOINED))),
        ("site list",),
    ),
    "a_site_unreachable": (
        sites(SitesReport(gateway="g", site="a", sites=(HERE, SiteInfo(name="b", state="unreachable", since_ago=3)))),
        ("site list",),
    ),
    "a_site": (
        {
            "site": lambda args: replace(
                REPORT, gateway=str(args), sites=(replace(JOINED, sources=SOURCES, not_shown=1),)
            )
        },
        ("site info warehouse", "site info warehuose"),
    ),
    "a_site_refused": (
        {"site": refuse(PeerRefused("gate", "site warehouse is unreachable since 6 s"))},
        ("site info warehouse --json",),
    ),
}


@pytest.mark.parametrize("name", KINDS)
def test_verbs_in_a_pipe(agent: Callable[..., None], place: Place, name: str) -> None:
    answers, lines = KINDS[name]
    agent(**answers)
    said = place.transcript(*lines)
    assert "\x1b" not in said
    compare(name, said)
