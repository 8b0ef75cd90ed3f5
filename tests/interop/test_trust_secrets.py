"""Newcomers to a secured mesh, and its secrets."""

from __future__ import annotations

import base64
import json
import re
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from lab.bed.agents import RMPA, Agent
from lab.bed.chromium import Chromium
from lab.bed.processes import Process, eventually
from rmpa.trust import store as files_of
from rmpa.trust.tokens import Token
from tests.interop.secured import SecuredMesh, attack, control, place
from tests.interop.web import needs_browser

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.namespaces import Lab
    from rmpa.observe.snapshot import PeerInfo
    from rmpa.trust.store import TrustStore
    from tests.interop.conftest import AgentFactory

pytestmark = [pytest.mark.netns, pytest.mark.timeout(180)]
pytest.importorskip("cryptography")


# The files that have each secret, of the module that it belongs to.
MAY_HOLD: Final = {
    "private key": {files_of.KEY},
    "CA key": {files_of.CA_KEY},
    "group key": {files_of.KEYS},
    "key of a token": {files_of.TOKENS},
    "web token": {"web-token"},
}
COMMANDS: Final = (
    ("peer", "list", "--json"),
    ("peer", "list"),
    ("why", "--module", "b"),
    ("doctor", "--json"),
    ("trust", "status", "--json"),
    ("trust", "status"),
    ("trust", "check", "b", "publish", "/cmd_vel", "--json"),
    ("trust", "renew", "--json"),
    ("config", "show"),
)


def forms(secret: bytes) -> Iterator[bytes]:
    """How bytes may stand in a file: raw, hexadecimal, a ``repr``, base64 at each of its three alignments."""
    yield secret
    yield secret.hex().encode()
    yield secret.hex().upper().encode()
    yield repr(secret)[2:-1].encode()
    for lead in range(3):
        for encode in (base64.b64encode, base64.urlsafe_b64encode):
            whole = encode(bytes(lead) + secret)
            # The first and last characters depend on what stands around the secret.
            yield whole[4 if lead else 0 : len(whole) - 4]
    yield base64.b32encode(secret)[:-8].lower()


def found_in(data: bytes, secrets: dict[str, list[bytes]]) -> set[str]:
    """Which secrets some bytes have."""
    return {
        kind for kind, values in secrets.items() for value in values if any(form in data for form in forms(value))
    }


def scalar(pem: bytes) -> bytes:
    """The number that a private key is."""
    key = serialization.load_pem_private_key(pem, None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    return key.private_numbers().private_value.to_bytes(32, "big")


def pem_lines(pem: bytes) -> list[bytes]:
    """The lines of a PEM that are the key's own: the first is the same in every key of the curve."""
    return [line for line in pem.splitlines() if not line.startswith(b"-----")][1:]


def test_the_search_finds_a_secret_in_each_form() -> None:
    secret = bytes(range(100, 132))
    for form in (secret, secret.hex().encode(), repr(secret).encode(), base64.b64encode(secret)):
        assert found_in(b"x" + form + b"y", {"key": [secret]}) == {"key"}
    for lead in range(4):
        assert found_in(base64.b64encode(bytes(lead) + secret + b"more"), {"key": [secret]}) == {"key"}
    assert found_in(base64.b64encode(bytes(64)) + secret[:20], {"key": [secret]}) == set()


def run(agent: Agent, *words: str) -> bytes:
    """The output of a command, whatever came of it."""
    return agent.rmpa(*words)[1].encode()


def test_no_key_and_no_token_leaves_its_file(tmp_path: Path, lab: Lab, agent: AgentFactory) -> None:
    mesh = SecuredMesh(tmp_path, "a")
    mesh.add("b")
    hosts = lab.hosts("a", "b", "eve")
    a, b = (agent(host, name=host.name, log_level="debug") for host in hosts[:2])
    a.wait_peer("b")
    words_of_web: list[str | Path] = [RMPA, "web", "--listen", "0.0.0.0", "--agent", "a", "--control", "--json"]
    with Process(a.host.command(words_of_web), env=a.env, name="rmpa web") as served:
        told = json.loads(served.wait_for(r"(\{.*\})", 90.0)[1])
    assert told["url"].startswith("https://"), told
    web_token = Path(told["token_file"]).read_bytes().strip()
    outputs = {" ".join(words): run(each, *words) for each in (a, b) for words in COMMANDS}

    # Joins that succeed and fail, with what is printed and answered.
    invited = control(a, "invite")
    token = Token.parse(invited["token"])
    joined: list[str | Path] = [RMPA, "trust", "join", "-", "--name", "c", "--json"]
    c_state = tmp_path / "state" / "eve"
    env = {**a.env, "RMPA_STATE_DIR": str(c_state), "RMPA_RUNTIME_DIR": str(tmp_path / "none")}
    for number in range(2):  # the second time it is used
        with Process(hosts[2].command(joined), env=env, commands=True) as process:
            process.tell(invited["token"])
            process.wait(60.0)
            outputs[f"join {number}"] = process.output.encode()
    attack(hosts[2], "join", token=invited["token"], name="d", invented=True)
    attack(hosts[2], "insider", **place(a), here=hosts[2].address, name="b")
    outputs["revoke"] = json.dumps(control(a, "revoke", name="c", force=True)).encode()

    secrets = _secrets([mesh.store("a"), mesh.store("b")], token)
    secrets["web token"] = [web_token]
    # Errors about files that cannot be used: their content must not be in the text.
    outputs |= _broken(b)
    for name, data in outputs.items():
        assert found_in(data, secrets) == set(), f"rmpa {name} tells a secret:\n{data.decode()}"
    _check_files(tmp_path, secrets)
    for each in (a, b):
        for path in sorted((each.runtime_dir or tmp_path).iterdir()):
            assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0, path
    assert a.process.returncode is None
    assert found_in("\n".join(a.process.lines).encode(), secrets) == set()


def _secrets(stores: list[TrustStore], token: Token) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {"private key": [], "group key": [], "CA key": []}
    for store in stores:
        pem = store.path(files_of.KEY).read_bytes()
        found["private key"] += [scalar(pem), *pem_lines(pem)]
        signed = json.loads(json.loads(store.path(files_of.KEYS).read_bytes())["signed"])
        found["group key"] += [base64.b64decode(each["key"]) for each in signed["keys"]]
    pem = stores[0].load_ca_key()
    found["CA key"] += [scalar(pem), *pem_lines(pem)]
    found["key of a token"] = [token.key]
    found["token"] = [token.secret, token.serialize()[10:60].encode()]
    return found


def _broken(agent: Agent) -> dict[str, bytes]:
    """What commands say of a module whose key, documents and modes are wrong, one after the other."""
    folder = Path(agent.env["RMPA_STATE_DIR"]) / agent.name / files_of.FOLDER
    agent.terminate()
    told = {}
    for name in (files_of.KEY, files_of.KEYS, files_of.CERTIFICATE):
        path = folder / name
        whole = path.read_bytes()
        for how, data in (("cut", whole[: len(whole) // 2]), ("mixed", whole[50:] + whole[:50])):
            path.write_bytes(data)
            with Process(agent.argv, env=agent.env) as process:
                assert process.wait(60.0) != 0, f"an agent with {name} {how} starts"
                told[f"up with {name} {how}"] = process.output.encode()
                assert name in process.output
            told[f"status with {name} {how}"] = run(agent, "trust", "status", "--json")
        path.write_bytes(whole)
    path = folder / files_of.KEY
    path.chmod(0o644)
    with Process(agent.argv, env=agent.env) as process:
        assert process.wait(60.0) != 0
        told["up with a key that others can read"] = process.output.encode()
        assert "can be read by others" in process.output
    path.chmod(0o600)
    return told


def _check_files(home: Path, secrets: dict[str, list[bytes]]) -> None:
    """Fail if a file has a secret that is not its own, or if others may read a file of trust."""
    seen = set()
    for path in sorted(home.rglob("*")):
        if not path.is_file() or path.is_symlink():
            continue
        mode = stat.S_IMODE(path.stat().st_mode)
        allowed = {kind for kind, names in MAY_HOLD.items() if path.name in names}
        found = found_in(path.read_bytes(), secrets)
        assert found <= allowed, f"{path} has a {found - allowed}"
        if found or path.parent.name == files_of.FOLDER:
            assert mode & 0o077 == 0, f"{path} has mode {mode:o}"
        if path.parent.name == files_of.FOLDER:
            assert path.parent.stat().st_mode & 0o077 == 0, path.parent
        seen |= found
    assert seen >= {"private key", "group key", "CA key"}, "the search finds what is there"


pytest.importorskip("cryptography")


INVITE = "rmpa trust invite --module arm"


class Gate:
    """A secured mesh of ``base``, its authority, and ``pc``; ``arm`` has no keys, and knocks."""

    def __init__(self, home: Path, lab: Lab, agent: AgentFactory) -> None:
        SecuredMesh(home, "base").add("pc")
        hosts = lab.hosts("base", "pc", "arm")
        self.base, self.pc, self.arm = (agent(host, name=host.name, log_level="info") for host in hosts)
        self.base.wait_peer("pc")

    def join(self, line: str) -> None:
        """Run the line of an invitation at ``arm``, and start its agent again, as the line's output says."""
        code, out = self.arm.rmpa(*line.split()[1:])
        assert code == 0, out
        self.arm.kill()  # without a goodbye, so that the others have heard of it before as of a module without keys
        self.arm.restart()
        for member in (self.base, self.pc):
            member.wait_peer("arm")

    def stranger(self, member: Agent, name: str) -> PeerInfo:
        """What a module shows of one that is not of its mesh, as soon as it does."""
        found: list[PeerInfo] = eventually(
            lambda: [one for one in member.snapshot().strangers if one.name == name],
            what=f"{member.name} shows {name}",
        )
        return found[0]


@pytest.fixture
def gate(tmp_path: Path, lab: Lab, agent: AgentFactory) -> Gate:
    return Gate(tmp_path, lab, agent)


def told(agent: Agent, name: str) -> tuple[str, str]:
    """The state of a module in `rmpa peer list`, and the line below the table."""
    _, out = agent.rmpa("peer", "list")
    row = re.search(rf"^{name} +(\w+)", out, re.MULTILINE)
    line = re.search(rf"^! (?:\w+, )*{name}(?:, \w+)*: (.+)", out, re.MULTILINE)
    return row[1] if row else "", line[1] if line else ""


def test_a_newcomer_is_pending_at_both_ends_until_the_line_lets_it_in(gate: Gate) -> None:
    for there, name, rest in (
        (gate.base, "arm", f"if it is yours, run here: {INVITE} (it prints the line to run on arm)"),
        (gate.pc, "arm", f"if it is yours, run on base: {INVITE} (it prints the line to run on arm)"),
        (gate.arm, "base", f"to join it, run on its authority: {INVITE} (it prints the line to run here)"),
    ):
        gate.stranger(there, name)
        eventually(lambda there=there, name=name: told(there, name)[0] == "pending", what=f"pending at {there.name}")  # type: ignore[misc]
        assert rest in told(there, name)[1]
        assert f"{name} is pending" in there.rmpa("why", "--module", name)[1]
        code, info = there.rmpa("peer", "info", name)
        assert (code, re.findall(r"Invitation: +(.+)", info)) == (0, [INVITE])
    code, printed = gate.base.rmpa(*INVITE.split()[1:], "--no-wait")
    assert code == 0
    gate.join(f"rmpa trust join {printed.split()[-1]}")
    assert not any(each.snapshot().strangers for each in (gate.base, gate.pc, gate.arm))


def test_one_that_was_revoked_says_so_and_is_not_pending(gate: Gate) -> None:
    gate.join(f"rmpa trust join {control(gate.base, 'invite', name='arm')['token']}")
    control(gate.base, "revoke", name="arm")
    shown = [*(gate.stranger(each, "arm") for each in (gate.base, gate.pc))]  # also once the roster has forgotten it
    assert {(one.state, one.invite) for one in shown} == {("revoked", "")}
    assert told(gate.arm, "base")[0] == "revoked"


@needs_browser
async def test_the_page_of_the_authority_invites_and_shows_the_new_module_by_itself(gate: Gate) -> None:
    gate.stranger(gate.base, "arm")
    env = {**gate.base.env, "RMPA_LOG_LEVEL": "debug"}
    with Process(gate.base.host.command([RMPA, "web", "--control"]), env=env, name="rmpa web") as served:
        url = served.wait_for(r"(https://127.0.0.1:\d+/\?token=\S+)")[1]
        async with Chromium(gate.base.host) as page:
            await page.send("Security.setIgnoreCertificateErrors", ignore=True)  # it does not know the mesh's CA
            await page.goto(url)
            await page.wait_text(INVITE)
            await page.run("window.same = true")
            await page.click("Invite arm")
            await page.wait("document.querySelector('.token')")
            line = str(await page.run("document.querySelector('.token').textContent"))
            secret = line.rsplit(maxsplit=1)[-1]
            assert secret not in await page.run("JSON.stringify(window.rmpa.state) + location.href")
            _, status = gate.base.rmpa("trust", "status", "--json")
            assert secret not in status + served.output + gate.base.process.output
            gate.join(line)
            await page.wait("document.querySelector('[data-module=arm].up') && !document.querySelector('.outside')")
            assert await page.run("window.same")
        assert secret not in served.output + gate.base.process.output
