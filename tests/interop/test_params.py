"""Parameters and dynamic_reconfigure between modules."""

from __future__ import annotations

import ast
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from lab.bed.agents import RMPA
from lab.bed.namespaces import Lab
from lab.bed.processes import Event, Process, eventually
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module
from tests.interop.ros import PYTHON, Ros, free_port, lacks

pytestmark = [pytest.mark.ros, pytest.mark.timeout(150)]
Configured = Callable[..., list[Module]]
URDF = (
    "<?xml version='1.0'?>\n<robot name=\"one\">\n  <link name='base'/>  <!-- it's \"here\" & <there> -->\n</robot>\n"
)
PARAMETERS = """
speed: 1.5
count: -3
tiny: 1.0e-07
enabled: true
names: [a, 'on', "1.5", [], {}]
gains: {p: 1, i: 0.5, nested: {deep: 'x: y'}}
words: "it's a text, longer than a line of YAML may be, so that it is broken where a space stands in it"
lines: "one\\n two\\n\\nthree\\n"
unicode: "\\u00e9\\u2603"
angle: deg(90)
half: rad(pi/2)
octal: 010
exponent: 1e3
"""


def rmpa(ros: Ros, *words: str) -> str:
    """An ``rmpa param`` beside a user's shell; must succeed."""
    with Process([RMPA, "param", *words, "--master", ros.uri], env=ros.env) as process:
        assert process.wait() == 0, process.output
        return process.output


def test_what_rosparam_writes_and_reads(shell: ShellFactory, tmp_path: Path) -> None:
    files = {name: tmp_path / f"{name}.yaml" for name in ("in", "theirs", "ours")}
    files["in"].write_text(PARAMETERS)
    with shell(port=free_port()) as ros:
        ros.master()
        ros.tool("rosparam", "load", str(files["in"]), "/theirs")
        assert rmpa(ros, "load", str(files["in"]), "/ours") == ""
        (tmp_path / "urdf").write_text(URDF)
        ros.tool("rosparam", "set", "/theirs/urdf", "-t", str(tmp_path / "urdf"))
        rmpa(ros, "set", "/ours/urdf", "-t", str(tmp_path / "urdf"))
        rmpa(ros, "set", "/ours/more", "{a: -5, b: {c: ''}}")
        ros.tool("rosparam", "set", "/theirs/more", "{a: -5, b: {c: ''}}")
        ros.tool("rosparam", "dump", str(files["theirs"]), "/theirs")
        rmpa(ros, "dump", str(files["ours"]), "/theirs")
        assert files["ours"].read_text() == files["theirs"].read_text()
        # What we loaded is, type by type, what they did.
        ros.tool("rosparam", "dump", str(files["ours"]), "/ours")
        assert files["ours"].read_text() == files["theirs"].read_text()
        for key in ("/theirs/speed", "/theirs/names", "/theirs/gains", "/theirs/lines", "/theirs/tiny"):
            assert rmpa(ros, "get", key) == ros.tool("rosparam", "get", key).rstrip("\n"), key
        assert rmpa(ros, "get", "-p", "/ours/urdf").split("\n") == URDF.split("\n")
        assert rmpa(ros, "list").split() == ros.tool("rosparam", "list").split()
        rmpa(ros, "delete", "/ours/gains")
        assert "/ours/gains/p" not in ros.tool("rosparam", "list").split()


def param(module: Module, *words: str, code: int = 0) -> str:
    """``rmpa param`` on a module."""
    status, output = module.agent.rmpa("param", *words)
    assert status == code, output
    return output


def has(module: Module, key: str, value: str | None) -> None:
    """Wait until the stock rosparam says so; ``None``: there is no such parameter."""

    def there() -> bool:
        if value is None:
            return key not in module.ros.tool("rosparam", "list").split()
        return (
            key in module.ros.tool("rosparam", "list").split()
            and module.ros.tool("rosparam", "get", key).strip() == value
        )

    eventually(there, what=f"{key} {value} at {module.name}")


@pytest.mark.netns
def test_a_peers_parameters_are_read_and_set(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", config='[params]\nremote_set = ["/open/**", "/run_id", "/big"]\nremote_get = ["/**"]\n')
    (tmp_path / "all.yaml").write_text(PARAMETERS)
    a.ros.tool("rosparam", "load", str(tmp_path / "all.yaml"), "/open")
    theirs = a.ros.tool("rosparam", "get", "/open")
    assert param(b, "get", "--peer", "a", "/open").strip() == theirs.strip(), "every type survives"
    assert "/open/gains/nested/deep" in param(b, "list", "--peer", "a", "/open").split()
    param(b, "load", "--peer", "a", str(tmp_path / "all.yaml"), "/open/again")
    assert a.ros.tool("rosparam", "get", "/open/again").strip() == theirs.strip()
    # Binary data, which rosparam itself cannot print with Python 3.
    (tmp_path / "blob").write_bytes(bytes(range(256)))
    param(b, "set", "--peer", "a", "/open/blob", "-b", str(tmp_path / "blob"))
    assert param(b, "get", "--peer", "a", "/open/blob") == param(a, "get", "/open/blob")
    assert "!!binary" in param(a, "get", "/open/blob")
    (tmp_path / "big").write_text("<x a='1'/>\n" * 300_000)
    param(b, "set", "--peer", "a", "/big", "-t", str(tmp_path / "big"))
    assert json.loads(param(b, "get", "--peer", "a", "/big", "--json")) == (tmp_path / "big").read_text()
    param(b, "delete", "--peer", "a", "/big")
    has(a, "/big", None)
    for words, error in (
        (("get", "--peer", "a", "/nothing"), "there is no parameter /nothing"),
        (("set", "--peer", "a", "/run_id", "1"), "/run_id is never set from another module"),
        (("set", "--peer", "a", "/roslaunch", "1"), "never set from another module"),
        (("set", "--peer", "a", "/use_sim_time", "true"), "time is followed by [time] alone"),
        (("set", "--peer", "a", "/closed", "1"), "no glob of params.remote_set fits"),
        (("set", "--peer", "a", "/", "{open: {x: 1}, closed: 1}"), "no glob of params.remote_set fits"),
        (("set", "--peer", "a", "/open/x", "[1,"), "not YAML"),
        (("set", "--peer", "a", "/open/x", "{a: null}"), "/a: null is no value of a parameter"),
        (("get", "--peer", "nobody", "/x"), "nobody"),
    ):
        assert error in param(b, *words, code=1), words
    assert "/open/x" not in a.ros.tool("rosparam", "list").split(), "what cannot be set as a whole is not set in part"


@pytest.fixture
def configured(lab: Lab, shell: ShellFactory, agent: AgentFactory) -> Configured:
    """Linked modules on one network, by name each with a configuration of its own; those without have a roscore."""

    def make(**configs: str) -> list[Module]:
        made = []
        for host in lab.hosts(*configs):
            ros, config, flags = shell(host), configs[host.name], tuple[str, ...]()
            if not config:
                ros.roscore()
                flags = ("--core", "external", "--master", ros.uri)
            made.append(Module(host, agent(host, name=host.name, config=config, flags=flags), ros))
        for first, one in enumerate(made):
            for other in made[first + 1 :]:
                one.agent.wait_peer(other.name)
        return made

    return make


@pytest.mark.netns
def test_followed_parameters(configured: Configured, tmp_path: Path) -> None:
    description = "/a/robot_description"
    rules = f'[[param]]\nkey = "/robot_description"\nfrom = "a"\nto = "{description}"\n'
    rules += "".join(f'[[param]]\nkey = "{key}"\nfrom = "a"\n' for key in ("/arm", "/big"))
    a, b = configured(a="", b=rules)
    a.ros.tool("rosparam", "set", "/robot_description", "one")
    a.ros.tool("rosparam", "set", "/arm", "{p: 1, q: {r: 2.5}}")
    has(b, description, "one")
    has(b, "/arm/q/r", "2.5")
    a.ros.tool("rosparam", "set", "/arm/q/r", "3.5")
    a.ros.tool("rosparam", "delete", "/arm/p")
    has(b, "/arm/q/r", "3.5")
    has(b, "/arm/p", None)
    (tmp_path / "big").write_text("<x a='1'/>\n" * 300_000)
    a.ros.tool("rosparam", "set", "/big", "-t", str(tmp_path / "big"))
    eventually(lambda: "/big" in b.ros.tool("rosparam", "list").split(), what="the large one")
    # One owner: a value that is set here or by another peer is put back, with a warning.
    b.ros.tool("rosparam", "set", description, "mine")
    b.agent.process.wait_for(f"{description} was changed here, and is put back: it belongs to a")
    has(b, description, "one")
    assert "it is followed from a:/robot_description" in param(a, "set", "--peer", "b", description, "x", code=1)
    rows = json.loads(param(b, "followed", "--json"))
    states = {description: "followed", "/arm": "followed", "/big": "followed"}
    assert {row["key"]: row["state"] for row in rows} == states
    # The owner's agent goes: the value stays. It comes back, and its core has another one by then.
    a.agent.kill()
    b.agent.wait_no_peer("a")
    assert b.ros.tool("rosparam", "get", description).strip() == "one"
    a.ros.tool("rosparam", "set", "/robot_description", "two")
    a.agent.restart()
    has(b, description, "two")
    assert b.ros.tool("rosparam", "get", "/arm/q/r").strip() == "3.5"


@pytest.mark.netns
def test_time_comes_from_one_simulator(configured: Configured) -> None:
    sim, robot, other = configured(
        sim="[time]\nshare = true\n", robot='[time]\nfollow = "sim"\n', other='[time]\nfollow = "robot"\n'
    )
    sim.ros.rospy("clock", "__name:=simulator", start=1000, speed=4).wait_event("up")
    sim.ros.tool("rosparam", "set", "/use_sim_time", "true")
    has(robot, "/use_sim_time", "true")
    robot.wait_topic("/clock")
    sleeper = robot.ros.rospy("sleeper")
    told = sleeper.wait_event("time", where=lambda e: float(str(e["now"])) > 1000)
    assert float(str(told["now"])) < 2000, "the simulator's time, not the wall's"
    # Half a second of it is an eighth of one here.
    sleeper.wait_event("time", where=lambda e: float(str(e["took"])) < 0.4)
    # A module that does not share its time gives it to no follower, even if it follows another one.
    assert "/clock" not in other.topics()
    assert "time comes from sim here" in json.loads(param(other, "followed", "--json"))[0]["problem"]
    assert "/use_sim_time is not followed: time comes from sim here" in other.agent.rmpa("peer", "list")[1]
    # A second source is refused, and that is said, on both sides.
    sim.ros.rospy("clock", "__name:=second", start=9000).wait_event("up")
    robot.agent.process.wait_for("time comes from /simulator of sim already, and has one source")
    code, output = robot.agent.rmpa("topic", "info", "/clock", "--json")
    assert code == 0, output
    assert [end["remote_node"] for end in json.loads(output)["publishers"]] == ["/simulator"]
    now = sleeper.wait_event("time", since=sleeper.mark_events())
    assert float(str(now["now"])) < 9000
    # The module that is followed may change while the agent runs.
    path = other.agent.home / f"{other.name}.toml"
    path.write_text(path.read_text().replace('"robot"', '"sim"'))
    code, output = other.agent.rmpa("reload")
    assert code == 0, output
    has(other, "/use_sim_time", "true")
    other.wait_topic("/clock")


LAMP: Final = Path(__file__).parent / "resources" / "lamp.py"
DYNPARAM: Final = "/usr/lib/dynamic_reconfigure/dynparam"
LONG: Final = 40.0


@pytest.fixture
def pair(modules: ModuleFactory) -> Iterator[list[Module]]:
    """The lamp's module, where it runs, and another one."""
    both = modules("robot", "pc")
    argv = both[0].host.command([RMPA, "run", LAMP, "--name", both[0].name])
    with Process(argv, env=both[0].agent.env, name="lamp.py") as process:
        process.wait_for("active on", LONG)
        both[1].wait_topic("/lamp/parameter_descriptions")
        yield both


def change(client: Process, **values: object) -> Event:
    since = client.mark_events()
    client.tell(json.dumps(values))
    return client.wait_event("configured", LONG, since=since)


def rmpa_of(module: Module, *words: str) -> str:
    code, out = module.agent.rmpa(*words)
    assert code == 0, out
    return out


@pytest.mark.netns
@pytest.mark.skipif(bool(lacks("dynamic_reconfigure")), reason=lacks("dynamic_reconfigure") or "it is there")
def test_dynamic_reconfigure_works_from_another_module(pair: list[Module]) -> None:
    robot, pc = pair
    client = pc.ros.rospy("configurer", name="far", commands=True)
    up = client.wait_event("up", LONG)
    assert up["servers"] == ["/lamp"]
    first = {"level": 1.0, "steps": 3, "on": True, "colour": "white", "profile": "", "context": ""}
    assert up["config"] == first
    described: Any = {each["name"]: each for each in up["descriptions"]}  # type: ignore[attr-defined] # JSON
    assert (described["level"]["min"], described["level"]["max"], described["level"]["type"]) == (0.0, 10.0, "double")
    assert described["level"]["description"] == "of the supply [V]"
    assert "'value': 'blue'" in described["colour"]["edit_method"]
    for name, each in described.items():  # what rqt_reconfigure's editors look up when they are opened
        if each["edit_method"]:
            values = [item["value"] for item in ast.literal_eval(each["edit_method"])["enum"]]
            assert each["default"] in values, name
            assert first[name] in values, name
        elif each["type"] == "int":  # a slider's ends have 32 bits
            assert -(2**31) <= int(each["min"]) < int(each["max"]) < 2**31, name

    since = client.mark_events()
    done = change(client, level=99, steps="7", on="false", colour="BLUE", profile="fast")
    now = {"level": 10.0, "steps": 7, "on": False, "colour": "blue", "profile": "fast", "context": ""}
    assert done["answer"] == now, done
    update = client.wait_event("update", LONG, since=since)
    assert update["config"] == now  # all of it at once
    eventually(lambda: robot.ros.tool("rosparam", "get", "/lamp/colour").strip() == "blue", what="the mirror")
    assert robot.ros.tool("rostopic", "echo", "-n1", "/lamp/profile").splitlines()[0] == 'data: "fast"'

    for wrong in ({"profile": "fsat"}, {"colour": "pink"}, {"profile": "broken", "level": 1}, {"context": "home"}):
        refused = change(client, **wrong)
        assert "service call failed" in str(refused["error"]), wrong
    assert change(client)["answer"] == now
    assert change(client, profile="automatic", context="away")["answer"] == now | {"profile": "", "context": "away"}
    client.end()

    for module in pair:  # the command-line tool, near and far
        module.ros.tool(PYTHON, DYNPARAM, "set", "/lamp", "level", "2.5")
        assert "'level': 2.5" in module.ros.tool(PYTHON, DYNPARAM, "get", "/lamp")
        module.ros.tool(PYTHON, DYNPARAM, "set", "/lamp", "{'level': 3, 'colour': 'white'}")
    said = pc.ros.tool("rosservice", "call", "/lamp/set_parameters", "config: {doubles: [{name: level, value: 4}]}")
    assert "value: 4.0" in said


@pytest.mark.netns
@pytest.mark.skipif(bool(lacks("dynamic_reconfigure")), reason=lacks("dynamic_reconfigure") or "it is there")
def test_rmpa_sees_and_sets_it_from_another_module(pair: list[Module]) -> None:
    robot, pc = pair
    far = f"{robot.name}:/lamp"
    (listed,) = json.loads(rmpa_of(pc, "resource", "list", "--json"))
    assert (listed["name"], listed["peer"], listed["profile"]) == ("/lamp", robot.name, "slow")
    info = rmpa_of(pc, "resource", "info", far)
    assert f"Node: /lamp of peer {robot.name}" in info
    assert "Health: OK: profile slow" in info
    assert rmpa_of(pc, "profile", "set", far, "fast") == ""
    assert rmpa_of(robot, "profile", "get").strip() == rmpa_of(pc, "profile", "get", "/lamp").strip() == "fast"
    code, out = pc.agent.rmpa("profile", "set", far, "broken")
    assert code == 1
    assert "profile broken: it could not be applied: OSError: no such bulb; what was chosen before stays" in out
    code, out = pc.agent.rmpa("context", "set", far, "hoem")
    assert code == 2
    rmpa_of(pc, "profile", "set", far, "--auto")

    # A rule over a topic of another module and a parameter.
    rmpa_of(pc, "context", "set", far, "away")
    assert rmpa_of(robot, "context", "get").strip() == "away"
    rmpa_of(pc, "context", "set", far, "--auto")
    pc.ros.start("rostopic", "pub", "-l", "/battery/charging", "std_msgs/Bool", "true")
    robot.ros.tool(PYTHON, DYNPARAM, "set", "/lamp", "level", "5")
    eventually(lambda: rmpa_of(robot, "context", "get").strip() == "docked", LONG, what="the rule to hold")
    assert "context docked" in rmpa_of(pc, "profile", "explain", far)
    assert rmpa_of(pc, "profile", "get", far).strip() == "fast"
    alarms = json.loads(rmpa_of(pc, "alarm", "list", "--all", "--json"))
    assert [(one["resource"], one["peer"]) for one in alarms] == [("/lamp", robot.name)]
    code, out = pc.agent.rmpa("resource", "info", f"{robot.name}:/lmap")
    assert code == 1
    assert f"did you mean {far}?" in out
