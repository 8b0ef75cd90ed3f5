"""``rmpa bug-report``: what a maintainer needs to know of this machine, in one archive, redacted.

``Redactor`` takes out of texts what no other person is to see: keys, tokens, passwords, users and their homes. Hosts,
modules and addresses can be replaced too, each by the same word wherever it stands.
"""

from __future__ import annotations

import io
import json
import os
import platform
import pwd
import re
import shutil
import socket
import sys
import tarfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from ipaddress import ip_address
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen, TimeoutExpired
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import click
import msgspec

from rmpa.cli.options import Options, config_option, flag, json_verb, option
from rmpa.cli.output import GONE, USER_INFO, Table, print_text, size
from rmpa.cli.units import UNITS
from rmpa.config.module_name import of_unit, state_dir
from rmpa.config.read import VARIABLES, find_config_file
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.core.limits import KIB
from rmpa.discovery.network import list_interfaces
from rmpa.observe.control_client import ControlClient, find_agents
from rmpa.runtime.interpreter import own_command

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping


# By its file: the command of rmpa that fills it. Those of an agent are asked of each.
_COMMANDS: Final = {
    "version.json": "--version --json",
    "doctor.json": "doctor --json",
    "settings.json": "config show --json",
    "service.txt": "service status",
    "trust.json": "trust status --json",
}
_OF_AGENTS: Final = {
    "peers.txt": "peer list",
    "topics.txt": "topic list --verbose",
    "services.txt": "service list",
    "nodes.txt": "node list",
    "sites.txt": "site list",
}
# Commands that run at a time: together they would take the processor from each other, and from the agent.
_AT_A_TIME: Final = 4
# Seconds for one command: they are processes of Python, which take a minute each at a load of 30 for each core.
DEADLINE: Final = 120.0
# Seconds for the snapshot of an agent; one that does not answer is not asked for its lists either.
_SNAPSHOT: Final = 10.0
_LOG: Final = "journalctl --no-pager --quiet --output=short-iso-precise --lines=1000"
_LOG_BYTES: Final = 512 * KIB
# Variables whose values are shown; of others that begin so only the names.
_SHOWN: Final = re.compile(
    r"ROS_(?:MASTER_URI|IP|HOSTNAME|DOMAIN_ID|STATIC_PEERS|AUTOMATIC_DISCOVERY_RANGE|LOCALHOST_ONLY|PACKAGE_PATH|DISTRO"
    r"|VERSION|PYTHON_VERSION|ROOT|ETC_DIR|HOME|LOG_DIR)|RMW_IMPLEMENTATION|XDG_(?:CONFIG_HOME|RUNTIME_DIR|STATE_HOME)"
    rf"|RMPA_(?:RUNTIME|STATE)_DIR|(?:CMAKE_PREFIX_|LD_LIBRARY_|PYTHON)?PATH|LANG|LANGUAGE|{'|'.join(VARIABLES)}"
)
_NAMED_ONLY: Final = ("ROS_", "RMPA_", "XDG_", "ZENOH_", "RMW_")
_NO_LOG: Final = "nothing: no unit of rmpa has a log here, or only root may read it; see --log\n"
# Where texts name a module or a user: `peer NAME: …`, "peer":"NAME", --name NAME, name = "NAME"; /home/NAME.
_MODULE: Final = re.compile(
    r"""(?m)(?:\b(?:peer|module)(?:["']\s?:\s?["']|=["']?|[ ](?=[\w.-]{1,99}:[ ]))|--(?:name|peer|agent)[ =]"""
    r"""|^[ \t]{0,9}name\s{0,9}=\s{0,9}["'])([A-Za-z][\w.-]*)"""
)
_USER: Final = re.compile(r"/(?:home|Users)/([\w.-]{3,})")
_FILES_SHOWN: Final = 300
_README: Final = """\
A report of `rmpa bug-report`. It has no contents of messages and no parameters' values.
Taken out: keys, tokens, passwords, user names and home directories{more}.
What no pattern knows may stay: secrets within a sentence, names of users and modules that stand only in a log,
names of topics, nodes and files. Look through it before you send it.
Files that could not be filled say why.
"""


@json_verb(
    config_option,
    option("-o --output", "PATH", "A .tar.gz, else a folder. [default: a .tar.gz here]"),
    option("--log", "FILE", "A log of rmpa up.", type=click.Path(exists=True, dir_okay=False)),
    flag("--anonymous", "Replace names of hosts and modules, and addresses, each by one word."),
)
def bug_report(config: str | None, output: str | None, log: str | None, anonymous: bool, options: Options) -> int:
    """Collect what a maintainer needs into one archive: versions, doctor, lists, settings, the end of the log.

    Keys, tokens, passwords, user names and home directories are taken out, and messages are never in it. Names of
    hosts and addresses stay, unless --anonymous is given. Nothing is sent: look into it, and attach it to the issue.

    ---
    It works as any user, without an agent, and with an agent that hangs. On a busy machine each part has 120 s.
    sudo adds the log of the units and the rules of the firewall.

    Exit codes: 0 written; 1 written, but parts are missing, as the last lines say; 2 a wrong option.

    Examples:
      rmpa bug-report
      rmpa bug-report --log up.log --anonymous
      rmpa bug-report -o report/               a folder, to look at
    """
    path = Path(output or time.strftime("rmpa-bug-report-%Y-%m-%d-%H%M%S.tar.gz"))
    if path.exists():
        raise ConfigError("--output", f"{path} is there already", "name another one")
    environ = {**os.environ, "RMPA_CONFIG": config} if config else dict(os.environ)
    found, modules, missing = collect(environ, log)
    settings: dict[str, Any] = {}
    with suppress(ValueError, KeyError):  # they cannot be read: the file says why
        settings = {each["name"]: each["value"] for each in json.loads(found["settings.json"])["settings"]}
    redactor = _redactor(environ, settings.get("web.token_file", ""), found.values())
    if anonymous:
        modules += [settings.get("name", ""), *_named(config, environ, found.values())]
        redactor.anonymise(found.values(), _hosts(environ, settings), modules)
    found["README.txt"] = _README.format(more=", names of hosts and modules, addresses" if anonymous else "")
    clean = {
        redactor.text(name): _redacted(name, text, redactor).encode(errors="backslashreplace")
        for name, text in sorted(found.items())
    }
    try:
        _write(path, clean)
    except OSError as error:
        raise StartError(str(path), f"cannot be written: {error.strerror}", "name another by --output") from None
    counts = {what: count for what, count in redactor.counts.items() if count}
    sizes = {name: len(data) for name, data in clean.items()}
    if options.as_json:
        file = str(path).encode(errors="backslashreplace").decode()
        options.show({"file": file, "files": sizes, "redacted": counts, "missing": missing})
        return 1 if missing else 0
    print_text(Table("FILE, >SIZE", [(name, size(count)) for name, count in sizes.items()]), "")
    print_text(f"redacted: {', '.join(f'{count} {what}' for what, count in counts.items()) or 'nothing'}")
    if found["log.txt"] == _NO_LOG and os.geteuid():
        print_text("log.txt is empty: if a unit of rmpa runs here, only root may read its log: sudo rmpa bug-report")
    print_text(f"{path} is written, and was not sent anywhere. Names may stay: look through it before you send it.")
    for name, why in missing.items():
        print_text(f"missing: {name}: {why}")
    return 1 if missing else 0


def collect(environ: Mapping[str, str], log: str | None) -> tuple[dict[str, str], list[str], dict[str, str]]:
    """Ask this machine.

    Args:
        environ: The shell's variables.
        log: A file with the agent's log.

    Returns:
        The text of each file, not redacted; the names of modules; of files that could not be filled, the reason.
    """
    system = json.dumps(_system(environ), default=str)
    found, modules, missing = {"system.json": system, "state.txt": "\n".join(_state(environ))}, [], {}
    programs = {file: own_command(*of.split()) for file, of in _COMMANDS.items()}
    for agent in find_agents(environ):
        modules.append(agent.name)
        file = f"{agent.name}/snapshot.json"
        try:
            with ControlClient(agent.path, _SNAPSHOT) as client:
                shown = client.snapshot()
        except RmpaError as error:
            found[file] = json.dumps({"error": str(error)})
            missing[file] = f"{error} (its lists neither)"
        else:
            found[file] = msgspec.json.encode(shown).decode()
            modules += [peer.name for peer in (*shown.peers, *shown.strangers)]
            of_agent = ("--agent", agent.name)
            programs |= {
                f"{agent.name}/{file}": own_command(*of.split(), *of_agent) for file, of in _OF_AGENTS.items()
            }
    programs["log.txt"] = [*_LOG.split(), *(f"--unit={unit}" for unit in UNITS.values())]
    said, late = run_programs(programs, environ)
    found |= said
    missing |= late
    if not found["log.txt"]:
        found["log.txt"] = _NO_LOG
    if log is not None:
        found["up.log"] = Path(log).read_bytes()[-_LOG_BYTES:].decode("utf-8", "replace")
    return found, modules, missing


def run_programs(
    programs: Mapping[str, list[str]], environ: Mapping[str, str]
) -> tuple[dict[str, str], dict[str, str]]:
    """What programs print, and of those that were ended that they were; of one that fails also what it says."""
    missing = {}

    def run(file: str) -> str:
        words, said = programs[file], ""
        try:
            process = Popen(words, stdin=DEVNULL, stdout=PIPE, stderr=PIPE, env=environ)  # noqa: S603 - ours
        except OSError as error:
            return f"{words[0]}: {error.strerror}\n"
        try:
            out, err = process.communicate(timeout=DEADLINE)
            if process.returncode and not file.endswith(".json"):
                said = f"exit code {process.returncode}\n"
        except TimeoutExpired:
            process.kill()
            out, err = process.communicate()
            missing[file] = f"it was ended after {DEADLINE:g} s"
            said = f"{missing[file]}\n"
        text = out[-_LOG_BYTES * 8 :].decode("utf-8", "replace")
        return text if file.endswith(".json") and out else text + said + err.decode("utf-8", "replace")

    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        return dict(zip(programs, pool.map(run, programs), strict=True)), missing


def _system(environ: Mapping[str, str]) -> dict[str, object]:
    distribution: dict[str, str] = {}
    with suppress(OSError):
        distribution = platform.freedesktop_os_release()
    return {
        "system": distribution.get("PRETTY_NAME", "unknown"),
        "kernel": f"{platform.system()} {platform.release()} {platform.version()} {platform.machine()}",
        "python": f"{platform.python_implementation()} {sys.version}",
        "program": [sys.executable, sys.prefix],
        "host": socket.gethostname(),
        "cpus": os.cpu_count(),
        "root": os.geteuid() == 0,
        "ros": sorted(map(str, Path("/opt/ros").glob("*"))),
        "variables": {
            name: value if _SHOWN.fullmatch(name) else "(not shown)"
            for name, value in sorted(environ.items())
            if _SHOWN.fullmatch(name) or name.startswith(_NAMED_ONLY)
        },
        "interfaces": [asdict(one) for one in list_interfaces()],
    }


def _state(environ: Mapping[str, str]) -> Iterator[str]:
    """The files that are kept, by mode, size and name; not what is in them."""
    directory = state_dir(of_unit(environ))
    yield f"{directory}:"
    paths = sorted(directory.rglob("*")) if directory is not None else []
    for path in paths[:_FILES_SHOWN]:
        with suppress(OSError):
            info = path.lstat()
            yield f"{info.st_mode:06o} {info.st_uid:>6} {info.st_size:>10} {path.relative_to(directory or path)}"


def _redactor(environ: Mapping[str, str], token_file: str, texts: Iterable[str]) -> Redactor:
    """One that knows this machine's secrets, users and homes."""
    directory = state_dir(of_unit(environ))
    files = [*directory.rglob("*token*")] if directory is not None else []
    secrets = [value for name, value in environ.items() if is_secret(name) and name not in ("PWD", "OLDPWD")]
    for file in (*files, Path(token_file)):
        with suppress(OSError):
            secrets.append(file.read_bytes()[:KIB].decode("utf-8", "replace").strip())
    caller = environ.get("SUDO_UID", "")
    users, homes = [environ.get(name, "") for name in ("USER", "LOGNAME", "SUDO_USER")], [environ.get("HOME", "")]
    for user in (os.geteuid(), int(caller) if caller.isdecimal() else os.getuid()):
        with suppress(KeyError):
            entry = pwd.getpwuid(user)
            users.append(entry.pw_name)
            homes.append(entry.pw_dir)
    return Redactor(secrets, homes, [*users, *(user for text in texts for user in _USER.findall(text))])


def _named(config: str | None, environ: Mapping[str, str], texts: Iterable[str]) -> Iterator[str]:
    """The names of modules in texts, and in settings that cannot be read."""
    for text in texts:
        yield from _MODULE.findall(text)
    with suppress(RmpaError, OSError):
        file = find_config_file(config, environ, Path.cwd(), [])
        yield from _MODULE.findall(file.read_text("utf-8", "replace") if file else "")


def _hosts(environ: Mapping[str, str], settings: Mapping[str, list[str]]) -> Iterator[str]:
    yield from (socket.gethostname(), socket.gethostname().partition(".")[0], environ.get("ROS_HOSTNAME", ""))
    yield from environ.get("ROS_STATIC_PEERS", "").split(";")
    for name in ("discovery.seeds", "web.hosts", "gateway.connect", "gateway.listen"):
        yield from (each.rpartition("@")[2].rpartition("/")[2].partition(":")[0] for each in settings.get(name, ()))


def _redacted(name: str, text: str, redactor: Redactor) -> str:
    if name.endswith(".json"):
        with suppress(ValueError):
            return json.dumps(redactor.value(json.loads(text)), indent=1, ensure_ascii=False) + "\n"
    return redactor.text(text)


def _write(path: Path, files: Mapping[str, bytes]) -> None:
    """Write it beside its place, and move it there when it is whole."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        if path.name.endswith((".tar.gz", ".tgz")):
            _write_archive(part, path.name.partition(".tar")[0], files)
        else:
            part.mkdir(mode=0o700)
            for name, data in files.items():
                (part / name).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                (part / name).write_bytes(data)
        part.rename(path)
    finally:  # nothing is there after the move
        shutil.rmtree(part, ignore_errors=True)
        part.unlink(missing_ok=True)


def _write_archive(path: Path, folder: str, files: Mapping[str, bytes]) -> None:
    opened = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(opened, "wb") as file, tarfile.open(fileobj=file, mode="w:gz") as archive:
        for name, data in files.items():
            info = tarfile.TarInfo(f"{folder}/{name}")  # it has no user's name
            info.size, info.mtime = len(data), int(time.time())
            archive.addfile(info, io.BytesIO(data))


# Every pattern takes a time linear in the text: it starts where no word goes on, or its repeats are bounded.
_LINE: Final = 4096
_LONG: Final = re.compile(rf"(?m)^(?=.{{{_LINE + 1}}})(.{{0,{_LINE - 1}}}\s|)(.*)$")  # cut between words
_TO_THE_END: Final = r"passw|passphrase|pwd|psk|authorization|cookie"  # their values may have blanks
_OTHERS: Final = (
    r"secret|token|credential|(?:api|private|access|shared)key|[-_]key(?![a-z])|auth(?![a-z])"
    r"|(?<!com)(?<!by)pass(?![a-z])|(?<![a-z])pw(?![a-z])"
)
_WORDS: Final = f"{_TO_THE_END}|{_OTHERS}"
_IS_SECRET: Final = re.compile(_WORDS, re.IGNORECASE)
# Names of files and the like: that they hold a secret does not make them one.
_IS_PLACE: Final = re.compile(r"(file|path|dir|folder)s?$", re.IGNORECASE)
_QUOTED: Final = r"\\?\"(?:[^\"\\\n]|\\.){0,200}\"|'[^'\n]{0,200}'"
_NAME: Final = r"[\w.-]{0,60}(?<!file)(?<!path)(?<!dir)(?<!folder)"
_IS: Final = r"\\?[\"']?[ \t]{0,9}[:=][ \t]{0,9}"


def is_secret(key: str) -> bool:
    """Whether the value of a variable or key is likely to be a secret."""
    return bool(_IS_SECRET.search(key)) and not _IS_PLACE.search(key)


def _value_of(match: re.Match[str]) -> str:
    key, between, _ = match.groups()
    return f"{key}{between}{GONE}" if is_secret(key) else match[0]


# What is counted, the pattern, and what takes its place.
_Rule: TypeAlias = "tuple[str, re.Pattern[str], str | Callable[[re.Match[str]], str]]"
_RULES: Final[tuple[_Rule, ...]] = (
    ("private keys", re.compile(r"(?s)-----BEGIN ([A-Z0-9 ]{1,40})-----.*?(?:-----END \1-----|\Z)"), GONE),
    ("ends of long lines", _LONG, lambda m: f"{m[1]}[{len(m[2])} characters cut]"),
    ("users and passwords of addresses", USER_INFO, rf"\1{GONE}@"),
    ("tokens", re.compile(r"(?i)\brmpa1-[a-z2-7]{8,}|(?<=bearer )[\w.~+/=-]{6,}|(?<=basic )[\w.~+/=-]{6,}"), GONE),
    # As base64 has it, and the hexadecimal digits of a key. Those of md5 (a type's) and of a commit stay.
    ("random texts", re.compile(r"(?<![\w+-])(?=[\w+-]*\d)(?=[\w+-]*[a-z])(?=[\w+-]*[A-Z])[\w+-]{40,}={0,2}"), GONE),
    ("random texts", re.compile(r"(?<![0-9a-fA-F])(?!(?:\w{32}|\w{40})\b)[0-9a-fA-F]{32,}"), GONE),
    *(
        (
            "values of secret names",
            re.compile(rf"(?i)({begin}(?:{words}){_NAME})({between})({_QUOTED}|{value})"),
            _value_of,
        )
        for begin, words, between, value in (
            ("", _TO_THE_END, _IS, ".+"),
            ("", _OTHERS, _IS, r"\S+"),
            (r"(?<![\w-])--[\w-]{0,60}", _WORDS, r"\s{1,9}", r"\S+"),  # --token …
            (r"\b", "password|passphrase", r"[ \t]{1,9}(?:(?:is|was)[ \t]{1,9})?", r"\S+"),  # the password …
        )
    ),
)
_HOME: Final = re.compile(r"/(?:home|Users)/[^/\s\"':;,\])}]+|/root(?![\w-])")
_HOST: Final = re.compile(r"(?<=://)[A-Za-z][\w.-]*")
_ADDRESS: Final = re.compile(
    r"(?<![\w.])(?:\d{1,3}\.){3}\d{1,3}(?![\w.])|(?<![\w:])[0-9a-fA-F]{0,4}(?::[0-9a-fA-F]{0,4}){2,7}(?![\w:])"
)
_MAC: Final = re.compile(r"(?<![\w:])(?:[0-9a-fA-F]{2}:){5}[0-9a-fA-F]{2}(?![\w:])")
# Names of accounts that tell nothing of a person: of services, and of many images.
_COMMON_ACCOUNTS: Final = frozenset({"root", "rmpa", "nobody", "user", "admin", "pi", "ubuntu", "ros", "robot"})


class Redactor:
    """Redacts texts, and counts what it has taken out.

    Args:
        secrets: Texts that are secrets, wherever they stand.
        homes: Home directories.
        users: Names of users.

    Attributes:
        counts: How many were taken out, by what they are.
        aliases: The word for each host, module and address; empty: they stay.
    """

    def __init__(self, secrets: Iterable[str] = (), homes: Iterable[str] = (), users: Iterable[str] = ()) -> None:
        self._rules: list[_Rule] = [
            ("secrets of this machine", _any_of(secret for secret in secrets if len(secret) > 5), GONE),
            *_RULES,
            ("home directories", _any_of(home for home in homes if home not in ("", "/")), "~"),
            ("home directories", _HOME, "~"),
            ("user names", _words(user for user in users if user not in _COMMON_ACCOUNTS), "[user]"),
        ]
        self.counts: Counter[str] = Counter()
        self.aliases: dict[str, str] = {}

    def anonymise(self, texts: Iterable[str], hosts: Iterable[str], modules: Iterable[str]) -> None:
        """Give hosts, modules and addresses of these texts other names from now on."""
        texts = list(texts)
        found = [match for text in texts for match in _HOST.findall(text)]
        for kind, names in (("host", [*hosts, *found]), ("module", modules)):
            for number, name in enumerate(sorted({*names} - {"", "localhost", *self.aliases}), 1):
                self.aliases[name] = f"{kind}-{number}"
        named = _words(self.aliases)
        addresses = {each for text in texts for pattern in (_MAC, _ADDRESS) for each in pattern.findall(text)}
        self.aliases |= {each: f"address-{n}" for n, each in enumerate(filter(_is_telling, sorted(addresses)), 1)}
        for pattern in (_MAC, _ADDRESS, named):
            self._rules.append(("hosts and addresses", pattern, lambda match: self.aliases.get(match[0], match[0])))

    def text(self, text: str) -> str:
        """A text without what is not to be seen."""
        for what, pattern, by in self._rules:
            text = self._swap(what, pattern, by, text)
        return text

    def value(self, value: object, key: str = "") -> object:
        """A value as JSON has it, likewise; ``key`` is its name."""
        if isinstance(value, dict):
            return {self.text(str(name)): self.value(each, str(name)) for name, each in value.items()}
        if isinstance(value, list | tuple):
            return [self.value(each, key) for each in value]
        if not isinstance(value, str):
            return value
        if value and is_secret(key):
            self.counts["values of secret names"] += 1
            return GONE
        return self.text(value)

    def _swap(self, what: str, pattern: re.Pattern[str], by: str | Callable[[re.Match[str]], str], text: str) -> str:
        count = 0

        def swapped(match: re.Match[str]) -> str:
            nonlocal count
            new = by(match) if callable(by) else match.expand(by)
            count += new != match[0]
            return new

        text = pattern.sub(swapped, text)
        self.counts[what] += count
        return text


def _is_telling(text: str) -> bool:
    """Whether an address tells anything of a network."""
    try:
        address = ip_address(text)
    except ValueError:
        return bool(_MAC.fullmatch(text))
    return not (address.is_loopback or address.is_unspecified or address.is_multicast or text.startswith("255."))


def _any_of(texts: Iterable[str]) -> re.Pattern[str]:
    """Matches each of some texts, the longest first; nothing where there is none."""
    return re.compile("|".join(map(re.escape, sorted({*texts}, key=len, reverse=True))) or "(?!)")


def _words(texts: Iterable[str]) -> re.Pattern[str]:
    return re.compile(rf"(?<![A-Za-z0-9_])(?:{_any_of(filter(None, texts)).pattern})(?![A-Za-z0-9_])")
