"""What each release said and kept is read by this one, and answered as then.

``VERSION.json`` of a release has the number of each format, samples of it, a conversation of two agents, and a state
directory. ``.venv/bin/python -m tests.golden.test_releases`` writes the file of the release that is being worked on,
after a change that is meant; those of earlier releases stay as they are.
"""

from __future__ import annotations

import base64
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import pytest

pytest.importorskip("cryptography")

import rmpa
from rmpa.bridge.messages import decode, encode
from rmpa.cli.program import protocols
from rmpa.config.module_name import NAME_FILE, PLACES_FILE, kept_name, other_state_dirs
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.gateway.sites.keys import AttachmentReader, parse_token
from rmpa.mesh.frames import Frame, Hello, Lane, Refusal, Refuse
from rmpa.observe.control_client import ControlReply, ControlRequest
from rmpa.observe.snapshot import Snapshot
from rmpa.resource.runtime import describe
from rmpa.resource.saved import SavedCoolDown, SavedRequirement, SavedState
from rmpa.ros.core import state as core_state
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.ros.master.registrations import NodeRecord
from rmpa.ros.types.descriptor import Descriptor
from rmpa.trust.certificates import DenyEntry, DenyList, KeyList, ca_public_key, read_certificate, read_document
from rmpa.trust.packets import Verdict
from rmpa.trust.store import AuthorityPlace, Issued, TrustStore
from rmpa.trust.tokens import Invitation, Token, decode_message
from rmpa.web.server.access import token_from
from tests.bridge import test_messages
from tests.discovery.test_beacon import BEACON
from tests.discovery.test_membership import Harness, Speaker, who
from tests.gateway.sites import test_keys
from tests.mesh import test_frames
from tests.mesh.worlds import ACCEPTOR, DIALLER, HIGH, LOW, Side, Time, deliver
from tests.observe.samples import SNAPSHOT
from tests.resource import test_saved
from tests.trust import test_packets, test_tokens
from tests.trust.io.member_files import KEYS, SecuredMesh

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

HERE: Final = Path(__file__).parent
COMING: Final = rmpa.__version__.partition(".dev")[0]
RELEASES: Final = {path.stem: json.loads(path.read_text()) for path in sorted(HERE.glob("*.json"))}
MODULE: Final = "base"
NODE: Final = NodeRecord(
    "http://robot:41001/",
    [
        (RegistrationKind.PUBLISHER, "/scan", "sensor_msgs/LaserScan"),
        (RegistrationKind.SUBSCRIBER, "/cmd_vel", "geometry_msgs/Twist"),
        (RegistrationKind.SERVICE, "/reset", "rosrpc://robot:41002"),
    ],
)
CORE: Final = core_state.StoredState(core_state.FORMAT, "4f0c", {"/driver": NODE}, {"gain": 2.5, "rooms": ["a", 1]})
KEPT: Final = SavedState(
    parameters={"gain": 2.5, "frame": "sonar_link"},
    chosen="fine",
    last="fine",
    context="docked",
    requirements=(SavedRequirement(client="/driver", values=(("noise", "<= 5 cm"),), mark="m1", expires_ns=7),),
    cool_downs={"fine": SavedCoolDown(until_ns=9, cool_down=20.0, why="no bus")},
)
INVITED: Final = Invitation(b"tokenid8", b"k" * 32, 1_790_000_000, "arm")
ISSUED: Final = Issued("arm", 1_789_000_000, 1_790_000_000, ("arm.local",), b"key")
AUTHORITY: Final = AuthorityPlace("base", "10.0.0.1", 40001)
DENIED: Final = DenyList(1, (DenyEntry("old", 5),))
WEB_TOKEN: Final = "golden-token-of-43-characters-for-this-test"


class Sample(NamedTuple):
    """What a format wrote, and what this release reads in it."""

    data: bytes
    value: object
    read: Callable[[bytes], object]
    format: str


def samples() -> Iterator[tuple[str, Sample]]:
    """One or several of each format that goes over a network or a socket."""
    for kind in BeaconKind:
        beacon = replace(BEACON, kind=kind, observed=(("192.168.7.3", 40003),))
        yield f"beacon {kind.name}", Sample(beacon.serialize(), beacon, lambda data: Beacon.parse(data, 5), "beacon")
    signed = test_packets._trust().sign(test_packets.BEACON + b"\0", test_packets.NOW)
    yield "beacon with its proof", Sample(signed, Verdict.ACCEPTED, verdict, "beacon proof")
    for lane in Lane:
        hello = replace(test_frames.HELLO, lane=lane)
        yield f"hello {lane.name}", Sample(hello.serialize(), hello, Hello.parse, "link")
    for code in Refusal:
        refuse = Refuse(code, "why, and what to do")
        yield f"refuse {code.name}", Sample(refuse.serialize(), refuse, Refuse.parse, "link")
    for number, (frame, _) in enumerate(test_frames.GOLDEN):
        yield f"frame {number} {frame.kind.name}", Sample(frame.serialize(), frame, frame_of, "link")
    for number, (message, _) in enumerate(test_messages.GOLDEN):
        yield f"control {number} {type(message).__name__}", Sample(encode(message), message, decode, "link")
    for asked, data in test_tokens.GOLDEN.items():
        yield f"join {type(asked).__name__}", Sample(data[4:], asked, decode_message, "join")
    token = test_tokens.TOKEN
    yield "token", Sample(token.serialize().encode(), token, lambda data: Token.parse(data.decode()), "join token")
    for each in (test_keys.ARM, test_keys.SCAN, test_keys.FOR_YARD, test_keys.GATEWAY):
        yield f"site {each.token()}", Sample(each.token().encode(), each, lambda d: parse_token(d.decode()), "sites")
    attachment = 7, 123456789, test_keys.SENT
    yield "attachment", Sample(attachment[2].writer()(7, 123456789), attachment, AttachmentReader().read, "sites")
    sonar = describe(test_saved.sonar(), "/sonar")
    yield "descriptor", Sample(sonar.serialize().encode(), sonar, Descriptor.parse, "resource")
    request = ControlRequest("ping", {"peer": "base", "count": 1})
    yield "question", Sample(request.serialize(), request, ControlRequest.parse, "")
    for reply in (ControlReply(ok=True, value={"times": [0.5]}), ControlReply(ok=False, error="no", remedy="do")):
        yield f"answer {reply.ok}", Sample(reply.serialize(), reply, ControlReply.parse, "")
    yield "snapshot", Sample(msgspec.json.encode(SNAPSHOT), SNAPSHOT, snapshot_of, "")


def snapshot_of(data: bytes) -> Snapshot:
    return msgspec.json.decode(data, type=Snapshot)


def verdict(data: bytes) -> Verdict:
    assert Beacon.parse(data, 5).identity.name == "base"
    return test_packets._verify(test_packets._trust(), data).verdict


def frame_of(data: bytes) -> Frame:
    parsed = Frame.parse(data)
    assert parsed is not None
    return parsed[0]


def conversation(said: dict[str, str]) -> dict[str, str]:
    """What this release says to a peer that says ``said``; what is missing there, this release says too.

    A module announces itself, dials, pings and leaves; the other one answers each of them.
    """
    told: dict[str, str] = {}

    def heard(words: str, ours: bytes) -> bytes:
        told[words] = ours.hex()
        return bytes.fromhex(said.get(words, told[words]))

    time, other = Time(), Harness()
    other.run(1.0)
    other.hear(Beacon.parse(heard("announce", Speaker(who(2))(BeaconKind.ANNOUNCE).serialize()), 0))
    answers = [out.beacon for out in other.membership.outputs() if out.beacon.kind is BeaconKind.ANSWER]
    assert Beacon.parse(heard("answer", answers[0].serialize()), 0).identity == who(1)
    dialler, acceptor = Side(DIALLER, LOW, time, expected=HIGH.guid), Side(ACCEPTOR, HIGH, time)
    deliver(heard("hello", dialler.take_output()), acceptor, time.now)
    deliver(heard("welcome", acceptor.take_output()), dialler, time.now)
    deliver(heard("first frames", dialler.take_output()), acceptor, time.now)
    deliver(heard("first answers", acceptor.take_output()), dialler, time.now)
    assert (dialler.up, acceptor.up) == (True, True)
    deliver(heard("control", dialler.pack_control(b'{"op":"x"}')), acceptor, time.now)
    assert acceptor.last() == ("control", b'{"op":"x"}')
    dialler.close("shutting down", time.now)
    deliver(heard("bye", dialler.take_output()), acceptor, time.now)
    assert acceptor.last() == ("closed", "low left: shutting down")
    return told


# --- a state directory ----------------------------------------------------------------------------------------------


def write_state(place: Path) -> None:
    """A state directory as this release writes it."""
    mesh = SecuredMesh(place, deny=DENIED)
    store = mesh.save(MODULE)
    store.save_tokens([INVITED])
    store.save_issued([ISSUED])
    store.save_authority(AUTHORITY)
    kept = {
        NAME_FILE: f"{MODULE}\n".encode(),
        PLACES_FILE: b"/srv/rmpa\n",
        f"{MODULE}/web-token": f"{WEB_TOKEN}\n".encode(),
        f"{MODULE}/core-11311.state": core_state.serialize(CORE),
        f"{MODULE}/sonar.json": msgspec.json.encode(KEPT),
    }
    put(place, kept)


def put(place: Path, files: Mapping[str, bytes]) -> None:
    for name, data in files.items():
        path = place / name
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.touch(mode=0o600)
        path.write_bytes(data)


def files_in(place: Path) -> dict[str, str]:
    files = sorted(path for path in place.rglob("*") if path.is_file())
    return {str(path.relative_to(place)): base64.b64encode(path.read_bytes()).decode() for path in files}


def check_state(place: Path) -> None:
    """This release finds all that is kept in a state directory."""
    assert kept_name(place) == MODULE
    assert Path("/srv/rmpa") in other_state_dirs({"XDG_STATE_HOME": str(place.parent)}, place)
    assert token_from(place / MODULE / "web-token") == (WEB_TOKEN, False)
    assert core_state.parse((place / MODULE / "core-11311.state").read_bytes()) == CORE
    assert msgspec.json.decode((place / MODULE / "sonar.json").read_bytes(), type=SavedState) == KEPT
    store = TrustStore(place, MODULE)
    files = store.load()
    authority = ca_public_key(files.ca)
    assert read_certificate(files.certificate, files.ca).name == MODULE
    assert read_document(files.keys, authority, KeyList) == KEYS
    assert read_document(files.deny, authority, DenyList) == DENIED
    assert store.load_tokens() == [INVITED]
    assert store.load_issued() == {"arm": ISSUED}
    assert store.load_authority() == AUTHORITY


# --- the tests ------------------------------------------------------------------------------------------------------


def numbers() -> dict[str, int | str]:
    return {name: number for name, (number, _) in protocols().items()}


@pytest.mark.parametrize("release", RELEASES)
def test_what_a_release_said_is_read(release: str) -> None:
    spoken, now, today = RELEASES[release]["protocols"], numbers(), dict(samples())
    for name, data in RELEASES[release]["samples"].items():
        known, wire = today[name], bytes.fromhex(data)
        if spoken.get(known.format) == now.get(known.format):  # another number is refused: tests of each format
            assert known.read(wire) == known.value, name


@pytest.mark.parametrize("release", RELEASES)
def test_a_peer_of_a_release_is_answered_as_then(release: str) -> None:
    then = RELEASES[release]
    if all(then["protocols"][name] == numbers()[name] for name in ("beacon", "link")):
        assert conversation(then["conversation"]) == then["conversation"]


@pytest.mark.parametrize("release", RELEASES)
def test_what_a_release_kept_is_found(release: str, tmp_path: Path) -> None:
    place = tmp_path / "rmpa"
    put(place, {name: base64.b64decode(data) for name, data in RELEASES[release]["state"].items()})
    check_state(place)


def test_the_file_of_the_coming_release_is_up_to_date() -> None:
    if COMING not in RELEASES:
        pytest.skip(f"{COMING} has no file yet; a release needs one")
    ours = json.loads(msgspec.json.encode(recorded(RELEASES[COMING])))
    assert ours == RELEASES[COMING], "after a change that is meant: .venv/bin/python -m tests.golden.test_releases"


def recorded(before: dict[str, Any] | None) -> dict[str, Any]:
    """The content of the file; keys and signatures are random, and so the state directory of before stays."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "rmpa"
        write_state(place)
        check_state(place)
        state = files_in(place)
    if before is not None:
        assert before["state"].keys() == state.keys()
        random = {name for name in state if "/trust/" in name}
        state |= {name: data for name, data in before["state"].items() if name in random}
    wire = {name: sample.data.hex() for name, sample in samples()}
    return {"protocols": numbers(), "samples": wire, "conversation": conversation({}), "state": state}


if __name__ == "__main__":
    text = json.dumps(recorded(RELEASES.get(COMING)), indent=1, ensure_ascii=False)
    (HERE / f"{COMING}.json").write_text(f"{text}\n", encoding="utf-8")
    print(f"tests/golden/{COMING}.json")
