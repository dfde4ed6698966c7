"""Networks for tests: cables between namespaces, routers that masquerade, programs inside."""

import json
import subprocess
import sys
import threading
from pathlib import Path

from skytether.lab.netns import Namespace


def cable(first: Namespace, second: Namespace, one: tuple[str, str], other: tuple[str, str]) -> None:
    """Join two namespaces; of each end the device's name, and its address with the length of the prefix."""
    first.ip("link", "add", one[0], "type", "veth", "peer", "name", other[0], "netns", second.path)
    for where, (device, address) in ((first, one), (second, other)):
        # An address of IPv6 is usable at once: nobody else is there who could have it.
        where.ip("address", "add", address, "dev", device, *(["nodad"] if ":" in address else []))
        where.ip("link", "set", device, "up")


def nft(where: Namespace, rules: str) -> None:
    """Load rules of nftables."""
    run(where, "nft", "-f", "-", text=rules)


def run(where: Namespace, *command: str, text: str = "") -> None:
    """Run a program to its end."""
    where.run(lambda: subprocess.run(command, input=text, check=True, capture_output=True, text=True))


def masquerade(router: Namespace, device: str, first_port: int) -> None:
    """Bind outgoing UDP flows to ports from here on; forgets all bindings that there are."""
    nft(
        router,
        f"""flush ruleset
        table ip nat {{
            chain post {{
                type nat hook postrouting priority srcnat; policy accept;
                oifname "{device}" meta l4proto udp masquerade to :{first_port}-{first_port + 999};
            }}
        }}""",
    )
    run(router, "conntrack", "-F")


class Program:
    """``skytether COMMAND --config FILE --json`` in a namespace, or here.

    Attributes:
        told: What it printed so far, oldest first.
    """

    def __init__(self, where: Namespace | None, command: str, folder: Path, config: dict) -> None:
        file = folder / f"{command}-{len(list(folder.iterdir()))}.yaml"
        file.write_text(json.dumps(config))  # YAML all the same
        arguments = [sys.executable, "-m", "skytether.cli", command, "--config", str(file), "--json"]
        self.told: list[dict] = []
        self._log = file.with_suffix(".log")
        with self._log.open("w") as log:

            def start() -> subprocess.Popen:
                return subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=log, text=True)

            self._process = start() if where is None else where.run(start)
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def log(self) -> str:
        """What it wrote on standard error."""
        return self._log.read_text()

    def wait(self, condition, seconds: float = 30) -> dict:
        """Wait until the latest of what it prints is so; returns it."""
        with self._changed:
            so = self._changed.wait_for(lambda: self.told and condition(self.told[-1]), seconds)
            assert so, (self.told[-1:], self._log.read_text())
            return self.told[-1]

    def wait_more(self, count: int) -> dict:
        """Wait until it has printed so much more; returns the latest."""
        until = len(self.told) + count
        return self.wait(lambda _: len(self.told) >= until)

    def kill(self) -> None:
        """At the end of a test, whatever became of it."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._reader.join()
        self._process.stdout.close()

    def _read(self) -> None:
        for line in self._process.stdout:
            with self._changed:
                self.told.append(json.loads(line))
                self._changed.notify_all()
