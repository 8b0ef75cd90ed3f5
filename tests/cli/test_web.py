"""``rmpa web`` as a user runs it, with a real agent beside it."""

from __future__ import annotations

import http.client
import json
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.cli.conftest import DEADLINE, Machine, Place, free_port, until


def get(port: int, path: str, token: str = "") -> tuple[int, str]:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}")
    if token:
        request.add_header("Authorization", f"Bearer {token}")
    try:
        with urllib.request.urlopen(request, timeout=DEADLINE) as response:
            return response.status, response.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()
    except OSError:
        return 0, ""


@contextmanager
def running(place: Place, *arguments: str, end: signal.Signals = signal.SIGTERM) -> Iterator[subprocess.Popen[str]]:
    with place.start(*arguments) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(end)
            process.communicate(timeout=DEADLINE)


def agent_options(*more: str) -> tuple[str, ...]:
    return ("up", "--name", "base", "--core-port", str(free_port()), "--multicast", "off", *more)


def test_it_outlives_an_agent_that_is_killed_and_the_next_one_takes_it_over(
    machines: Callable[[str], Machine],
) -> None:
    machine, port = machines("base"), free_port()
    words = ("--web", "--core-port", str(free_port()))
    client = http.client.HTTPConnection("127.0.0.1", port, timeout=DEADLINE)

    def answer() -> int:
        client.request("GET", "/healthz", headers={"Connection": "keep-alive"})
        with client.getresponse() as response:
            response.read()
            return response.status

    def kill(agent: subprocess.Popen[str]) -> None:
        agent.kill()
        agent.wait(DEADLINE)
        (machine.path / "base.sock").unlink()

    agent = machine.up(*words, RMPA_WEB_PORT=str(port))
    until(lambda: get(port, "/healthz")[0] == 200)
    web = child_of(agent.pid)
    assert answer() == 200
    connection = client.sock
    kill(agent)
    until(lambda: answer() == 503)
    assert "rmpa up" in get(port, "/api/v1/agent")[1]
    assert "\nrmpa_up 0.0\n" in get(port, "/metrics")[1]
    agent = machine.up(*words, RMPA_WEB_PORT=str(port))
    until(lambda: answer() == 200)
    assert client.sock is connection, "its client is connected all the time"
    until(lambda: f"rmpa web (process {web}) goes on, of the agent before" in machine.log())
    kill(agent)
    other = free_port()
    agent = machine.up(*words, RMPA_WEB_PORT=str(other))
    until(lambda: get(other, "/healthz")[0] == 200)
    assert get(port, "/healthz")[0] == 0, "one that was set in another way is replaced"
    kill(agent)
    machine.up(*words[1:])
    until(lambda: get(other, "/healthz")[0] == 0)
    client.close()


def child_of(pid: int) -> int:
    """The child of an agent; a thread of the agent started it."""
    children = " ".join(task.read_text() for task in Path(f"/proc/{pid}/task").glob("*/children"))
    return int(children.split()[0])


def test_beyond_this_machine_a_token_is_made_and_told_once(place: Place) -> None:
    port = free_port()
    arguments = ("web", "--port", str(port), "--listen", "0.0.0.0", "--agent", "base", "--json")
    file = place.path / ".local" / "state" / "rmpa" / "base" / "web-token"
    told = []
    for _ in range(2):
        with running(place, *arguments) as web:
            assert web.stdout is not None
            told.append(json.loads(web.stdout.readline()))
            token = file.read_text().strip()
            assert file.stat().st_mode & 0o777 == 0o600
            assert get(port, "/metrics")[0] == 401
            assert get(port, "/metrics", token)[0] == 200
            assert get(port, f"/metrics?token={token}")[0] == 200
    token = file.read_text().strip()
    assert told[0]["url"].endswith(f":{port}/?token={token}")
    assert token not in told[1]["url"]
    assert told[0]["token_file"] == told[1]["token_file"] == str(file)


def test_rmpa_reload_takes_other_rights_and_a_mistake_changes_nothing(place: Place) -> None:
    port, config = free_port(), place.path / "rmpa.toml"
    web = f"[web]\nenabled = true\nport = {port}\n"
    config.write_text(web)
    with running(place, *agent_options("--config", str(config))) as agent:
        until(lambda: get(port, "/metrics")[0] == 200)
        pid = child_of(agent.pid)
        config.write_text(f"{web}control = true\n")
        assert place.run("reload")[0] == 0
        until(lambda: get(port, "/metrics")[0] == 401)
        token = (place.path / ".local" / "state" / "rmpa" / "base" / "web-token").read_text().strip()
        assert get(port, "/metrics", token)[0] == 200
        config.write_text(f'{web}token = "wall"\n')
        code, _, err = place.run("reload")
        assert code != 0
        assert "web.token: an unknown key" in err
        assert get(port, "/metrics", token)[0] == 200
        assert child_of(agent.pid) == pid


def test_without_the_extra_it_says_what_to_install(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    problem = f"aiohttp not installed; run {sys.executable} -m pip install 'rmpa[web]' [extra-missing]"
    assert place.run("web") == (2, "", f"rmpa: rmpa web: {problem}\n")


def test_mistakes_are_told_with_their_option(place: Place) -> None:
    code, _, err = place.run("web", "--listen", "::1")
    assert (code, err.startswith("rmpa: --listen: ")) == (2, True)
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        sock.listen()
        code, out, err = place.run_apart("web", "--port", str(sock.getsockname()[1]), "--json")
    assert (code, "choose another --port" in err, "choose another --port" in json.loads(out)["error"]) == (
        1,
        True,
        True,
    )
