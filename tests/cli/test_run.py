"""``rmpa run``: files that cannot be run, and the life of a module's agent beside its resources."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from lab.bed.processes import Process, eventually
from rmpa.cli.run import _module_name, prepared
from rmpa.config.module_name import keep_name
from rmpa.core.errors import ConfigError
from tests.cli.conftest import Place
from tests.interop.ros import free_port

pytestmark = pytest.mark.timeout(120)
HEAD = """\
import os, sys, threading, time
from rmpa.resource import Resource
nose = Resource("nose", role="sensing", physical=False)
words = nose.output("words", "std_msgs/String")
volume = nose.parameter("volume", 5, low=0, high=11)
@nose.profile(offers={"rate": "5 Hz"})
def plain(): pass
"""
TALK = """\
@nose.task(rate="20 Hz")
def talk(): words.publish(data=str(volume.value))
"""


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("import rmpa.resource\nnose = Resource(\n", 2, "SyntaxError"),
        ("\n\nimport rmpa.resourse\n", 3, "ModuleNotFoundError: No module named 'rmpa.resourse'"),
        ("import os\nimport nose_msgs.msg\n", 2, "No module named 'nose_msgs'; a resource needs no module of ROS"),
        ("def deeper():\n    return 1 / 0\n\ndeeper()\n", 2, "ZeroDivisionError"),
        ("import sys\nsys.exit('no sonar is plugged in')\n", 2, "no sonar is plugged in"),
        ("print('hello')\n", None, "it declares no resource"),
        (HEAD + "other = Resource('nose', role='acting')\n", None, "resource nose: there are two of this name"),
        (HEAD + "\nnose.parameter('gain', 1.0, low=5, high=2)\n", 9, "the bounds are the wrong way round"),
        (HEAD + "nose.output('sight', 'sensor_msgs/Imagge')\n", 8, "sensor_msgs/Imagge"),
        (HEAD + "Resource('eye', role='sensin')\n", 8, "did you mean sensing?"),
        (HEAD + "@nose.profile(offers={'rat': 5})\ndef loud(): pass\n", 8, "did you mean rate?"),
        (HEAD + "@nose.task(rate='5 m')\ndef shout(): pass\n", 8, "'m' is a unit of length"),
        ("from rmpa.resource import Resource\nnose = Resource('nose', role='sensing')\n", None, "no System Profile"),
    ],
)
def test_a_file_that_cannot_be_run_is_refused_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, line: int | None, said: str
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    path = tmp_path / "nose.py"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        prepared(path)
    assert said in str(caught.value)
    assert str(caught.value).count(str(path)) == 1
    assert caught.value.line == line


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("volume", "'volume' gives no value"),
        ("volum=3", "there is no parameter volum; did you mean volume?"),
        ("volume=loud", "'loud' is no int"),
        ("nose.volume=12", "12 is too much; the most is 11"),
        ("ear.volume=1", "there is no parameter ear.volume"),
    ],
)
def test_a_parameter_that_cannot_be_given_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str, said: str
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    path = tmp_path / "nose.py"
    path.write_text(HEAD)
    with pytest.raises(ConfigError) as caught:
        prepared(path, [given])
    assert said in str(caught.value)


class Ground:
    """Runs files and agents on this machine's loopback, and checks what they leave behind."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self.port = free_port()
        multicast = f"239.255.82.77:{20000 + os.getpid() % 12000}"
        self.options = ("--interface", "lo", "--core-port", str(self.port), "--multicast", multicast)
        self.started: list[Process] = []

    @property
    def uri(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def rmpa(self, *words: str) -> Process:
        env = {**self.place.environ, "RMPA_LOG_LEVEL": "debug"}  # it has each change of the graph
        process = Process([sys.executable, "-m", "rmpa.cli.main", *words], env=env, name=words[0])
        self.started.append(process)
        return process

    def run(self, text: str, *words: str, options: bool = True) -> Process:
        path = self.place.path / "nose.py"
        path.write_text(text)
        return self.rmpa("run", str(path), *words, *(("--", *self.options) if options else ()))

    def hears(self, volume: str) -> None:
        """Wait until a node of this core receives the resource's messages."""

        def echo() -> bool:
            code, out, _ = self.place.run("topic", "echo", "/nose/words", "-n", "1", "--json", "--master", self.uri)
            return code == 0 and json.loads(out)["message"]["data"] == volume

        eventually(echo, 30, what=f"{volume} on /nose/words")


@pytest.fixture
def ground(place: Place) -> Iterator[Ground]:
    one = Ground(place)
    yield one
    for process in one.started:
        process.end()
    # The agent is in a session of its own and may have another parent by now: it is found by its port.
    left = [p for p in psutil.process_iter(["cmdline"]) if str(one.port) in (p.info["cmdline"] or [])]
    _, alive = psutil.wait_procs(left, timeout=20)
    for orphan in alive:
        orphan.kill()
    assert not alive, "an agent is left"


def agent_of(run: Process) -> psutil.Process:
    (agent,) = psutil.Process(run.pid).children()
    assert "up" in agent.cmdline()
    return agent


def test_a_file_runs_with_its_own_agent_and_ends_in_order(ground: Ground) -> None:
    run = ground.run(HEAD + TALK, "--set", "volume=7")
    run.wait_for(f"nose: active on {ground.uri}", 60)
    agent = agent_of(run)
    ground.hears("7")
    # As a terminal does: to the whole foreground group. The agent is in a session of its own.
    assert run.interrupt() == 0, run.output
    assert not agent.is_running()
    # The first line is the agent's, the second the resource's: which of two processes writes first is chance.
    unregistered, ended, ending = map(run.output.index, ("- publisher /nose/words", "nose: ended", "= ending"))
    assert max(unregistered, ended) < ending, "the resource first, then its agent"
    assert "Traceback" not in run.output


def test_an_agent_that_runs_already_is_used_and_stays(ground: Ground) -> None:
    up = ground.rmpa("up", "--name", "head", *ground.options)
    eventually(lambda: ground.place.run("peer", "list")[0] == 0, 30, what="the agent")
    late = ground.run(HEAD + TALK, "--name", "head")
    assert late.wait() == 2
    assert "an agent head runs already; its options were given when it was started" in late.output
    run = ground.run(HEAD + TALK, "--name", "head", options=False)
    run.wait_for(f"nose: active on {ground.uri}", 60)
    assert not psutil.Process(run.pid).children()
    twin = ground.run(HEAD + TALK, "--name", "head", options=False)
    assert twin.wait() == 1
    assert f"a node /nose runs there already (process {run.pid})" in twin.output
    ground.hears("5")
    assert run.terminate() == 0, run.output
    assert up.returncode is None
    assert "- publisher /nose/words" in up.output
    assert up.interrupt() == 0


def test_without_its_agent_a_resource_ends_and_says_so(ground: Ground) -> None:
    run = ground.run(HEAD + TALK)
    run.wait_for("nose: active on", 60)
    agent_of(run).kill()
    assert run.wait() == 1
    assert "rmpa: the module's agent: it ended with code -9" in run.output
    assert "Traceback" not in run.output
    # What cannot start is said as well, with the agent's own words.
    wrong = ground.run(HEAD + TALK, "--", "--interfaze", "lo", options=False)
    assert wrong.wait() == 1
    assert "--interfaze" in wrong.output
    assert "rmpa: agent nose: it ended with code 2; see its lines above" in wrong.output


def test_a_bad_file_leaves_no_agent(ground: Ground) -> None:
    run = ground.run("import nosuchmodule\n", "--name", "nose")
    assert run.wait() == 2
    assert "nose.py:1" in run.output
    assert "Traceback" not in run.output
    assert ground.place.run("peer", "list")[0] != 0, "no agent is left"


def test_exceptions_are_contained_and_a_crash_ends_in_order(ground: Ground) -> None:
    moody = TALK + '@nose.task(rate="2 Hz")\ndef sulk():\n    if volume.value == 5: raise OSError("no air")\n'
    crash = '@nose.task(rate="2 Hz", name="crash")\ndef crash():\n    if os.path.exists("now"): os.abort()\n'
    text = HEAD + moody + crash.replace('"now"', repr(str(ground.place.path / "now")))
    run = ground.run(text)
    run.wait_for("task sulk failed: OSError: no air")
    ground.hears("5")
    agent = agent_of(run)
    assert list(ground.place.path.glob("**/nose.sock"))
    (ground.place.path / "now").touch()
    assert run.wait() == -signal.SIGABRT
    psutil.wait_procs([agent], timeout=20)
    assert not agent.is_running(), "no agent is left behind"
    assert not list(ground.place.path.glob("**/nose.sock")), "it has ended in order, and taken its socket with it"


def test_a_thread_that_hangs_does_not_keep_it_from_its_end(ground: Ground) -> None:
    hung = 'def mine():\n    print("hangs", flush=True)\n    time.sleep(1000)\n'
    run = ground.run(HEAD + hung + TALK + 'threading.Thread(target=mine, name="of mine").start()\n')
    run.wait_for("nose: active on", 60)
    run.wait_for("hangs")
    agent = agent_of(run)
    assert run.interrupt() == 1  # the interpreter would wait for the user's own thread for ever
    assert "! of mine does not return; the program ends without it" in run.output
    assert not agent.is_running()


def test_told_twice_it_ends_at_once(ground: Ground) -> None:
    hook = '@nose.on("finalize")\ndef last():\n    print("finalizing", flush=True)\n    time.sleep(1000)\n'
    run = ground.run(HEAD + TALK + hook)
    run.wait_for("nose: active on", 60)
    agent = agent_of(run)
    run.send(signal.SIGINT)
    run.wait_for("finalizing")
    assert run.interrupt() == 130
    psutil.wait_procs([agent], timeout=20)
    assert not agent.is_running()


def test_it_can_be_ended_while_it_starts(ground: Ground) -> None:
    run = ground.run(HEAD + 'print("reading", flush=True)\ntime.sleep(1000)\n', "--name", "nose")
    run.wait_for("reading")
    agent = agent_of(run)
    assert run.terminate() == 130
    assert not agent.is_running()
    assert "Traceback" not in run.output


def test_without_a_name_the_module_is_that_of_rmpa_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMPA_STATE_DIR", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert _module_name(()) == ""  # the first resource names it
    keep_name(tmp_path, "arm")
    assert _module_name(("--interface", "lo")) == "arm"
    (tmp_path / "own.toml").write_text('name = "nose"\n')
    assert _module_name(("--config", "own.toml")) == "nose"
    monkeypatch.setenv("RMPA_NAME", "said")
    assert _module_name(("--config", "own.toml")) == "said"
