"""``rmpa service install`` on machines that run systemd, by each way to install (docs/guides/running.md)."""

from __future__ import annotations

import json

import pytest

from lab.bed.namespaces import Lab
from tests.packages.machines import Machine, why_no_systemd
from tests.packages.ways import USER, WAYS, Way

pytestmark = [pytest.mark.packages, pytest.mark.timeout(600)]


@pytest.mark.parametrize("way", [way for way in WAYS if not way.boot], ids=lambda way: way.name)
def test_it_runs_at_boot_under_the_name_that_it_has_had(way: Way) -> None:
    if reason := why_no_systemd():
        pytest.skip(reason)
    if (product := way.product()) is None:
        pytest.skip(f"nothing in dist to install by this way: {way.made_by}")
    packaged = way.name == "deb"
    with Lab() as lab, Machine(lab.host("robot", 0), way.suites[0], systemd=True) as robot:
        program = way.install(robot, robot.put(product, "root" if packaged else USER))
        by_hand = robot.start(program, "up", "--name", "picar", user=USER)
        by_hand.wait_for("ROS_MASTER_URI=")
        caller = {"SUDO_UID": robot.run("id", "-u", USER).strip()}
        path = robot.run("sh", "-c", f"realpath -s $(command -v {program})", user=USER).strip()
        refused = robot.run("sh", "-c", f"{path} service install 2>&1 || true", env=caller)
        assert "has port 11311, which the agent's core needs; end it first" in refused
        by_hand.interrupt()
        by_hand.wait(30)

        said = robot.run(path, "service", "install", "--web", env=caller)
        assert f"copy what {USER}'s agent has kept in /home/{USER}/.local/state/rmpa: the name picar, picar/" in said
        first, web = json.loads(robot.run(path, "service", "status", "--json"))["units"][:2]
        assert (first["active"], first["enabled"], web["active"], web["enabled"]) == ("active", True, "active", True)
        assert robot.run(path, "peer", "list").startswith("picar knows no peers")
        user = robot.run("ps", "-o", "user=", "-p", str(first["pid"])).strip()
        assert user == (USER if "the units run as" in said else "rmpa")
        again = robot.run(path, "service", "install", "--web", env=caller).splitlines()
        assert {"rmpa.service runs", "rmpa-web.service runs", "/var/lib/rmpa stays as it is"} <= set(again)

        robot.run("kill", "-STOP", str(first["pid"]))  # the event loop hangs
        robot.run("sh", "-c", f"until systemctl show -p MainPID rmpa | grep -qv ={first['pid']}; do sleep 0.2; done")
        robot.run("systemctl", "restart", "rmpa")
        assert "watchdog" in robot.run("journalctl", "--unit=rmpa", "--no-pager").lower()
        assert robot.run(path, "peer", "list").startswith("picar knows no peers")

        robot.run(path, "service", "uninstall", *([] if packaged else ["--purge", "--yes"]))
        assert "rmpa" not in robot.run("systemctl", "list-units", "--all", "rmpa*", "--no-legend")
        if not packaged:
            left = robot.run(
                "sh", "-c", "find /etc /var/lib /run -name '*rmpa*'; getent passwd rmpa; getent group rmpa; true"
            )
            assert left == ""
