"""What the kernel tells of a container, out of files as it writes them."""

from __future__ import annotations

from pathlib import Path

from skytether.api.usage import Usage, pull_usage, write_usage
from skytether.service.container_usage import container_usage

NETWORK = """\
Inter-|   Receive                                                |  Transmit
 face |bytes packets errs drop fifo frame compressed multicast|bytes packets errs drop fifo colls carrier compressed
    lo:  900    9    0    0    0     0          0         0     900   9    0    0    0     0       0          0
  eth0:1000     8    0    0    0     0          0         0     2000  7    0    0    0     0       0          0
  eth1:   10    1    0    0    0     0          0         0       20  1    0    0    0     0       0          0
"""


def write(folder: Path, files: dict[str, str]) -> Path:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return folder


def test_control_groups_of_both_versions_and_all_interfaces_but_the_loopback(tmp_path: Path) -> None:
    network = tmp_path / "dev"
    network.write_text(NETWORK)
    second = write(
        tmp_path / "v2",
        {
            "cgroup.controllers": "cpu memory\n",
            "cpu.stat": "usage_usec 1500000\nuser_usec 1000000\n",
            "memory.current": "5000\n",
            "memory.stat": "anon 3000\ninactive_file 1000\n",
        },
    )
    assert container_usage(second, network) == Usage(1.5, 4000, 1010, 2020)
    first = write(
        tmp_path / "v1",
        {
            "cpuacct/cpuacct.usage": "2500000000\n",
            "memory/memory.usage_in_bytes": "5000\n",
            "memory/memory.stat": "inactive_file 1\ntotal_inactive_file 2000\n",
        },
    )
    assert container_usage(first, network) == Usage(2.5, 3000, 1010, 2020)


def test_what_cannot_be_read_is_not_known(tmp_path: Path) -> None:
    broken = write(tmp_path, {"cgroup.controllers": "", "memory.current": "max", "cpu.stat": "usage_usec \n"})
    assert container_usage(broken, tmp_path / "none") == Usage()


def test_no_service_is_trusted() -> None:
    honest = Usage(1.5, 4000, 1, 2)
    assert pull_usage({"usage": write_usage(honest)}) == honest
    assert write_usage(Usage(memory_bytes=3)) == {"memory_bytes": 3}
    lies = {"cpu_s": float("nan"), "memory_bytes": -1, "received_bytes": True, "sent_bytes": "many", "x": 1}
    for document in ({"usage": lies}, {"usage": {"cpu_s": 1e300}}, {"usage": []}, [], None):
        assert pull_usage(document) == Usage()
