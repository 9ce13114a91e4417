"""Nodes talk over the loopback interface alone, and not through shared memory."""

import os
from pathlib import Path
from typing import Any

import pytest
from codesign_bringup.bringup import Graph

LOOPBACK = "0100007F"  # 127.0.0.1 as in /proc/net/udp
CHOICES = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE", "RMW_IMPLEMENTATION")


def udp_addresses(pid: int) -> set[str]:
    """Local addresses of a process's UDP sockets."""
    links = [os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir()]
    inodes = {link[8:-1] for link in links if link.startswith("socket:[")}
    sockets = [line.split() for line in Path(f"/proc/{pid}/net/udp").read_text().splitlines()[1:]]
    return {columns[1].split(":")[0] for columns in sockets if columns[9] in inodes}


@pytest.mark.parametrize("set_before", [True, False], ids=["by env.sh", "by bringup"])
def test_a_node_is_heard_on_this_host_only(
    set_before: bool, probe: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from codesign_interfaces.msg import PolicyStatus
    from codesign_nodes import qos
    from std_srvs.srv import Trigger

    if not set_before:
        for name in CHOICES:
            monkeypatch.delenv(name, raising=False)
    probe.listen("/policy/status", PolicyStatus, qos.EVERY)
    with Graph(tmp_path, quiet=True) as graph:
        process = graph.start("policy").process
        assert probe.call("/policy/stop", Trigger, Trigger.Request()).success
        assert udp_addresses(process.pid) == {LOOPBACK}
        assert "/dev/shm/fastrtps_" not in Path(f"/proc/{process.pid}/maps").read_text()
        probe.wait_for(lambda: probe.received["/policy/status"], 10.0, "a word from the node")
