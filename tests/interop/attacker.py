"""An attacker in a network namespace of its own: sends to a secured mesh what docs/design/trust.md forbids.

attacker.py MODE ARGUMENTS, where ARGUMENTS is a JSON object; the functions of ``MODES`` say what it has. Trailers,
tokens and messages of a join are written here byte by byte, from that page and not from the code under
test; hellos and beacons, which are the same in a plain mesh, are made by rmpa. Run it by rmpa's own interpreter.
Each answer is an event: ``@ {"event": ...}``; the last one is ``done``.
"""

import base64
import contextlib
import hashlib
import hmac
import json
import os
import random
import selectors
import socket
import ssl
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import Guid, Identity
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.mesh.frames import Frame, FrameKind, Hello, Refuse

RNG = random.Random(14)
TIMEOUT = 10.0
Arguments = dict[str, Any]


def say(event: str, **fields: object) -> None:
    """Tell the test."""
    print("@ " + json.dumps({"event": event, **fields}), flush=True)


# --- the bytes --------------------------------------------------------------------------------------------------


def with_trailer(packet: bytes, key: bytes, number: int, *, key_number: int = 1, wall: float | None = None) -> bytes:
    """A packet with the 32 bytes that show a group key."""
    wall = time.time() if wall is None else wall
    body = packet + struct.pack(">BBHQI", 1, 1, key_number & 0xFFFF, number, int(wall) & 0xFFFFFFFF)
    kind = hmac.digest(key, b"rmpa beacon 1", hashlib.sha256)
    return body + hmac.digest(kind, body, hashlib.sha256)[:16]


class StolenToken:
    """A token, taken apart."""

    def __init__(self, text: str) -> None:
        body = text.removeprefix("rmpa1-").upper()
        self.raw = base64.b32decode(body + "=" * (-len(body) % 8))
        self.secret = self.raw[27:43]
        self.address = socket.inet_ntoa(self.raw[5:9])
        self.port = int.from_bytes(self.raw[9:11], "big")

    @property
    def id(self) -> bytes:
        """What a question names it by."""
        return hashlib.sha256(b"rmpa token id 1" + self.secret).digest()[:8]

    @property
    def key(self) -> bytes:
        """What proves a question."""
        return hmac.digest(self.secret, b"rmpa token key 1", hashlib.sha256)

    def changed(self, **parts: bytes) -> str:
        """Its text with other parts and a right checksum."""
        places = {"expires": (1, 5), "address": (5, 9), "port": (9, 11), "fingerprint": (11, 27), "secret": (27, 43)}
        raw = bytearray(self.raw[:43])
        for name, value in parts.items():
            raw[slice(*places[name])] = value
        raw += hashlib.sha256(raw).digest()[:10]
        return "rmpa1-" + base64.b32encode(raw).decode().rstrip("=").lower()


def new_key() -> tuple[ec.EllipticCurvePrivateKey, bytes]:
    """A private key, and its PEM."""
    key = ec.generate_private_key(ec.SECP256R1())
    plain = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    return key, key.private_bytes(*plain)


def request_of(key: ec.EllipticCurvePrivateKey, name: str) -> bytes:
    """A request for a certificate (DER)."""
    alternative = x509.SubjectAlternativeName([x509.UniformResourceIdentifier(f"urn:rmpa:{name}")])
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    made = x509.CertificateSigningRequestBuilder().subject_name(subject).add_extension(alternative, critical=False)
    return made.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.DER)


# --- connections ------------------------------------------------------------------------------------------------


def connect(address: str, port: int) -> socket.socket:
    """A TCP connection."""
    sock = socket.create_connection((address, port), TIMEOUT)
    sock.settimeout(TIMEOUT)
    return sock


def told(sock: socket.socket | ssl.SSLSocket) -> dict[str, object]:
    """What the other side answers: the code and text of a refusal, an alert of TLS, a frame, or the end."""
    data = b""
    try:
        while (parsed := Frame.parse(data)) is None:
            more = sock.recv(1 << 16)
            if not more:
                return {"answer": "closed", "bytes": len(data)}
            data += more
    except TimeoutError:
        return {"answer": "silence"}
    except ssl.SSLError as error:
        return {"answer": "alert", "alert": error.reason or str(error)}
    except OSError as error:
        return {"answer": "closed", "error": str(error)}
    frame = parsed[0]
    if frame.kind is FrameKind.REFUSE:
        refuse = Refuse.parse(frame.payload)
        return {"answer": "refused", "code": refuse.code, "label": refuse.label, "text": refuse.text}
    return {"answer": frame.kind.name.lower()}


def hello(here: str, there: str, name: str, instance: bytes = b"", port: int = 40999) -> bytes:
    """The first frame of a link: ``there`` is the GUID's text of the other side, empty if it is not known."""
    identity = Identity(Guid.of(here, port, RNG.randrange(1, 60000)), instance or os.urandom(16), name, 0)
    expected = Guid.parse(there) if there else None
    payload = Hello.of(identity, lease=60.0, expected=expected).serialize()
    return Frame(FrameKind.HELLO, payload, 0, 0, 0).serialize()


def tls_context(
    cert: str = "", key: str = "", *, alpn: str = "rmpa/1", server: bool = False, newest: bool = True
) -> ssl.SSLContext:
    """A context that checks nothing of the other side: an attacker does not care."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    if newest:
        context.minimum_version = ssl.TLSVersion.TLSv1_3
    else:
        context.maximum_version = ssl.TLSVersion.TLSv1_2
    if alpn:
        context.set_alpn_protocols([alpn])
    if cert:
        context.load_cert_chain(cert, key)
    return context


def secured(sock: socket.socket, context: ssl.SSLContext, then: bytes) -> dict[str, object]:
    """Do the handshake of TLS, send something, and return what is answered."""
    try:
        wrapped = context.wrap_socket(sock)
    except ssl.SSLError as error:
        return {"answer": "alert", "alert": error.reason or str(error)}
    except OSError as error:
        return {"answer": "closed", "error": str(error)}
    with wrapped:
        try:
            if then:
                wrapped.sendall(then)
        except ssl.SSLError as error:
            return {"answer": "alert", "alert": error.reason or str(error)}
        except OSError as error:
            return {"answer": "closed", "error": str(error)}
        return told(wrapped)


def udp_socket() -> socket.socket:
    """A socket whose multicasts leave by the host's cable: it has no default route."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    own, *_ = [each.address for each in psutil.net_if_addrs()["eth0"] if each.family is socket.AF_INET]
    made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(own))
    return made


# --- on the wire ------------------------------------------------------------------------------------------------


def record(given: Arguments) -> None:
    """Listen on a wire: ``interface``, ``file``, ``beacons``, ``hellos`` of TLS: how many of each are wanted."""
    found: dict[str, list[dict[str, Any]]] = {"beacons": [], "hellos": []}
    tap = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x0003))
    tap.bind((given["interface"], 0))
    say("ready")
    while any(len(found[kind]) < given[kind] for kind in found):
        packet = tap.recv(65536)
        if packet[12:14] != b"\x08\x00" or len(packet) < 34:
            continue
        ip = packet[14:]
        begin = (ip[0] & 15) * 4
        length = int.from_bytes(ip[2:4], "big")
        place = {"from": socket.inet_ntoa(ip[12:16]), "to": socket.inet_ntoa(ip[16:20])}
        port = int.from_bytes(ip[begin + 2 : begin + 4], "big")
        if ip[9] == 17:
            data = ip[begin + 8 : length]
            if data.startswith(b"RMPA"):
                found["beacons"].append({**place, "port": port, "data": data.hex()})
        elif ip[9] == 6:
            data = ip[begin + (ip[begin + 12] >> 4) * 4 : length]
            if data.startswith(b"\x16\x03\x01"):  # only a ClientHello has this version
                found["hellos"].append({**place, "port": port, "data": data.hex()})
    Path(given["file"]).write_text(json.dumps(found))
    say("done", **{kind: len(each) for kind, each in found.items()})


def replay(given: Arguments) -> None:
    """Send what was recorded again: ``file``, ``times``."""
    found = json.loads(Path(given["file"]).read_text())
    udp = udp_socket()
    sent = 0
    for _ in range(given["times"]):
        for each in found["beacons"]:
            udp.sendto(bytes.fromhex(each["data"]), (each["to"], each["port"]))
            sent += 1
    answers = []
    for each in found["hellos"]:
        with connect(each["to"], each["port"]) as sock:
            sock.sendall(bytes.fromhex(each["data"]))
            data = b""
            with contextlib.suppress(OSError):
                while more := sock.recv(65536):
                    data += more
            answers.append(data[:1].hex())
    say("done", beacons=sent, answers=answers)


# --- from outside -----------------------------------------------------------------------------------------------


def plain(given: Arguments) -> None:
    """Be an agent without trust: ``here``, ``address``, ``port``, ``guid``."""
    with connect(given["address"], given["port"]) as sock:
        sock.sendall(hello(given["here"], given["guid"], "eve"))
        say("done", **told(sock))


def lure(given: Arguments) -> None:
    """Be an agent without trust that is dialled: ``listen`` (a port), ``seconds``; tells how each dial begins.

    It answers TLS as such an agent does, by a refusal ``unsecured``, and hopes for a plain hello.
    """
    server = socket.create_server(("0.0.0.0", given["listen"]))
    say("ready")
    server.settimeout(0.2)
    end, first = time.monotonic() + given["seconds"], []
    refusal = Frame(FrameKind.REFUSE, Refuse(12, "there is no trust here").serialize(), 0, 0, 0).serialize()
    while time.monotonic() < end:
        with contextlib.suppress(OSError):
            sock, _ = server.accept()
            with sock:
                sock.settimeout(1.0)
                data = sock.recv(4096)
                if data:
                    first.append(data[:4].hex())
                    sock.sendall(refusal)
                    sock.recv(4096)
    say("done", first=first)


def flood(given: Arguments) -> None:
    """Forge as much as is wanted: ``kind`` (beacons, garbage, half), ``address``, ``port``, ``rate``, ``seconds``.

    ``beacons`` go to the group ``group``. ``half`` sends a whole ClientHello, and does not go on.
    """
    rate, end = given["rate"], time.monotonic() + given["seconds"]
    udp = udp_socket()
    false_key, held, sent = os.urandom(32), [], 0
    greeting = client_hello()
    began = time.monotonic()
    while (now := time.monotonic()) < end:
        if sent > (now - began) * rate:
            time.sleep(0.002)
            continue
        sent += 1
        if given["kind"] == "beacons":
            identity = Identity(Guid.of("10.77.9.9", RNG.randrange(1, 65536)), RNG.randbytes(16), "arm9", 0)
            packet = Beacon(BeaconKind.ANNOUNCE, identity, 60_000, sent).serialize()
            udp.sendto(with_trailer(packet, false_key, sent), (given["group"], given["udp"]))
            continue
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        held.append(sock)
        sock.setblocking(False)
        sock.connect_ex((given["address"], given["port"]))
        selectable(sock)
        with contextlib.suppress(OSError):
            sock.send(greeting if given["kind"] == "half" else b"GET / HTTP/1.1\r\n\r\n")
        while len(held) > 200:
            held.pop(0).close()
    say("done", sent=sent, rate=sent / (time.monotonic() - began))


def client_hello() -> bytes:
    """The first bytes of a TLS connection."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    with contextlib.suppress(ssl.SSLWantReadError):
        tls_context().wrap_bio(incoming, outgoing).do_handshake()
    return outgoing.read()


def selectable(sock: socket.socket) -> None:
    """Wait until a connection is there, or has failed."""
    with selectors.DefaultSelector() as selector:
        selector.register(sock, selectors.EVENT_WRITE)
        selector.select(0.5)


def slow(given: Arguments) -> None:
    """Be slow: ``address``, ``port``, ``count`` connections, one byte each 0.2 s; how long they live."""
    socks = [connect(given["address"], given["port"]) for _ in range(given["count"])]
    began, lived, data = time.monotonic(), [], client_hello()
    at = 0
    while socks and time.monotonic() - began < 20:
        for sock in list(socks):
            try:
                sock.setblocking(False)
                if sock.recv(4096) == b"":
                    raise ConnectionResetError
            except BlockingIOError:
                with contextlib.suppress(OSError):
                    sock.send(data[at : at + 1])
            except OSError:
                lived.append(round(time.monotonic() - began, 2))
                socks.remove(sock)
        at += 1
        time.sleep(0.2)
    say("done", lived=lived, open=len(socks))


# --- with a stolen group key, or as a member --------------------------------------------------------------------


def insider(given: Arguments) -> None:
    """Dial: ``address``, ``port``, ``guid``, ``here``, ``name``.

    Optional: ``cert`` and ``private`` (files), ``old`` (TLS 1.2), ``alpn``.
    """
    with connect(given["address"], given["port"]) as sock:
        context = tls_context(
            given.get("cert", ""),
            given.get("private", ""),
            alpn=given.get("alpn", "rmpa/1"),
            newest="old" not in given,
        )
        say("done", **secured(sock, context, hello(given["here"], given["guid"], given["name"])))


def tell_beacon(given: Arguments) -> None:
    """Send beacons with the group's key: ``key``, ``group``, ``udp``, ``here``, ``listen`` (our port), ``name``."""
    udp = udp_socket()
    identity = Identity(Guid.of(given["here"], given["listen"], 1), os.urandom(16), given["name"], 0)
    for number in range(1, 6):
        packet = Beacon(BeaconKind.ANNOUNCE, identity, 60_000, number).serialize()
        udp.sendto(with_trailer(packet, bytes.fromhex(given["key"]), number), (given["group"], given["udp"]))
        time.sleep(0.1)
    say("done")


def knock(given: Arguments) -> None:
    """Knock without keys: ``group``, ``udp``, ``here``, under these ``names``, and under ``invented`` ones more."""
    udp = udp_socket()
    names = [*given["names"], *(f"arm{number}" for number in range(given["invented"]))]
    for number, name in enumerate(names):
        identity = Identity(Guid.of(given["here"], 1024 + number, 1), os.urandom(16), name, 0)
        udp.sendto(Beacon(BeaconKind.ANNOUNCE, identity, 60_000, 1).serialize(), (given["group"], given["udp"]))
        time.sleep(0.02)
    say("done")


def former(given: Arguments) -> None:
    """Be a member that was revoked: ``key`` (the group key before), ``cert``, ``private``, ``addresses`` (its own).

    For ``seconds`` it invents modules at ``here``, says goodbye in the names of the modules that it hears, and dials
    ``address``, ``port`` from each of its addresses, with half a handshake and with its certificate too.
    """
    key, end = bytes.fromhex(given["key"]), time.monotonic() + given["seconds"]
    udp, ears = udp_socket(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ears.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    ears.bind((given["group"], given["udp"]))
    group = socket.inet_aton(given["group"]) + socket.inet_aton(given["here"])
    ears.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
    ears.setblocking(False)
    context, greeting = tls_context(given["cert"], given["private"]), client_hello()
    held: list[socket.socket] = []
    heard: dict[bytes, Beacon] = {}
    number = 0
    say("ready")
    while time.monotonic() < end:
        with contextlib.suppress(OSError, RemoteProtocolError):
            beacon = Beacon.parse(ears.recv(4096), 0)
            heard[beacon.identity.instance] = beacon
        number += 1
        guid = Guid.of(given["here"], 2000 + number % 60_000, 1)
        lies = [Beacon(BeaconKind.ANNOUNCE, Identity(guid, os.urandom(16), f"ghost{number}", 0), 60_000, 1)]
        for beacon in heard.values():
            sequence = (beacon.sequence + 500 + number) & 0xFFFFFFFF
            lies.append(Beacon(BeaconKind.GOODBYE, beacon.identity, 60_000, sequence))
        for lie in lies:
            packet = with_trailer(lie.serialize(), key, number)
            udp.sendto(packet, (given["group"], given["udp"]))
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        sock.settimeout(0.2)
        with contextlib.suppress(OSError):
            sock.bind((given["addresses"][number % len(given["addresses"])], 0))
            sock.connect((given["address"], given["port"]))
            if number % 4 == 0:  # and no hello behind the handshake
                sock = context.wrap_socket(sock)
            else:
                sock.sendall(greeting)
        held.append(sock)
        while len(held) > 300:
            held.pop(0).close()
        time.sleep(0.002)
    say("done", lies=number, heard=len(heard))


# --- joins ------------------------------------------------------------------------------------------------------


class Talk:
    """The messages of a join over one TLS connection."""

    def __init__(self, sock: ssl.SSLSocket) -> None:
        self.sock = sock
        self.sock.settimeout(60.0)

    def send(self, **message: object) -> None:
        """One message; bytes in it become base64."""
        plain_ = {k: base64.b64encode(v).decode() if isinstance(v, bytes) else v for k, v in message.items()}
        data = json.dumps(plain_).encode()
        self.sock.sendall(struct.pack(">I", len(data)) + data)

    def receive(self) -> dict[str, Any]:
        """The next message."""
        (size,) = struct.unpack(">I", self._exactly(4))
        found: dict[str, Any] = json.loads(self._exactly(size))
        return found

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            more = self.sock.recv(size - len(data))
            if not more:
                raise EOFError
            data += more
        return data


def join_as(token: StolenToken, name: str) -> dict[str, Any]:
    """Join with a key of our own; the answer."""
    with connect(token.address, token.port) as raw, tls_context(alpn="rmpa-join/1").wrap_socket(raw) as sock:
        server = sock.getpeercert(binary_form=True) or b""
        request = request_of(new_key()[0], name)
        signed = b"rmpa join 2" + hashlib.sha256(request).digest() + hashlib.sha256(server).digest()
        talk = Talk(sock)
        talk.send(op="join", token=token.id, request=request, proof=hmac.digest(token.key, signed, hashlib.sha256))
        return talk.receive()


def join(given: Arguments) -> None:
    """Join with ``token`` as ``name``; with ``invented`` the secret is replaced by a random one."""
    token = StolenToken(given["token"])
    if given.get("invented"):
        token = StolenToken(token.changed(secret=os.urandom(16)))
    try:
        answer = join_as(token, given["name"])
    except (EOFError, OSError) as error:
        answer = {"op": "closed", "error": str(error)}
    say("done", **{key: value for key, value in answer.items() if key not in ("certificate", "keys", "deny", "ca")})


MODES: dict[str, Callable[[Arguments], None]] = {
    each.__name__: each
    for each in (record, replay, plain, lure, flood, slow, insider, tell_beacon, knock, former, join)
}

if __name__ == "__main__":
    MODES[sys.argv[1]](json.loads(sys.argv[2]))
