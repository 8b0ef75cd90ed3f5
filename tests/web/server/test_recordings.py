"""Files of recordings over sockets: what is made once, what is told meanwhile, and how it ends."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import aiohttp
import pytest

from rmpa.bridge.kept import Kept
from rmpa.bridge.recordings import ModuleRecordings
from rmpa.config.peer_rules import PermissionRule
from rmpa.config.settings import TrustSettings
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.runtime.interpreter import own_command
from rmpa.trust.permissions import Permissions
from rmpa.web import limits
from rmpa.web.hub.node_link import EVERYTHING, NodeRules
from rmpa.web.monitor import questions
from rmpa.web.monitor.questions import QUESTIONS, Answers
from rmpa.web.server import recordings
from rmpa.web.server.access import AccessPolicy, own_names
from rmpa.web.server.agent_watch import AgentWatch
from rmpa.web.server.app import WebServer
from rmpa.web.server.recordings import RecordingFiles
from tests.record.conftest import Record, recording, source
from tests.waiting import until
from tests.web.recorder import FakeHub
from tests.web.snapshots import FULL

__all__ = ["recording"]  # a fixture
HIT = "20261129-121500-arm-hit"
DENIED = NodeRules(Permissions(TrustSettings(rules=(PermissionRule(("web",), names={"record": ("/*-base-*",)}),))))
COPY = "import shutil, sys; shutil.copytree(sys.argv[1], sys.argv[2], dirs_exist_ok=True)"


class Site:
    """A server with recordings of the modules arm and base; ``fetch`` is the program that fetches them."""

    def __init__(self, place: Path, fetched: Path, rules: NodeRules = EVERYTHING, *, view: bool = True) -> None:
        self.folder = place / "web-8480"
        self.fetch = COPY
        self.fetched = fetched
        self.commands: list[tuple[str, ...]] = []
        self.files = RecordingFiles(rules, self.folder, lambda: "arm", view=view, command=self._command)
        policy = AccessPolicy(0, own_names(("base",)))
        self.server = WebServer(AgentWatch(lambda: FULL), policy, "127.0.0.1", recordings=self.files)

    def _command(self, *words: str) -> list[str]:
        self.commands.append(words[:2])
        if words[:2] != ("record", "fetch"):
            return own_command(*words)
        assert words[2:4] == (HIT, "-o")
        assert words[5:] == ("--agent", "arm", "--json")
        return [sys.executable, "-c", self.fetch, str(self.fetched), words[4]]

    def url(self, name: str) -> str:
        return f"http://127.0.0.1:{self.server.port}/recording/{name}"

    async def get(self, name: str) -> tuple[int, bytes]:
        async with aiohttp.request("GET", self.url(name)) as response:
            return response.status, await response.read()

    async def told(self, name: str) -> list[dict[str, Any]]:
        status, body = await self.get(f"{name}?progress")
        assert status == 200
        return [json.loads(line) for line in body.splitlines()]


@asynccontextmanager
async def serving(*given: Any, **more: Any) -> AsyncIterator[Site]:
    site = Site(*given, **more)
    await site.server.start()
    try:
        yield site
    finally:
        await site.server.close()
        assert not site.folder.exists(), "nothing is left"


async def test_a_story_is_made_once_for_all_that_ask_and_then_sent_as_each_kind_of_file(
    tmp_path: Path, recording: Record
) -> None:
    regular = [(0.1 * step, "x") for step in range(50)]
    recording("arm", {source("/odom"): regular})
    recording("base", {source("/scan"): [*regular, (8.0, "late")]})
    (tmp_path / "base").rename(tmp_path / "arm" / "base")
    async with serving(tmp_path, tmp_path / "arm") as site:
        first, second = await asyncio.gather(site.told(f"{HIT}.json"), site.told(f"{HIT}.json"))
        for told in (first, second):
            doing = {line["doing"] for line in told[:-1]}
            assert {"wait"} < doing <= {"wait", "fetch", "merge", "story"}
            assert told[-1] == {"ready": True}
        status, body = await site.get(f"{HIT}.json")
        story = json.loads(body)
        assert (status, story["title"], story["modules"]) == (200, f"{HIT}.mcap", ["arm", "base"])
        assert [line["kind"] for line in story["lines"]] == ["gap"]
        assert b"/scan of /talker was silent" in (await site.get(f"{HIT}.html"))[1]
        assert (await site.get(f"{HIT}.mcap"))[1].startswith(b"\x89MCAP")
        assert (await site.get(f"{HIT}.bag"))[1].startswith(b"#ROSBAG V2.0")
        names = [" ".join(words[:1] if words[0] == "story" else words) for words in site.commands]
        assert names == ["record fetch", "record merge", "story", "record merge"]


async def test_processes_end_with_the_last_client_and_what_is_fetched_stays_for_the_next_one(tmp_path: Path) -> None:
    (tmp_path / "from").mkdir()
    waits = tmp_path / "waits"
    os.mkfifo(waits)
    async with serving(tmp_path, tmp_path / "from") as site:
        site.fetch = (
            "import os, pathlib, sys; folder = pathlib.Path(sys.argv[2]); folder.mkdir(exist_ok=True)"
            f"; (folder / str(os.getpid())).touch(); open({str(waits)!r}).read()"
        )
        parts = site.folder / HIT / "parts"

        def pids() -> list[str]:
            return [path.name for path in parts.glob("*")]

        asking = [asyncio.ensure_future(site.told(f"{HIT}.json")) for _ in range(2)]
        (pid,) = await until(pids)
        asking[0].cancel()
        await asyncio.wait(asking[:1])
        os.kill(int(pid), 0)  # one waits still
        asking[1].cancel()
        await until(lambda: not Path("/proc", pid).exists(), "the process goes on")
        assert pids() == [pid]
        site.fetch = "import sys; sys.exit('no')"
        assert "ended with 1" in (await site.told(f"{HIT}.json"))[-1]["error"]


def print_and_fail(**answer: str) -> str:
    return f"import sys; print({json.dumps(answer)!r}); sys.exit(1)"


async def test_why_a_file_is_not_made_is_told_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recording: Record
) -> None:
    recording("arm", {source("/odom"): [(0.0, "x")]})
    async with serving(tmp_path, tmp_path / "arm") as site:

        async def why() -> dict[str, Any]:
            return (await site.told(f"{HIT}.json"))[-1]

        site.fetch = print_and_fail(error="base is not linked; `rmpa peer list` shows why", code="peer-unlinked")
        assert await why() == {"error": "base is not linked; `rmpa peer list` shows why", "code": "peer-unlinked"}
        status, body = await site.get(f"{HIT}.bag")
        assert (status, json.loads(body)["detail"]) == (502, (await why())["error"])
        site.fetch = COPY
        for name, value, said in (
            ("RECORDING_FREE", 2**63, "almost full"),
            ("RECORDING_BYTES", 10, "rmpa record fetch"),
            ("RECORDING_TIME", 0.0, "not made within"),
            ("RECORDINGS_WAITING", 0, "429"),
        ):
            with monkeypatch.context() as patch:
                patch.setattr(limits, name, value)
                found = (await why())["error"] if said != "429" else str((await site.get(f"{HIT}.json"))[0])
                assert said in found
        with monkeypatch.context() as patch:
            patch.setattr(recordings, "find_spec", lambda _: None)
            told = await why()
            assert (told["code"], "rmpa[record]" in told["error"]) == ("extra-missing", True)
        site.files._folder = None
        assert "RMPA_STATE_DIR" in (await why())["error"]
        site.files._folder = site.folder


@pytest.mark.parametrize(("rules", "view"), [(EVERYTHING, False), (DENIED, True)])
async def test_without_a_token_or_permission_nothing_is_made(tmp_path: Path, rules: NodeRules, view: bool) -> None:
    async with serving(tmp_path, tmp_path, rules, view=view) as site:
        for kind in ("json", "mcap", "json?progress"):
            assert (await site.get(f"{HIT}.{kind}"))[0] == 403
        assert not site.commands
    async with serving(tmp_path, tmp_path) as site:
        for name in (f"{HIT}.txt", "..%2F..%2Fetc.mcap", ".mcap", "-o.mcap"):
            assert (await site.get(name))[0] == 404
        assert not site.commands


class Agent:
    """An agent with a recording of its own and one of a peer."""

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []

    def call(self, _op: str, _kind: object, **args: Any) -> Any:
        self.asked.append(args)
        if args["what"] == "keep":
            return {"arm": "", "base": "no recorder has run here"}
        if args["what"] == "remove" and args["module"] == "base":
            raise RmpaError("arm may not use the recording")
        kept = (Kept(id=HIT, size=3), Kept(id="20261129-121500-base-stop"))
        found = tuple(ModuleRecordings(module=name, kept=kept) for name in ("arm", "base"))
        as_json: list[Any] = [{"module": "arm", "kept": [{"id": one.id} for one in kept], "status": {"messages": {}}}]
        return as_json if _kind is object else found


async def test_what_is_kept_is_listed_kept_and_removed_by_the_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = Agent()
    monkeypatch.setattr(questions, "choose_agent", lambda *_: SimpleNamespace(path=""))
    monkeypatch.setattr(questions, "ControlClient", lambda *_: nullcontext(agent))

    def answers(rules: NodeRules, module: str = "arm") -> Answers:
        hub: Any = FakeHub()
        hub.link = SimpleNamespace(rules=rules)
        none: Any = None
        return Answers(hub, none, none, lambda: module, {})

    asks: Callable[[Answers, str], Any] = lambda one, what: one.answer(what, {"name": HIT, "why": "hit"})  # noqa: E731
    with closing(answers(EVERYTHING)) as free:
        (module,) = await asks(free, "recordings")
        assert (next(one["id"] for one in module["kept"]), module["status"]) == (HIT, {})
        assert (await asks(free, "keep_recording"))["base"] == "no recorder has run here"
        assert await asks(free, "remove_recording") == {"base": "arm may not use the recording"}
    assert [args for args in agent.asked if args["what"] != "list"] == [
        {"what": "keep", "why": "hit"},
        *({"what": "remove", "module": each, "id": HIT} for each in ("arm", "base")),
    ]
    agent.asked.clear()
    with closing(answers(DENIED)) as bound:
        (module,) = await asks(bound, "recordings")
        assert [one["id"] for one in module["kept"]] == ["20261129-121500-base-stop"]
        for what in ("keep_recording", "remove_recording"):
            with pytest.raises(PeerRefused, match="web may not record /"):
                await asks(bound, what)
    assert [args["what"] for args in agent.asked] == ["list"]
    assert [QUESTIONS[each] for each in ("recordings", "keep_recording", "remove_recording")] == [
        "view", "control", "control"
    ]  # fmt: skip
