from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from plain_site.runtime import PlainOptions, PlainRuntime
from skytether.orchestrator.runtimes.base import Runtime
from skytether.testing.runtime_contract import RuntimeContract, RuntimeKit

pytestmark = [pytest.mark.slow, pytest.mark.together]  # real processes


class PlainKit(RuntimeKit):
    def open(self, behaviour: str = "good") -> Runtime:
        runtime = PlainRuntime("plain", self.folder, PlainOptions())
        self.runtimes.append(runtime)
        return runtime

    def running(self, instance: str = "i1") -> int:
        grant = str(self.folder / instance / "grant.json")
        found = 0
        for process in psutil.process_iter(["environ"]):
            found += (process.info["environ"] or {}).get("SKYTETHER_GRANT") == grant
        return found


class TestPlainRuntime(RuntimeContract):
    @pytest.fixture
    def kit(self, tmp_path: Path) -> Iterator[RuntimeKit]:
        kit = PlainKit(tmp_path)
        yield kit
        kit.close()
