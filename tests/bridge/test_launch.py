"""The resources that an agent starts: from its folder alone, for those that may, at boot in order, over a crash."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rmpa.bridge import launched, limits
from rmpa.bridge.launch import LAUNCH, Launcher
from rmpa.bridge.launched import LaunchedResource, ModuleResources, is_name, list_files
from rmpa.config.peer_rules import PermissionRule
from rmpa.config.settings import ResourceSettings, Settings
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.runtime.programs import StartRule, figures
from tests.bridge.asked_module import AskedModule
from tests.waiting import until

FAKE = Path(__file__).parent / "fake_resource.py"
MAY = PermissionRule(("arm",), names={"launch": ("/cam",)})


class Module(AskedModule):
    """A module's part, beside a bridge that is made up."""

    def __init__(self, home: Path, *rules: PermissionRule, default: str = "deny", **resources: Any) -> None:
        self.published: dict[str, dict[str, str]] = {}
        given = ResourceSettings(**{"folder": str(home / "resources"), **resources})
        settings = Settings(name="base", state_dir=str(home / "state"), resources=given)
        core = SimpleNamespace(uri="http://127.0.0.1:1/", publishers=lambda topic: self.published.get(topic, {}))
        super().__init__(settings, *rules, default=default, core=core)
        self.folder = home / "resources"
        self.folder.mkdir(exist_ok=True)
        self.part = Launcher(self.bridge)

    def file(self, name: str, text: str = "") -> Path:
        path = self.folder / name
        path.write_text(text)
        return path

    async def do(self, what: str, name: str | None = None, **more: Any) -> ModuleResources:
        (found,) = await self.part.answer({"what": what, "name": name, **more})
        return found

    async def asks(self, what: object, name: object = None, *, asker: str = "arm", **more: Any) -> ModuleResources:
        found: ModuleResources = await self.answer(asker, LAUNCH, {"what": what, "name": name, **more})
        return found

    async def states(self) -> dict[str, str]:
        return {one.name: one.state for one in (await self.do("list")).resources}

    async def one(self, name: str) -> LaunchedResource:
        return next(one for one in (await self.do("list")).resources if one.name == name)

    async def wait(self, name: str, state: str) -> LaunchedResource:
        async with asyncio.timeout(30):
            while (one := await self.one(name)).state != state:
                await asyncio.sleep(0.02)
        return one


@pytest.fixture
async def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Callable[..., Module]]:
    """Make modules in one place; at the end all that they have started is ended."""
    monkeypatch.setattr(launched, "own_command", lambda *words: [sys.executable, "-S", "-E", str(FAKE), *words])
    made: list[Module] = []

    def one(*rules: PermissionRule, **options: Any) -> Module:
        made.append(Module(tmp_path, *rules, **options))
        return made[-1]

    yield one
    for each in made:
        await each.part.close()


async def test_a_resource_is_started_restarted_and_stopped_and_its_log_is_read(make: Callable[..., Module]) -> None:
    module = make()
    module.file("cam.resource.toml")
    assert await module.states() == {"cam": "stopped"}
    (one,) = (await module.do("start", "cam")).resources
    assert (one.state, one.file, one.boot) == ("active", "cam.resource.toml", False)
    assert one.pid
    assert figures(one.pid)
    (node,) = one.processes
    assert (node.node, node.pid, node.own) == ("/driver", one.pid, True)
    assert node.rss > 1_000_000
    (again,) = (await module.do("start", "cam")).resources
    assert again.pid == one.pid, "it runs already"
    log, _ = (await module.do("log", "cam")).logs
    assert log.lines == ("runs cam.resource.toml",)
    (later,) = (await module.do("restart", "cam")).resources
    assert later.pid != one.pid
    more, _ = (await module.do("log", "cam", after={"": log.next})).logs
    assert more.lines == ("runs cam.resource.toml",)
    assert await module.part.starters() == {"/driver": "cam"}
    (stopped,) = (await module.do("stop", "cam")).resources
    assert (stopped.state, stopped.pid, figures(later.pid or 0)) == ("stopped", None, None)
    assert (await module.do("log", "cam", lines=1)).logs[0].lines == ("runs cam.resource.toml",)


async def test_one_that_fails_is_started_again_and_one_that_is_wrong_is_not(
    make: Callable[..., Module], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = make()
    for name, text in (("bad", "# fail"), ("wrong", "# usage"), ("shaky", "# crash")):
        module.file(f"{name}.resource.toml", text)
    failed = await module.do("start", "bad")
    assert (failed.code, failed.resources[0].state) == ("resource-stopped", "failed")
    assert "has ended with code 1; it is started again" in failed.problem
    assert failed.problem.endswith("something is missing")
    wrong = await module.do("start", "wrong")
    assert "cannot run as it is written" in wrong.problem
    monkeypatch.setattr(limits, "LAUNCH_RESTART_FIRST", 0.02)
    await module.do("start", "shaky")
    one = await module.wait("shaky", "active")
    async with asyncio.timeout(30):
        while one.restarts != 1 or one.state != "active":
            one = await module.one("shaky")
    assert (await module.one("wrong")).restarts == 0


async def test_the_next_agent_takes_over_what_a_killed_one_had_started(
    make: Callable[..., Module], tmp_path: Path
) -> None:
    first = make()
    first.file("cam.py")
    first.file("gone.py")
    pids = {name: (await first.do("start", name)).resources[0].pid for name in ("cam", "gone")}
    children = [one._child for one in first.part._launched.values()]
    for one in first.part._launched.values():  # as after kill -9: nothing of it acts any more
        assert one._keeper is not None
        one._keeper.cancel()
        one.mark = one._child = None
    os.kill(pids["gone"] or 0, signal.SIGKILL)
    await until(lambda: figures(pids["gone"] or 0) is None)

    second = make()
    second.part.start()
    assert (await second.wait("cam", "active")).pid == pids["cam"]
    assert (await second.one("gone")).state == "stopped"
    mark = second.part._launched["gone"].mark
    assert mark is not None, "the nodes that it left are found by it"
    assert mark.pid == pids["gone"]
    assert (await second.do("start", "cam")).resources[0].pid == pids["cam"]
    os.kill(pids["cam"] or 0, signal.SIGKILL)
    await until(lambda: figures(pids["cam"] or 0) is None)
    assert (await second.wait("cam", "active")).restarts == 1
    last = (await second.one("cam")).pid
    await second.part.close()
    assert figures(last or 0) is None
    assert all(child is not None and child.poll() is not None for child in children)


async def test_at_boot_resources_start_in_their_order_and_a_circle_is_said(make: Callable[..., Module]) -> None:
    module = make()
    start = '[start]\nboot = true\nafter = ["{}"]\n'
    module.file("plan.resource.toml", start.format("cam"))
    module.file("cam.resource.toml", '[start]\nboot = true\ntopics = ["/scan"]\ndelay = "50 ms"\n')
    module.file("a.resource.toml", start.format("b"))
    module.file("b.resource.toml", start.format("a"))
    module.file("lone.resource.toml", start.format("nothing"))
    module.file("hand.resource.toml")
    module.part.start()
    waits = await module.wait("plan", "waiting")
    assert waits.boot
    for name, why in (("plan", "waits for cam"), ("cam", "waits for /scan")):
        one = module.part._launched[name]
        async with asyncio.timeout(30):
            while one.why != why:
                await asyncio.sleep(0.01)
    assert "a after b after a" in (await module.one("a")).why
    assert "waits for nothing, which is not in the folder" in (await module.one("lone")).why
    module.published["/scan"] = {"/laser": "http://127.0.0.1:2/"}
    cam, plan = await module.wait("cam", "active"), await module.wait("plan", "active")
    assert plan.since >= cam.since
    assert (await module.states())["hand"] == "stopped"


async def test_nothing_starts_at_boot_where_the_settings_say_so(make: Callable[..., Module]) -> None:
    module = make(start=False)
    module.file("cam.resource.toml", "[start]\nboot = true\n")
    module.part.start()
    await module.do("list")
    assert (await module.one("cam")).state == "stopped"


# Who may, and what is never started.


async def test_a_peer_without_the_permission_starts_nothing_whatever_the_default_is(
    make: Callable[..., Module],
) -> None:
    for module in (make(MAY, default="allow"), make(MAY)):
        module.file("cam.resource.toml")
        for what in ("start", "stop", "restart", "log"):
            with pytest.raises(RmpaError, match="do not let eve start /cam") as refused:
                await module.asks(what, "cam", asker="eve")
            assert refused.value.code == "not-permitted"
        with pytest.raises(RmpaError, match="do not let eve start any resource"):
            await module.asks("list", asker="eve")
        assert not module.part._launched
    module.file("other.resource.toml")
    assert [one.name for one in (await module.asks("list")).resources] == ["cam"], "no other is named"
    assert (await module.asks("start", "cam")).resources[0].state == "active"
    with pytest.raises(RmpaError, match="do not let arm start /other"):
        await module.asks("start", "other")


async def test_in_an_open_mesh_nothing_is_started_unless_the_settings_allow_it(make: Callable[..., Module]) -> None:
    module = make()
    module.file("cam.resource.toml")
    for what in ("list", "start", "log"):
        with pytest.raises(RmpaError, match="the mesh is not secured, and open of"):
            await module.asks(what, "cam")
    assert not module.part._launched
    assert (await make(open=True).asks("start", "cam")).resources[0].state == "active"


@pytest.mark.parametrize(
    "name",
    [
        "../cam", "/etc/passwd", "cam\0", "cam\n", "cam.resource.toml", "-h", "a b", "$(id)", "", "x" * 65, None, 7,
        ["cam"],
    ],
)  # fmt: skip
async def test_only_a_plain_name_is_taken(make: Callable[..., Module], name: Any) -> None:
    module = make(PermissionRule(("*",), names={"launch": ("/**",)}))
    module.file("cam.resource.toml")
    assert not is_name(name)
    with pytest.raises(RmpaError, match="names no resource"):
        await module.asks("start", name)
    assert "has no file of a resource" in (await module.do("start", name)).problem
    assert not module.part._launched


async def test_a_file_that_others_may_write_or_that_leads_elsewhere_is_refused(
    make: Callable[..., Module], tmp_path: Path
) -> None:
    module = make(PermissionRule(("*",), names={"launch": ("/**",)}))
    outside = tmp_path / "evil.resource.toml"
    outside.write_text("")
    module.file("group.resource.toml").chmod(0o666)
    (module.folder / "link.resource.toml").symlink_to(outside)
    (module.folder / "dir.resource.toml").mkdir()
    os.mkfifo(module.folder / "pipe.resource.toml")
    module.file("twice.resource.toml")
    module.file("twice.py")
    module.file("fine.py")
    module.file("we-ird.resource.toml")
    expected = {
        "group": "every user may write",
        "link": "is a symbolic link",
        "dir": "is not a regular file",
        "pipe": "is not a regular file",
        "twice": "have one name",
        "we-ird": "letters, digits and _",
    }
    told = {one.name: one for one in (await module.do("list")).resources}
    assert {name: told[name].state for name in expected} == dict.fromkeys(expected, "refused")
    for name, why in expected.items():
        assert why in told[name].why
        if is_name(name):
            answer = await module.asks("start", name)
            assert (answer.code, why in answer.problem) == ("launch-refused", True)
    assert told["fine"].state == "stopped"
    module.file("helper.py").chmod(0o666)  # fine.py could import it
    assert "helper.py" in (await module.asks("start", "fine")).problem
    module.folder.chmod(0o777)
    assert "every user may write" in (await module.asks("start", "fine")).problem
    module.folder.chmod(0o755)
    assert not any(one.runs for one in module.part._launched.values())


async def test_without_a_folder_there_is_nothing_to_start(make: Callable[..., Module]) -> None:
    module = make(folder="")
    module.part.start()
    answer = await module.do("list")
    assert (answer.code, "set folder of [resources]" in answer.problem) == ("launch-refused", True)
    assert "cannot be read" in (await make(folder="/nowhere/at/all").do("start", "cam")).problem


async def test_thousands_of_requests_start_nothing_and_are_logged_once(
    make: Callable[..., Module], caplog: pytest.LogCaptureFixture
) -> None:
    module = make(MAY)
    module.file("cam.resource.toml")
    for number in range(3_000):
        with pytest.raises(RmpaError):
            await module.asks("start", f"n{number}", asker="eve")
    assert not module.part._launched
    assert len([each for each in caplog.records if "eve" in each.getMessage()]) == 1


async def test_all_modules_are_asked_and_each_problem_is_told(make: Callable[..., Module]) -> None:
    module = make()
    module.file("cam.resource.toml")
    answers = {
        "arm": {"module": "lies", "resources": [{"name": "hand", "file": "hand.py", "state": "active"}]},
        "old": PeerRefused("old", "this agent does not know the question 'launch'"),
        "hung": UnreachableError("agent", "hung"),
        "evil": {"resources": 7},
        "shut": PeerRefused("shut", "the permissions there do not let base start any resource"),
    }
    for name, answer in answers.items():
        module.peer(name, answer)
    found = {one.module: one for one in await module.part.answer({"what": "list"})}
    assert list(found) == ["base", "arm", "old", "hung", "evil", "shut"]
    assert [one.name for one in found["arm"].resources] == ["hand"]
    assert {name: found[name].code for name in ("old", "hung", "evil", "shut")} == {
        "old": "other-release",
        "hung": "no-agent",
        "evil": "protocol-error",
        "shut": "not-permitted",
    }
    assert "did you mean arm?" in (await module.do("start", "hand", module="arn")).problem
    assert (await module.do("list", module="base")).resources[0].name == "cam"
    assert "is no question" in (await module.do("format", "cam")).problem


def test_a_table_that_cannot_be_read_is_said(tmp_path: Path) -> None:
    for text in ("[start]\ndelay = 'soon'", "start = 7", "[start", "[start]\ntopics = 7"):
        (tmp_path / "cam.resource.toml").write_text(text)
        assert "its table [start] cannot be read" in list_files(tmp_path, {})["cam"].problem
    (tmp_path / "cam.resource.toml").write_text("[start]\nboot = true\ndelay = '2 s'\n")
    assert list_files(tmp_path, {})["cam"].rule == StartRule(boot=True, delay=2.0)
