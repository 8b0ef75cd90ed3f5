from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec
import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.adaptation import CoolDown
from rmpa.resource.node import ResourceNode
from rmpa.resource.quality import MEASURED
from rmpa.resource.resource import Resource
from rmpa.resource.saved import Clients, SavedCoolDown, SavedRequirement, SavedState
from rmpa.ros.core.embedded import RosCore
from tests.waiting import until

NOW = 1_800_000_000_000_000_000
SECOND = 1_000_000_000


def sonar() -> Resource:
    one = Resource("sonar", role="sensing")
    one.output("words", "std_msgs/String")
    one.attribute("noise", better="min", unit="m")
    one.parameter("gain", 1.0, low=0.0, high=10.0)
    one.parameter("count", 3)
    one.parameter("frame", "base")
    for name, noise, cost in (("fine", 0.01, 3), ("coarse", 0.1, 1)):
        one.profile(offers={"noise": noise}, cost=cost, name=name)(lambda: None)
    one.context("docked")
    one.adaptation(window="100 ms")
    return one


def asked(**options: object) -> SavedRequirement:
    values = (("noise", "<= 5 cm hard"), ("priority", "2"), ("expires", "30 s"))
    return SavedRequirement(client="/driver", values=values, mark="m1", **options)  # type: ignore[arg-type] # of the struct


def test_what_was_kept_comes_back() -> None:
    state = SavedState(
        parameters={"gain": 2, "frame": "sonar_link"},
        requirements=(asked(expires_ns=NOW + 12 * SECOND),),
        chosen="fine",
        last="fine",
        context="docked",
        cool_downs={"fine": SavedCoolDown(until_ns=NOW + SECOND, cool_down=20.0, why="no bus")},
    )
    found, lost = msgspec.json.decode(msgspec.json.encode(state), type=SavedState).checked(sonar(), NOW)
    assert lost == []
    assert found == state
    assert isinstance(found.parameters["gain"], float)
    requirement = found.requirements[0].requirement(sonar().attributes, "sonar", 100.0, NOW)
    assert requirement is not None
    assert (requirement.client, requirement.priority, requirement.expires) == ("/driver", 2, 112.0)
    assert requirement.bounds["noise"].hard


def test_expired_requirement_is_not_restored() -> None:
    found, lost = SavedState(requirements=(asked(expires_ns=NOW - 1),)).checked(sonar(), NOW)
    assert (found.requirements, lost) == ((), [])


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (SavedState(parameters={"gain": 11}), "too much"),
        (SavedState(parameters={"gain": "loud"}), "no double"),
        (SavedState(parameters={"power": 1}), "parameter power: it is declared no longer"),
        (SavedState(chosen="exact"), "profile exact: it is declared no longer"),
        (SavedState(last="exact"), "profile exact: it is declared no longer"),
        (SavedState(context="away"), "context away: it is declared no longer"),
        (SavedState(requirements=(SavedRequirement(client="/a", values=(("nois", ">= 1"),)),)), "nois"),
        (SavedState(requirements=(SavedRequirement(client="/a", values=(("noise", "soft"),)),)), "soft"),
        (SavedState(cool_downs={"exact": SavedCoolDown(until_ns=1, cool_down=1)}), "declared no longer"),
    ],
)
def test_what_does_not_fit_any_more_is_left_out_and_reported(state: SavedState, said: str) -> None:
    known = msgspec.structs.replace(state, parameters={**state.parameters, "count": 7})
    found, lost = known.checked(sonar(), NOW)
    assert found == SavedState(parameters={"count": 7})
    (text,) = lost
    assert said in text


@pytest.mark.parametrize(
    ("ahead", "left"),
    [(12, 12), (20, 20), (500, 20), (10**9, 20), (0, None), (-1, None), (-(10**9), None)],
    ids=["running", "just begun", "set back", "set back by decades", "over", "long over", "set forward by decades"],
)
def test_restored_cool_down_is_never_longer(ahead: int, left: int | None) -> None:
    one = SavedCoolDown(until_ns=NOW + ahead * SECOND, cool_down=20.0, why="no bus").left(100.0, NOW)
    assert (one and (one.until, one.cool_down, one.why)) == (left and (100.0 + left, 20.0, "no bus"))


def test_a_clock_that_was_set_back_makes_no_request_longer() -> None:
    one = asked(expires_ns=NOW + 10**9 * SECOND).requirement(sonar().attributes, "sonar", 100.0, NOW)
    assert one is not None
    assert one.expires == 130.0


# --- clients

ASKS = [("rate", ">= 20 Hz"), ("expires", "30 s")]


def clients() -> Clients:
    return Clients("camera", {name: MEASURED[name] for name in ("rate", "latency")})


def refused(one: Clients) -> list[str]:
    return [name for name, client in one.known.items() if client.refusal]


def test_refusal_lasts_until_a_valid_request() -> None:
    one = clients()
    with pytest.raises(ConfigError):
        one.read("/a", "m" * 9999, "", [("rat", ">= 20 Hz")], 1.0)
    assert len(one["/a"].mark) == limits.REQUIREMENT_TEXT_MAX
    one.refuse("/a", "no such attribute")
    assert (one["/a"].refusal, refused(one)) == ("no such attribute", ["/a"])
    requirement = one.read("/a", "m", "", ASKS, 1.0)
    assert requirement is not None
    assert (requirement.client, requirement.expires) == ("/a", 31.0)
    assert (one["/a"].refusal, refused(one)) == ("", [])
    assert (one["/b"].refusal, one["/b"].mark) == ("", "")


def test_repeated_latched_request_keeps_its_expiry(monkeypatch: pytest.MonkeyPatch) -> None:
    one = clients()
    for now, expires in ((1.0, 31.0), (20.0, 31.0), (31.0, None)):
        found = one.read("/a", "m", "5.000000000", ASKS, now)
        assert (found and found.expires) == expires
    again = one.read("/a", "m", "6.000000000", ASKS, 40.0)
    assert again is not None
    assert again.expires == 70.0
    unstamped = one.read("/a", "m", "", ASKS, 50.0)  # without a stamp each one is new
    assert unstamped is not None
    assert unstamped.expires == 80.0
    monkeypatch.setattr(limits, "RESOURCE_STAMPS_MAX", 2)
    for number in range(5):
        one.read("/a", "m", f"{number}.5", ASKS, 60.0)
    assert list(one.expiries) == [("/a", "3.5"), ("/a", "4.5")]


def test_absent_client_is_removed() -> None:
    one = clients()
    one.read("/a", "m", "", [], 0.0)
    one.read("/b", "n", "", [], 0.0)
    assert one.remove_absent({"/a"}, 1.0) == []
    assert one.remove_absent({"/a", "/b"}, 2.0) == []  # it was only connecting anew
    assert one.remove_absent({"/a"}, 3.0) == []
    assert one.remove_absent({"/a"}, 4.0) == ["/b"]
    assert one["/b"].mark == ""
    assert one.remove_absent(set(), 5.0) == []
    assert one.remove_absent(set(), 6.0) == ["/a"]  # also one that asked for nothing any more


def test_requirements_wait_for_their_clients_after_a_restart() -> None:
    before = clients()
    requirements = {}
    for name, mark, stamp, values in (("/a", "m", "5.0", ASKS), ("/b", "n", "", [("latency", "<= 1 s")])):
        requirement = before.read(name, mark, stamp, values, 10.0)
        assert requirement is not None
        requirements[name] = requirement
    asked = before.save(requirements | {"context lab": requirements["/a"]}, 12.0, NOW)
    assert [(a.client, a.mark, a.stamp, a.expires_ns) for a in asked] == [
        ("/a", "m", "5.0", NOW + 28 * 10**9),
        ("/b", "n", "", None),
    ]
    after = clients()
    found = after.restore(asked, 100.0, NOW + 8 * 10**9)
    assert [(r.client, r.expires) for r in found] == [("/a", 120.0), ("/b", None)]
    grace = 100.0 + limits.RESOURCE_CLIENT_GRACE
    after.read("/b", "n", "", [], 100.0)  # it is back
    for now in (101.0, 102.0):
        assert after.remove_absent({"/b"}, now) == []
    again = after.read("/a", "m", "5.0", ASKS, 110.0)
    assert again is not None
    assert again.expires == 120.0
    silent = clients()
    silent.restore(asked, 100.0, NOW)
    assert silent.remove_absent(set(), grace - 1) == []
    assert silent.remove_absent(set(), grace) == []
    assert silent.remove_absent(set(), grace + 1) == ["/a", "/b"]


# --- the file


async def started(core: RosCore, path: Path, one: Resource | None = None) -> ResourceNode:
    member = ResourceNode(one or sonar(), core.uri, state=path)
    await member.start()
    return member


def cooling(member: ResourceNode) -> list[CoolDown]:
    return list(member.adapter.adaptation.cooling(asyncio.get_running_loop().time()).values())


async def test_cool_down_survives_a_restart(core: RosCore, tmp_path: Path) -> None:
    def broken() -> Resource:
        one = Resource("sonar", role="sensing")
        one.attribute("noise", better="min", unit="m")
        one.profile(offers={"noise": 0.01}, name="fine")(fine)
        one.profile(offers={"noise": 0.1}, cost=1, name="coarse")(lambda: None)
        one.adaptation(window="100 ms", cool_down="60 s")
        return one

    def fine() -> None:
        tried.append("fine")
        raise OSError("no bus")

    tried: list[str] = []
    path = tmp_path / "sonar.json"
    first = await started(core, path, broken())
    await until(lambda: first.adapter.adaptation.profile == "coarse")
    (before,) = cooling(first)
    await first.close()
    again = await started(core, path, broken())
    await until(lambda: again.adapter.adaptation.profile == "coarse")
    (after,) = cooling(again)
    assert after.until == pytest.approx(before.until, abs=2)
    assert (after.cool_down, after.why) == (60.0, "OSError: no bus")
    assert tried == ["fine"]
    # Somebody who has mended it need not wait.
    again.adapter.pin("fine")
    await until(lambda: len(tried) == 2)
    await until(lambda: again.adapter.adaptation.profile == "coarse")
    await again.close()


async def test_a_damaged_file_is_set_aside(core: RosCore, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "sonar.json"
    path.write_bytes(b"[" * 100_000)
    member = await started(core, path)
    assert "sonar.json is damaged" in caplog.text
    await member.configuration.set({"gain": 2.5})
    await until(lambda: path.exists() and b"2.5" in path.read_bytes())  # at once, not only at the end
    assert (tmp_path / "sonar.json.damaged").exists()
    await member.close()


async def test_a_file_of_a_later_release_is_set_aside_whole(
    core: RosCore, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "sonar.json"
    later = b'{"format":2,"parameters":{"gain":{"value":2.5}},"more":[1]}'
    path.write_bytes(later)
    await (await started(core, path)).close()
    assert "is of another release of rmpa (format 2, not 1); it is kept as sonar.json.before," in caplog.text
    assert path.with_name("sonar.json.before").read_bytes() == later
    path.write_bytes(second := later.replace(b"2.5", b"3.5"))  # after another update, and back
    await (await started(core, path)).close()
    assert "it is kept as sonar.json.before-2, and a new file begins" in caplog.text
    assert path.with_name("sonar.json.before").read_bytes() == later
    assert path.with_name("sonar.json.before-2").read_bytes() == second


async def test_a_second_process_keeps_nothing(
    core: RosCore, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "sonar.json"
    first = await started(core, path)
    await first.configuration.set({"gain": 2.5})
    other = RosCore(port=0)
    await other.start()
    second = await started(other, path)
    assert "nothing is kept: another process uses it; name this module otherwise, or set --state" in caplog.text
    assert second.resource.parameters["gain"].value == 1.0
    await second.close()
    await first.close()
    await other.close()
    assert b"2.5" in path.read_bytes()


async def test_storing_is_tried_again(core: RosCore, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "rmpa.resource")
    (tmp_path / "state").touch()
    member = await started(core, tmp_path / "state" / "sonar.json")
    await until(lambda: "nothing is kept" in member.adapter.health()[1])
    (tmp_path / "state").unlink()
    await until(lambda: "nothing is kept" not in member.adapter.health()[1])
    assert "everything is kept again" in caplog.text
    assert caplog.text.count("nothing is kept: ") == 1
    await member.close()


async def test_what_was_learnt_is_kept_over_a_restart(core: RosCore, tmp_path: Path) -> None:
    def noisy() -> Resource:
        one = Resource("sonar", role="sensing")
        noise = one.attribute("noise", better="min", unit="m")
        one.profile(offers={"noise": 0.01}, name="fine")(lambda: None)
        one.task(rate=100, name="ping")(lambda: noise.observe(0.25))
        one.adaptation(window="50 ms", settle=0)
        return one

    first = await started(core, tmp_path / "sonar.json", noisy())
    await until(lambda: first.adapter.decision()["learnt"].get("fine", {}).get("noise", {}).get("n", 0) >= 10)
    assert first.adapter.decision()["learnt"]["fine"]["noise"]["median"] == 0.25
    kept = len(first.adapter.learnt._windows["fine"]["noise"])
    await first.close()
    again = await started(core, tmp_path / "sonar.json", noisy())
    assert again.adapter.decision()["learnt"]["fine"]["noise"]["n"] >= min(kept, limits.LEARNT_WINDOWS)
    await again.close()
