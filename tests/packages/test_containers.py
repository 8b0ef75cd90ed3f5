"""``packaging/container``: the image is built by buildah, and the compose file's three modules run by podman.

The commands of docs/guides/containers.md are among them, with podman in place of Docker.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from lab.bed.processes import DEADLINE, Process, eventually, run

ROOT: Final = Path(__file__).parents[2]
CONTAINER: Final = ROOT / "packaging/container"
COMPOSE: Final = Path(sys.executable).with_name("podman-compose")
IMAGE: Final = "localhost/rmpa"
ROS_IMAGE: Final = "localhost/ros"
# No systemd and no cgroups of our own are needed, and nothing of the machine's other containers is touched.
CONFIGURATION: Final = """
[containers]
cgroups = "disabled"
[engine]
cgroup_manager = "cgroupfs"
events_logger = "file"
tmp_dir = "{home}/tmp"
[network]
network_backend = "cni"
network_config_dir = "{home}/networks"
"""
STORAGE: Final = """
[storage]
driver = "overlay"
graphroot = "{home}/images"
runroot = "{home}/run"
"""


def why_not() -> str:
    """Why images cannot be built and run here, or an empty string."""
    if os.geteuid() != 0:
        return "containers with networks of their own need root"
    if missing := [word for word in ("podman", "buildah", "crun") if shutil.which(word) is None]:
        return f"no {', '.join(missing)} here (scripts/install-podman installs Debian's)"
    if not COMPOSE.exists():
        return "no podman-compose in the virtual environment (pip install -e '.[dev]')"
    return "" if sorted((ROOT / "dist").glob("rmpa-*.whl")) else "no wheel in dist (make wheel)"


pytestmark = [pytest.mark.packages, pytest.mark.timeout(900), pytest.mark.skipif(bool(why_not()), reason=why_not())]


class Podman:
    """Podman on a machine of its own: network, processes and all images (in memory) go when it is closed."""

    def __init__(self, home: Path) -> None:
        # crun wants cgroups of one version.
        cgroups = "umount -R /sys/fs/cgroup && mount -t cgroup2 none /sys/fs/cgroup"
        # What podman and its networks keep beside the images is in /run and /var/lib.
        memory = f"for place in /run /var/lib {home}; do mount -t tmpfs tmpfs $place; done"
        # crun gives what a container reads and writes to the container's user (990): it gets another null device.
        null = "mknod -m 666 /run/null c 1 3 && mount --bind /run/null /dev/null"
        boot = f"{memory}; {null}; ip link set lo up; {cgroups}; echo up; exec sleep infinity"
        words = ["unshare", "--net", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc", "sh", "-c", boot]
        self._machine = Process(words)
        self._machine.wait_for("up")
        self._pid = Path(f"/proc/{self._machine.pid}/task/{self._machine.pid}/children").read_text().strip()
        self.env = dict(os.environ)
        for name, text in (("CONTAINERS_CONF", CONFIGURATION), ("CONTAINERS_STORAGE_CONF", STORAGE)):
            self.env[name] = f"{home}/{name}"
            self.run("sh", "-c", 'echo "$1" >"$2"', "sh", text.format(home=home), self.env[name])

    def close(self) -> None:
        """End all of it."""
        self._machine.send(signal.SIGKILL)
        self._machine.end()

    def run(self, *words: str | Path, timeout: float = DEADLINE, online: bool = False) -> str:
        """Run any program on that machine; ``online`` with the network of the real one, to reach the registries."""
        enter = ["nsenter", f"--target={self._pid}", "--mount", "--pid", *([] if online else ["--net"])]
        return run([*enter, "sh", "-c", 'exec "$@" </dev/null', "sh", *words], env=self.env, timeout=timeout)

    def __call__(self, *words: str | Path, timeout: float = DEADLINE) -> str:
        """Run podman there."""
        return self.run("podman", *words, timeout=timeout)

    def rmpa(self, container: str, *words: str) -> str:
        """What a command of rmpa says in a container."""
        return self("exec", container, "rmpa", *words)

    def wait_up(self, container: str) -> None:
        """Wait until the agent of a container serves its module."""
        eventually(lambda: "ROS_MASTER_URI" in self("logs", container), what=f"the agent of {container}")

    def load(self, image: str, kind: str) -> None:
        """Make an image of a Debian."""
        debian = run([ROOT / "packaging/test/chroot", "bookworm", "amd64", kind], timeout=600.0).split()[-1]
        self.run("sh", "-c", f"tar -C {debian} -c . | podman import --quiet - {image}", timeout=200.0)

    def build(self, image: str, containerfile: Path, folder: Path) -> None:
        """Build an image."""
        registries = [Path("/etc/pip.conf"), Path("/etc/ssl/certs/ca-certificates.crt")]
        volumes = [f"--volume={path}:{path}:ro" for path in registries if path.exists()]
        words = ["buildah", "bud", "--format=docker", "--isolation=chroot", "--network=host", *volumes]
        self.run(*words, "-t", image, "-f", containerfile, folder, timeout=600.0, online=True)


@pytest.fixture(scope="module")
def podman(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Podman]:
    """Podman with the image, and one of Debian's ROS."""
    with contextlib.closing(Podman(tmp_path_factory.mktemp("podman"))) as made:
        made.load("debian:bookworm-slim", "bare")
        made.load(ROS_IMAGE, "rospy")
        made.build(IMAGE, CONTAINER / "Containerfile", ROOT)
        yield made


@pytest.fixture(scope="module")
def modules(podman: Podman) -> Iterator[dict[str, str]]:
    """The compose file's containers by their names in it."""
    compose = [str(COMPOSE), "-p", "rmpa", "-f", str(CONTAINER / "compose.yaml")]
    podman.env["ROS_IMAGE"] = ROS_IMAGE
    podman.run(*compose, "up", "--detach", "--no-build", timeout=100.0)
    yield {name: f"rmpa_{name}_1" for name in ("joystick", "base", "base-nodes", "pc", "pc-nodes")}
    podman.run(*compose, "down", timeout=100.0)


def test_messages_cross_between_the_modules_of_the_compose_file(podman: Podman, modules: dict[str, str]) -> None:
    names = {"joystick", "base", "pc"}

    def linked(name: str) -> bool:
        peers = podman.rmpa(modules[name], "peer", "list")
        return set(re.findall(r"(?m)^(\w+) +linked", peers)) == names - {name}

    eventually(lambda: all(map(linked, names)), what="all links")
    eventually(lambda: "forward" in podman("logs", modules["base-nodes"]), 60.0, what="the command at base")
    eventually(lambda: "average rate" in podman("logs", modules["pc-nodes"]), 60.0, what="its rate at pc")
    assert "[joystick]" in podman.rmpa(modules["base"], "topic", "list", "-v")


def test_the_page_is_published_to_this_machine_behind_its_token(podman: Podman, modules: dict[str, str]) -> None:
    urls = eventually(lambda: re.findall(r"http://pc:8480(/\S+)", podman("logs", modules["pc"])), what="the URL")
    for path, status in ((urls[0], "303"), ("/", "401")):
        fetch = f"import http.client as h; c = h.HTTPConnection('127.0.0.1', 8480); c.request('GET', '{path}')"
        assert podman.run(sys.executable, "-c", f"{fetch}; print(c.getresponse().status)").strip() == status


def test_an_agent_is_healthy_not_root_ends_in_order_and_keeps_its_name_in_its_volume(podman: Podman) -> None:
    podman("run", "--detach", "--name=one", "--volume=state:/var/lib/rmpa", IMAGE, "up", "--name=arm")
    podman.wait_up("one")
    podman("healthcheck", "run", "one")
    assert "uid=990(rmpa)" in podman("exec", "one", "id")
    assert "fail " not in podman.rmpa("one", "doctor")
    podman("stop", "--time=5", "one")
    assert podman("inspect", "--format={{.State.ExitCode}}", "one").split() == ["0"]
    podman("run", "--detach", "--name=two", "--volume=state:/var/lib/rmpa", IMAGE)
    podman.wait_up("two")
    assert "agent arm" in podman.rmpa("two", "doctor")
    podman("stop", "two")


def test_on_the_network_of_the_host_nodes_of_the_host_are_in_its_module(podman: Podman) -> None:
    podman("run", "--detach", "--name=robot", "--network=host", IMAGE, "up", "--name=robot")
    podman.wait_up("robot")
    talker = ["rostopic", "pub", "/x", "std_msgs/String", "y"]
    podman("run", "--detach", "--name=node", "--network=host", "--stop-signal=SIGINT", ROS_IMAGE, *talker)
    eventually(lambda: "/x " in podman.rmpa("robot", "topic", "list", "-v"), what="the topic")
    podman("stop", "node", "robot")
