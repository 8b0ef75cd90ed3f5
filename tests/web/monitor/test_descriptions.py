"""Files of resources: which a page may read, what it may change in them, and how they are saved."""

from __future__ import annotations

import os
import stat
import sys
from contextlib import closing, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rmpa.config.peer_rules import PermissionRule
from rmpa.config.settings import TrustSettings
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.resource.description import resource_schema
from rmpa.trust.permissions import Permissions
from rmpa.web.hub.node_link import EVERYTHING, NodeRules
from rmpa.web.monitor import descriptions, limits, questions
from rmpa.web.monitor.descriptions import STARTS, Descriptions, help_of
from rmpa.web.monitor.questions import QUESTIONS, Answers
from tests.web.monitor.wrapped import FILE, CheckedHere, check
from tests.web.recorder import FakeHub

# A file with all that says how programs are started.
TEXT = """\
role = "sensing"

[node.driver]
name = "/usb_cam"
launch = "usb_cam usb_cam.launch"
args = ["gdb:=false"]
env = { DISPLAY = ":0" }
params = { video_device = "/dev/video0" }
remap = { image = "/image" }
restart = "never"

[node.viewer]
run = "image_view image_view"

[output.image]
topic = "/usb_cam/image_raw"
type = "sensor_msgs/Image"

[parameter.fps]
arg = "fps"
node = "driver"
default = 30
choices = [10, 30]

[parameter.gain]
dynamic = "gain"
node = "driver"
default = 1

[profile.full]
set = { fps = 30 }
offers = { rate = "30 Hz" }
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "resources"
    made.mkdir()
    return made


@pytest.fixture
def files(folder: Path) -> Descriptions:
    files = CheckedHere(folder)
    (folder / FILE).write_text(TEXT)
    return files


def save(files: Descriptions, text: str, before: str = TEXT) -> dict[str, Any]:
    return files.save(FILE, text, descriptions._digest(before))


def test_a_change_is_saved_whole_and_the_file_before_is_kept(folder: Path, files: Descriptions) -> None:
    (folder / FILE).chmod(0o640)
    read = files.read(FILE)
    assert read["text"] == TEXT
    new = TEXT.replace('"30 Hz"', '"25 Hz"')
    saved = save(files, new)
    assert (saved["problems"], saved["backup"]) == ([], f"{FILE}.bak")
    assert (folder / FILE).read_text() == new
    assert (folder / f"{FILE}.bak").read_text() == TEXT
    assert {stat.S_IMODE(each.stat().st_mode) for each in folder.iterdir()} == {0o640}
    assert {each.name for each in folder.iterdir()} == {FILE, f"{FILE}.bak"}
    with pytest.raises(RmpaError, match="it has changed since this page read it"):
        save(files, TEXT)  # another page still shows the text before
    assert save(files, TEXT, new)["digest"] == read["digest"]


def test_what_is_wrong_is_told_with_its_line_and_nothing_is_saved(folder: Path, files: Descriptions) -> None:
    for text, line, said in (
        (TEXT.replace("choices", "choises"), 23, "choises"),
        (TEXT.replace("30 Hz", "30 apples"), 32, "apples"),
        (TEXT.replace("[profile.full]", "[profile.full"), 30, "]"),
    ):
        (problem,) = save(files, text)["problems"]
        assert (problem["line"], said in problem["problem"]) == (line, True), problem
        assert files.check(FILE, text) == [problem]
    assert (folder / FILE).read_text() == TEXT


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('run = "image_view image_view"', 'command = ["/bin/sh", "-c", "id"]', 12),
        ('run = "image_view image_view"', 'run = "xterm xterm"', 12),
        ('launch = "usb_cam usb_cam.launch"', 'launch = "/tmp/mine.launch"', 3),
        ('"gdb:=false"', '"launch-prefix:=xterm -e"', 3),
        ("[output.image]", '[node.shell]\nname = "/shell"\ncommand = ["/bin/sh"]\n\n[output.image]', 15),
        ('[node.viewer]\nrun = "image_view image_view"', "", 1),
        ('env = { DISPLAY = ":0" }', 'env = { LD_PRELOAD = "/tmp/a.so" }', 3),
        ('params = { video_device = "/dev/video0" }', 'params = { video_device = "/dev/mem" }', 3),
        ('remap = { image = "/image" }', 'remap = { image = "/cmd_vel" }', 3),
        ('name = "/usb_cam"', 'name = "/other"', 3),
        # What an argument of a launch file may be is part of it.
        ("choices = [10, 30]\n", "", 19),
        ("default = 30\nchoices = [10, 30]", 'default = "30"\nchoices = ["10", "30"]', 19),
        ('arg = "fps"', 'dynamic = "fps"', 19),
        ('dynamic = "gain"', 'arg = "launch_prefix"', 25),
    ],
)  # fmt: skip
def test_how_programs_are_started_is_not_changed_by_a_page(
    folder: Path, files: Descriptions, old: str, new: str, line: int
) -> None:
    assert old in TEXT
    text = TEXT.replace(old, new)
    if 'default = "30"' in new:
        text = text.replace("fps = 30", 'fps = "30"')
    (problem,) = save(files, text)["problems"]
    assert (problem["line"], STARTS in problem["problem"]) == (line, True), problem
    assert (folder / FILE).read_text() == TEXT
    assert not (folder / f"{FILE}.bak").exists()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('restart = "never"', 'restart = "always"\nstop_after = "3 s"'),
        ("default = 30", "default = 10"),
        ("set = { fps = 30 }", "set = { fps = 10 }\ncost = 2"),
        ('role = "sensing"', 'role = "sensing"\ndescription = "in front"  # [node.driver]'),
    ],
)
def test_all_else_is_changed(files: Descriptions, old: str, new: str) -> None:
    assert save(files, TEXT.replace(old, new))["problems"] == []


def test_only_files_of_the_folder_are_shown(folder: Path, files: Descriptions, tmp_path: Path) -> None:
    outside = tmp_path / "secret.resource.toml"
    outside.write_text(TEXT)
    (folder / "link.resource.toml").symlink_to(outside)
    (folder / "folder.resource.toml").mkdir()
    os.mkfifo(folder / "pipe.resource.toml")
    (folder / "long.resource.toml").write_bytes(b"#" * (limits.DESCRIPTION_MAX + 1))
    (folder / "latin.resource.toml").write_bytes(b"# \xe4")
    (folder / "camera.toml").write_text(TEXT)
    asked = (
        "../secret.resource.toml",
        str(outside),
        "camera.toml",
        ".resource.toml",
        "new.resource.toml",
        "",
        "a/../",
    )
    for name in (
        *asked,
        *(f"{each}.resource.toml" for each in ("link", "folder", "pipe", "long", "latin", ".", "a\0")),
    ):
        before = {*folder.iterdir()}
        with pytest.raises(RmpaError):
            files.read(name)
        with pytest.raises(RmpaError):
            files.check(name, TEXT)
        with pytest.raises(RmpaError):
            files.save(name, TEXT, descriptions._digest(TEXT))
        assert {*folder.iterdir()} == before, name
    with pytest.raises(RmpaError, match=r"no folder of resources; name one as folder of \[resources\]"):
        Descriptions().read(FILE)


def program(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another program in the place of this one."""
    monkeypatch.setattr(descriptions, "own_command", lambda *words: [sys.executable, "-c", text, *words])


def test_the_check_is_a_program_of_its_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / FILE).write_text(TEXT)
    files = Descriptions(str(folder))
    wrong = (
        "import json, pathlib, sys; *words, path = sys.argv[1:]; lines = pathlib.Path(path).read_text().split('\\n')"
        "; assert words == ['resource', 'check', '--offline', '--json']; at = lines.index('bad') + 1"
        "; print(json.dumps({'found': [{'line': at, 'where': 'role', 'problem': path.rpartition('/')[2]}]}))"
        "; sys.exit(2)"
    )
    program(wrong, monkeypatch)
    assert files.check(FILE, "\nbad\n") == [{"line": 2, "problem": f"role: {FILE}", "remedy": ""}]
    for text in ("print('{}')", "import sys; sys.exit(2)", "import sys; print('{\"found\": []}'); sys.exit(1)"):
        program(text, monkeypatch)
        if text.startswith("print"):
            assert save(files, TEXT)["problems"] == []
        else:
            with pytest.raises(RmpaError, match=r"ended with \d, and nothing is saved"):
                save(files, TEXT)
    program("raise SystemExit(2)", monkeypatch)
    assert files.read(FILE)["help"] == {}  # the keys are not explained then


def test_the_help_of_a_key_is_that_of_the_schema() -> None:
    found = help_of(resource_schema())
    assert found["node.run"].startswith("Started as by rosrun")
    assert found["role"].startswith("sensing")
    assert found["start.boot"]


class Agent:
    def __init__(self) -> None:
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.problem = ""

    def call(self, op: str, _kind: object, **args: Any) -> Any:
        self.asked.append((op, {key: value for key, value in args.items() if value is not None}))
        resources = [{"name": "camera"}, {"name": "laser"}]
        return [{"module": args.get("module") or "pc", "problem": self.problem, "code": "x", "resources": resources}]


@pytest.fixture
def agent(monkeypatch: pytest.MonkeyPatch) -> Agent:
    agent = Agent()
    monkeypatch.setattr(questions, "choose_agent", lambda *_: SimpleNamespace(path=""))
    monkeypatch.setattr(questions, "ControlClient", lambda *_: nullcontext(agent))
    return agent


def answers_of(rules: NodeRules = EVERYTHING, folder: str = "") -> Answers:
    hub: Any = FakeHub()
    hub.link = SimpleNamespace(rules=rules)
    none: Any = None
    answers = Answers(hub, none, none, str, {})
    answers.descriptions = Descriptions(folder, check)
    return answers


async def test_a_resource_of_any_module_is_started_by_its_agent_and_under_control_alone(agent: Agent) -> None:
    with closing(answers_of()) as answers:
        await answers.answer("launches", {})
        await answers.answer("top", {})
        await answers.answer("launch", {"do": "start", "name": "camera", "module": ""})
        await answers.answer("launch", {"do": "log", "name": "base", "module": "arm", "after": {"": 7}, "run": "id"})
        for wrong in ({"do": "list", "name": "camera"}, {"name": "camera"}, {"do": "start", "name": ["camera"]}):
            with pytest.raises(RmpaError):
                await answers.answer("launch", wrong)
        agent.problem = "pc may not start /base"
        with pytest.raises(RmpaError, match="arm: pc may not start /base"):
            await answers.answer("launch", {"do": "stop", "name": "base", "module": "arm"})
    assert agent.asked == [
        ("launch", {"what": "list"}),
        ("top", {}),
        ("launch", {"what": "start", "name": "camera"}),
        ("launch", {"what": "log", "name": "base", "module": "arm", "after": {"": 7}}),
        ("launch", {"what": "stop", "name": "base", "module": "arm"}),
    ]
    ordered = ("launch", "description", "check_description", "save_description")
    assert {QUESTIONS[each] for each in ordered} == {"control"}


async def test_in_a_secured_mesh_the_module_web_needs_the_permission(agent: Agent, folder: Path) -> None:
    (folder / FILE).write_text(TEXT)
    rule = PermissionRule(("web",), names={"launch": ("/laser",)})
    rules = NodeRules(Permissions(TrustSettings(default="allow", rules=(rule,))))  # no default gives it
    with closing(answers_of(rules, str(folder))) as answers:
        (told,) = await answers.answer("launches", {})
        assert [each["name"] for each in told["resources"]] == ["laser"]
        agent.asked.clear()
        for what, args in (
            *(("launch", {"do": each, "name": "camera"}) for each in ("start", "stop", "restart", "log")),
            ("description", {"file": FILE}),
            ("check_description", {"file": FILE, "text": TEXT}),
            ("save_description", {"file": FILE, "text": TEXT, "digest": descriptions._digest(TEXT)}),
        ):
            with pytest.raises(PeerRefused, match="web may not launch /camera"):
                await answers.answer(what, args)
        assert not agent.asked
        await answers.answer("launch", {"do": "start", "name": "laser"})
    assert not (folder / f"{FILE}.bak").exists()
