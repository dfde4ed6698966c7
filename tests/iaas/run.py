"""From a bare machine to a robot that is driven, and back: ``make iaas``. Needs root, QEMU, debootstrap, Docker.

A virtual machine of Debian 12 is made by ``terraform apply`` with the very user-data that the module ``node``
renders. It boots, installs, joins an orchestrator, and its engine runs the service that drives a simulated walker in
another network namespace. ``terraform destroy`` drains it under the walker's feet: a site of processes takes over.
Nothing is reached outside: what a cloud's machine would download lies in the disk. Prints minutes by step.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
WORK = ROOT / "build" / "iaas"
IMAGES = ("skytether/virtual-trail:1", "skytether/guard:1")
NEEDED = {
    "qemu-system-x86_64": "qemu-system-x86",
    "genisoimage": "genisoimage",
    "debootstrap": "debootstrap",
    "mke2fs": "e2fsprogs",
    "ssh-keygen": "openssh-client",
    "ip": "iproute2",
    "docker": "docker.io",
    "terraform": "terraform, of its makers",
}
URL = "http://10.86.9.1:8600"
SKYTETHER = (sys.executable, "-m", "skytether.cli")
DRIVEN_S = 20.0


class Steps:
    """How long each step took."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, float]] = []
        self._last = time.monotonic()

    def done(self, name: str) -> None:
        """The step that ends now."""
        now = time.monotonic()
        self.add(name, now - self._last)
        self._last = now

    def add(self, name: str, seconds: float) -> None:
        """A step that somebody else timed."""
        self.rows.append((name, seconds))
        sys.stderr.write(f"{seconds:7.1f} s  {name}\n")

    def table(self) -> str:
        """For a page."""
        return "\n".join(["| step | min |", "| --- | --- |", *(f"| {name} | {s / 60:.1f} |" for name, s in self.rows)])


def run(*words: str, **more: object) -> str:
    """A command's output.

    Raises:
        SystemExit: It failed; with the end of what it said.
    """
    done = subprocess.run(words, capture_output=True, text=True, check=False, **more)  # type: ignore[call-overload]
    if done.returncode:
        said = (done.stderr or done.stdout).strip()[-3000:]
        sys.exit(f"error: {' '.join(words[:6])} ... ended with {done.returncode}:\n{said}")
    return str(done.stdout)


def until(good: Callable[[], object], patience_s: float, what: str) -> None:
    """Wait for it.

    Raises:
        SystemExit: It took too long.
    """
    deadline = time.monotonic() + patience_s
    while not good():
        if time.monotonic() > deadline:
            sys.exit(f"error: {what} within {patience_s:.0f} s: not so")
        time.sleep(0.2)


def disk(steps: Steps) -> str:
    """Make the bare machine's disk: Debian, Skytether's wheels, the images of a service. The wheel's name."""
    run("bash", str(HERE / "root.sh"), str(WORK / "root"))
    steps.done("a bare Debian (kept for the next time)")
    run(sys.executable, str(ROOT / "images" / "build.py"), "guard", "base", "virtual-trail", cwd=ROOT)
    root = WORK / "root"
    shutil.rmtree(root / "opt", ignore_errors=True)
    (root / "opt" / "wheels").mkdir(parents=True)
    wheels = ROOT / "build" / "images" / "wheels"
    for wheel in (*wheels.glob("project/*.whl"), *wheels.glob(f"{os.uname().machine}/base/*.whl")):
        shutil.copy(wheel, root / "opt" / "wheels")
    run("docker", "save", "--output", str(root / "opt" / "images.tar"), *IMAGES)
    for part in ("vmlinuz", "initrd.img"):
        shutil.copy(root / part, WORK / part)
    (WORK / "disk.img").unlink(missing_ok=True)
    run("mke2fs", "-q", "-t", "ext4", "-d", str(root), str(WORK / "disk.img"), "8G")
    for part in ("key", "key.pub"):
        (WORK / part).unlink(missing_ok=True)
    run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "iaas", "-f", str(WORK / "key"))
    steps.done("wheels, images, disk")
    return next(wheels.glob("project/*.whl")).name


@contextmanager
def networks() -> Iterator[tuple[str, str]]:
    """Two namespaces with names, joined by a bridge: the house, with the machine's device, and the robot's."""
    house, robot = f"sky-house-{os.getpid()}", f"sky-robot-{os.getpid()}"
    commands = f"""
        netns add {house}
        netns add {robot}
        -n {house} link set lo up
        -n {robot} link set lo up
        -n {house} link add lan type bridge
        -n {house} addr add 10.86.9.1/24 dev lan
        -n {house} link set lan up
        -n {house} tuntap add dev vm mode tap
        -n {house} link set vm master lan up
        -n {house} link add toward type veth peer name eth netns {robot}
        -n {house} link set toward master lan up
        -n {robot} addr add 10.86.9.3/24 dev eth
        -n {robot} link set eth up
    """
    try:
        for line in commands.strip().splitlines():
            run("ip", *line.split())
        yield house, robot
    finally:
        for name in (house, robot):
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)


def ended(process: subprocess.Popen[str]) -> None:
    """End a program of ours."""
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def main() -> None:
    """Do all of it."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    missing = [package for command, package in NEEDED.items() if shutil.which(command) is None]
    if missing:
        sys.exit(f"error: missing here: {', '.join(missing)}")
    WORK.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("error: ended from outside"))  # with all that it started
    steps = Steps()
    wheel = disk(steps)
    with ExitStack() as stack:
        drive(stack, steps, wheel)
    sys.stdout.write(steps.table() + "\n")


def drive(stack: ExitStack, steps: Steps, wheel: str) -> None:
    """What is timed."""
    house, robot = stack.enter_context(networks())
    state = WORK / "state"
    shutil.rmtree(state, ignore_errors=True)
    configuration = WORK / "orchestrator.yaml"
    configuration.write_text(
        "host: 10.86.9.1\ninsecure_http: true\nlocal_site: false\nnodes: {port: 8603}\n"
        "timing: {start_timeout: 240}\n"  # an emulated processor takes its time
    )
    inside = ("ip", "netns", "exec", house)
    words = ("orchestrator", "run", "--config", str(configuration), "--state-dir", str(state))
    log = stack.enter_context((WORK / "orchestrator.log").open("w"))
    orchestrator = subprocess.Popen([*inside, *SKYTETHER, *words], stdout=log, stderr=log, text=True)
    stack.callback(ended, orchestrator)
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("TF_", "SKYTETHER_"))}
    environment |= {
        "SKYTETHER_URL": URL,
        "SKYTETHER_TOKEN_FILE": str(state / "operator.token"),
        "SKYTETHER_INSECURE_HTTP": "true",
        "TF_DATA_DIR": str(WORK / "terraform"),
        "TF_CLI_CONFIG_FILE": os.devnull,
        "CHECKPOINT_DISABLE": "1",
    }

    def skytether(*asked: str) -> str:
        return run(*inside, *SKYTETHER, *asked, env=environment)

    def sites_that_run() -> list[str]:
        instances = json.loads(skytether("instance", "list", "--json"))
        return [one["placement"]["site"] for one in instances if one["state"] == "running"]

    address = state / "address"
    until(address.exists, 60, "the orchestrator answers")
    token = skytether("robot", "add", "walker").strip()
    (WORK / "terraform.tfstate").unlink(missing_ok=True)
    variables = {"folder": str(WORK), "cli": SKYTETHER, "wheel": wheel, "tap": "vm"}
    (WORK / "iaas.tfvars.json").write_text(json.dumps(variables))

    def terraform(*asked: str) -> str:
        command = ("terraform", f"-chdir={HERE}", *asked, "-no-color")
        return run(*inside, *command, env=environment)

    chosen = ("-input=false", f"-var-file={WORK / 'iaas.tfvars.json'}", f"-state={WORK / 'terraform.tfstate'}")
    terraform("init", "-input=false")
    stack.callback(subprocess.run, ["bash", str(HERE / "machine.sh"), "stop"], env={**environment, "FOLDER": str(WORK)})
    steps.done("an orchestrator")
    began = time.monotonic()
    (WORK / "apply.log").write_text(terraform("apply", "-auto-approve", *chosen))
    joined = time.monotonic() - began
    shown = (WORK / "apply.log").read_text() + (WORK / "terraform.tfstate").read_text()
    if re.search(r"sky-[A-Za-z0-9_-]{20,}\.", shown):
        sys.exit("error: a join token is in Terraform's state or output")
    steps.done("terraform apply: from no machine to a site")
    known_hosts = f"UserKnownHostsFile={WORK / 'known_hosts'}"
    machine = (*inside, "ssh", "-i", str(WORK / "key"), "-o", known_hosts, "-o", "BatchMode=yes", "debian@10.86.9.2")
    by_machine(steps, joined, run(*machine, "cat", "/var/log/skytether-setup.log"))
    walker = subprocess.Popen(
        ["ip", "netns", "exec", robot, sys.executable, str(HERE / "walker.py"), URL, token, "300"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    )
    stack.callback(ended, walker)
    assert walker.stdout is not None
    assert walker.stdin is not None
    first = walker.stdout.readline()
    if not first:
        sys.exit("error: the walker was not driven; see build/iaas/orchestrator.log")
    steps.done("the walker asks: to its first velocity command")
    steps.add("**from no machine to the first velocity command**", time.monotonic() - began)
    time.sleep(DRIVEN_S)
    steps.done(f"it is driven, by the site {', '.join(sites_that_run())}")
    said = run(*machine, "sudo", "journalctl", "--unit", "skytether-node", "--output", "cat", "--no-pager")
    if "linked" not in said or "cannot be stopped" in said:  # by its unit it may hold the numbers of processes
        sys.exit(f"error: the node says:\n{said}")
    options = ("--option", "bind_host=10.86.9.1", "--option", "advertise_host=10.86.9.1")
    skytether("site", "add", "house", "--runtime", "process", *options)
    (WORK / "destroy.log").write_text(terraform("destroy", "-auto-approve", *chosen))
    steps.done("terraform destroy: drained, the walker driven by another site, the machine gone")
    at_work = sites_that_run()
    walker.stdin.close()
    facts = json.loads(walker.stdout.readline())
    sites = [site["name"] for site in json.loads(skytether("site", "list", "--json"))]
    if sites != ["house"] or at_work != ["house"]:
        sys.exit(f"error: sites {sites}, instances run at {at_work}")
    first_s = json.loads(first)["first_command_s"]
    sys.stdout.write(
        f"the walker's first command came after {first_s} s; it was driven for {facts['driven_s']} s, of which "
        f"{facts['by_the_service']:.1%} by the service; the longest time without was {facts['longest_without_s']} s\n"
    )


def by_machine(steps: Steps, joined: float, log: str) -> None:
    """The machine's own account of its set-up: seconds since it was switched on."""
    stamps = [(name, float(at)) for at, name in re.findall(r"skytether-setup: ([\d.]+) s: (.*)", log)]
    last = ("boot, until cloud-init sets up", 0.0)
    for name, at in stamps:
        steps.add(f"&nbsp;&nbsp;of it: {last[0]}", at - last[1])
        last = (name, at)
    steps.add("&nbsp;&nbsp;of it: join", joined - last[1])


if __name__ == "__main__":
    main()
