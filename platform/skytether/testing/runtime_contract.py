"""The contract of a runtime, as a suite that anybody can run over a runtime of their own.

A runtime brings a :class:`RuntimeKit`; the tests are methods of :class:`RuntimeContract`. Of a runtime that several
orchestrators may use, :class:`TwoLeadersContract` is to pass, too::

    class TestMyRuntime(RuntimeContract):
        @pytest.fixture
        def kit(self, tmp_path):
            kit = MyKit(tmp_path)
            yield kit
            kit.close()

The services are :mod:`skytether.testing.toy_service`, which takes tens of milliseconds to start. It needs pytest; in
``conftest.py``, ``pytest.register_assert_rewrite("skytether.testing.runtime_contract")`` makes failures say more.
"""

from __future__ import annotations

import base64
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import pytest

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.runtimes.base import Launch, Observation, OvertakenError, Phase, Runtime, RuntimeFailure

TOY = "skytether.testing.toy_service"
"""The service that the suite runs, as an entry point."""


class RuntimeKit(ABC):
    """One kind of runtime, and how to get services of it that behave in a certain way."""

    patience: ClassVar[float] = 30.0
    """Seconds that a run may take to become what it should."""
    image = "toy"
    """For a runtime of containers: an image that runs ``TOY``."""
    reads_reports: ClassVar[bool] = True
    """Whether what a service reports is seen; a runtime that cannot read the file reads none."""

    def __init__(self, folder: Path) -> None:
        """``folder``: the site's own, empty."""
        self.folder = folder
        self.runtimes: list[Runtime] = []
        """All that were opened; ``close`` closes them."""

    @abstractmethod
    def open(self, behaviour: str = "good") -> Runtime:
        """A runtime over the same site each time; note it in ``runtimes``.

        Args:
            behaviour: Of the services that it will start: ``good``, ``stubborn`` or ``crashing``. A runtime that runs
                the toy service need not know: ``launch`` says it to the service.
        """

    @abstractmethod
    def running(self, instance: str = "i1") -> int:
        """How many runs of an instance the machine has now, whatever any runtime says."""

    def launch(self, instance: str = "i1", attempt: int = 1, behaviour: str = "good") -> Launch:
        """What to start."""
        behaviours: dict[str, dict[str, Any]] = {
            "good": {"say": f"run {attempt}", "report": f"run {attempt} is up"},
            "stubborn": {"ignore_sigterm": True},
            "crashing": {"exit_status": 1, "say": "boom"},
        }
        grant = Grant(
            instance=instance,
            service="toy",
            robot="walker",
            params=behaviours[behaviour],
            session_id="00112233445566aa",
            session_key=base64.b64encode(bytes(range(32))).decode(),
            topics=(),
        )
        return Launch(attempt, ServiceSpec(entrypoint=TOY, image=self.image), grant)

    def until(self, runtime: Runtime, phase: Phase, instance: str = "i1") -> Observation:
        """Look until the instance is in this phase."""
        deadline = time.monotonic() + self.patience
        while (seen := runtime.observe().get(instance)) is None or seen.phase is not phase:
            assert time.monotonic() < deadline, f"{instance} is {seen}, not {phase}, after {self.patience} s"
            time.sleep(0.005)
        return seen

    def until_gone(self, runtime: Runtime, instance: str = "i1") -> None:
        """Look until the instance is not there."""
        _until(lambda: instance not in runtime.observe(), self.patience)

    def close(self) -> None:
        """Leave nothing behind."""
        cleaner = self.open()  # of no leader
        for instance in list(cleaner.observe()):
            cleaner.remove(instance)
        for runtime in self.runtimes:
            runtime.observe()  # what it began and another ended is waited for
            runtime.close()


class RuntimeContract:
    """What every runtime must do: the words of :mod:`skytether.orchestrator.runtimes.base`, as tests."""

    def test_a_site_offers_something(self, kit: RuntimeKit) -> None:
        capacity = kit.open().capacity()
        assert capacity.cpu > 0
        assert capacity.memory_mb > 0
        assert capacity.gpu >= 0

    def test_it_says_why_it_cannot_run_a_service(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        assert runtime.refuses(kit.launch().spec) is None
        either = [runtime.refuses(ServiceSpec(image="x")), runtime.refuses(ServiceSpec(entrypoint="x"))]
        assert any(reason for reason in either)

    def test_an_empty_site_has_nothing(self, kit: RuntimeKit) -> None:
        assert kit.open().observe() == {}

    def test_a_run_gets_ready_and_says_where_it_listens(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        runtime.start(kit.launch())
        seen = kit.until(runtime, Phase.RUNNING)
        assert seen.attempt == 1
        assert seen.host
        assert seen.port in range(1, 65_536)
        assert seen.exit_status is None
        assert seen.memory_bytes is None or seen.memory_bytes > 0
        assert seen.cpu_s is None or seen.cpu_s >= 0

    def test_starting_the_same_attempt_again_changes_nothing(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        runtime.start(kit.launch())
        before = kit.until(runtime, Phase.RUNNING)
        runtime.start(kit.launch())
        after = kit.until(runtime, Phase.RUNNING)
        assert (after.attempt, after.port) == (before.attempt, before.port)
        assert runtime.logs("i1", 100).count("run 1") == 1

    def test_two_instances_do_not_meddle(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        runtime.start(kit.launch("i1"))
        runtime.start(kit.launch("i2"))
        first, second = kit.until(runtime, Phase.RUNNING, "i1"), kit.until(runtime, Phase.RUNNING, "i2")
        assert (first.host, first.port) != (second.host, second.port)
        runtime.stop("i1", force=True)
        kit.until(runtime, Phase.EXITED, "i1")
        assert runtime.observe()["i2"].phase is Phase.RUNNING

    def test_a_run_ends_when_it_is_asked_to_also_when_asked_again(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        runtime.start(kit.launch())
        kit.until(runtime, Phase.RUNNING)
        for _ in range(3):
            runtime.stop("i1", force=False)
        seen = kit.until(runtime, Phase.EXITED)
        assert seen.exit_status in (0, None)
        runtime.stop("i1", force=False)
        runtime.stop("i1", force=True)
        assert kit.until(runtime, Phase.EXITED) == seen

    def test_a_stubborn_run_ends_by_force_only(self, kit: RuntimeKit) -> None:
        runtime = kit.open("stubborn")
        runtime.start(kit.launch(behaviour="stubborn"))
        kit.until(runtime, Phase.RUNNING)
        runtime.stop("i1", force=False)
        assert runtime.observe()["i1"].phase is Phase.RUNNING
        runtime.stop("i1", force=True)
        seen = kit.until(runtime, Phase.EXITED)
        assert seen.exit_status is None or seen.exit_status != 0

    def test_a_run_that_ends_by_itself_says_how(self, kit: RuntimeKit) -> None:
        runtime = kit.open("crashing")
        runtime.start(kit.launch(behaviour="crashing"))
        seen = kit.until(runtime, Phase.EXITED)
        assert seen.exit_status in (1, None)
        assert seen.last_line == "boom"
        assert "boom" in runtime.logs("i1", 10)

    def test_an_ended_run_is_seen_until_it_is_removed(self, kit: RuntimeKit) -> None:
        runtime = kit.open("crashing")
        runtime.start(kit.launch(behaviour="crashing"))
        seen = kit.until(runtime, Phase.EXITED)
        assert [runtime.observe()["i1"] for _ in range(3)] == [seen] * 3
        runtime.remove("i1")
        runtime.remove("i1")
        assert runtime.observe() == {}
        assert runtime.logs("i1", 10) == ""

    def test_some_are_looked_at_as_all_are(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        for instance in ("i1", "i2"):
            runtime.start(kit.launch(instance))
        for instance in ("i1", "i2"):
            kit.until(runtime, Phase.RUNNING, instance)
        seen = runtime.observe_some({"i2", "nobody"})
        assert list(seen) == ["i2"]
        assert (seen["i2"].phase, seen["i2"].port) == (Phase.RUNNING, runtime.observe()["i2"].port)
        assert runtime.observe_some(()) == {}
        runtime.stop("i2", force=True)
        deadline = time.monotonic() + kit.patience
        while runtime.observe_some(["i2"])["i2"].phase is not Phase.EXITED:
            assert time.monotonic() < deadline
            time.sleep(0.005)

    def test_the_next_attempt_takes_the_place_of_the_last_and_keeps_its_port_and_log(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        runtime.start(kit.launch(attempt=1))
        port = kit.until(runtime, Phase.RUNNING).port
        runtime.stop("i1", force=True)
        kit.until(runtime, Phase.EXITED)
        runtime.start(kit.launch(attempt=2))
        seen = kit.until(runtime, Phase.RUNNING)
        assert (seen.attempt, seen.port) == (2, port)
        assert "run 1" in runtime.logs("i1", 100)
        assert "run 2" in runtime.logs("i1", 100)
        assert "run 1" not in runtime.logs("i1", 1)

    def test_the_next_attempt_ends_what_is_left_of_the_last(self, kit: RuntimeKit) -> None:
        runtime = kit.open("stubborn")
        runtime.start(kit.launch(attempt=1, behaviour="stubborn"))
        kit.until(runtime, Phase.RUNNING)
        runtime.start(kit.launch(attempt=2, behaviour="stubborn"))
        assert kit.until(runtime, Phase.RUNNING).attempt == 2
        assert len(runtime.observe()) == 1

    def test_removing_ends_what_runs(self, kit: RuntimeKit) -> None:
        runtime = kit.open("stubborn")
        runtime.start(kit.launch(behaviour="stubborn"))
        kit.until(runtime, Phase.RUNNING)
        runtime.remove("i1")
        assert runtime.observe() == {}
        assert kit.open().observe() == {}

    def test_what_nobody_knows_is_no_error(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        runtime.stop("nobody", force=False)
        runtime.stop("nobody", force=True)
        runtime.remove("nobody")
        assert runtime.logs("nobody", 10) == ""

    def test_a_run_outlives_its_runtime_and_is_adopted_by_the_next(self, kit: RuntimeKit) -> None:
        first = kit.open()
        first.start(kit.launch())
        before = kit.until(first, Phase.RUNNING)
        first.close()
        second = kit.open()
        after = second.observe()["i1"]
        assert (after.attempt, after.phase, after.port) == (before.attempt, Phase.RUNNING, before.port)
        second.start(kit.launch())  # of the same attempt: nothing to do
        assert second.logs("i1", 100).count("run 1") == 1
        second.stop("i1", force=False)
        assert kit.until(second, Phase.EXITED).attempt == 1

    def test_an_end_is_remembered_by_the_next_runtime(self, kit: RuntimeKit) -> None:
        first = kit.open("crashing")
        first.start(kit.launch(behaviour="crashing"))
        kit.until(first, Phase.EXITED)
        first.close()
        seen = kit.open().observe()["i1"]
        assert (seen.attempt, seen.phase, seen.last_line) == (1, Phase.EXITED, "boom")

    def test_looking_changes_nothing(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        runtime.start(kit.launch())
        kit.until(runtime, Phase.RUNNING)
        looks = [runtime.observe()["i1"] for _ in range(5)]
        assert {(look.phase, look.port, look.attempt) for look in looks} == {(Phase.RUNNING, looks[0].port, 1)}

    @pytest.mark.parametrize("force", [False, True])
    def test_stopping_what_is_not_ready_yet(self, kit: RuntimeKit, force: bool) -> None:
        runtime = kit.open()
        runtime.start(kit.launch())
        runtime.stop("i1", force=force)
        kit.until(runtime, Phase.EXITED)

    def test_tidying_is_always_possible(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        runtime.tidy()
        runtime.start(kit.launch())
        runtime.tidy()
        kit.until(runtime, Phase.RUNNING)

    def test_what_a_run_reports_is_seen_and_the_next_run_begins_anew(self, kit: RuntimeKit) -> None:
        if not kit.reads_reports:
            pytest.skip("this runtime reads no reports")
        runtime = kit.open()
        for attempt in (1, 2):
            runtime.start(kit.launch(attempt=attempt))
            deadline = time.monotonic() + kit.patience
            while not (seen := kit.until(runtime, Phase.RUNNING)).reports:
                assert time.monotonic() < deadline, seen
                runtime.tidy()
                time.sleep(0.05)
            assert [(r.number, r.code, r.message) for r in seen.reports] == [(1, "said", f"run {attempt} is up")]

    def test_what_a_run_may_take_is_changed_while_it_runs_or_refused_as_told(self, kit: RuntimeKit) -> None:
        runtime = kit.open()
        launch = kit.launch()
        runtime.start(launch)
        before = kit.until(runtime, Phase.RUNNING)
        has = launch.spec.needs
        larger, keeps = launch.spec.sized(2 * has.cpu, 2 * has.memory_mb), runtime.keeps_size(launch.spec)
        if keeps:
            with pytest.raises(RuntimeFailure):
                runtime.resize("i1", 1, larger)
            return
        assert not runtime.resize("i1", 2, larger), "of another run"
        assert not runtime.resize("nobody", 1, larger)
        for spec in (larger, larger, launch.spec, launch.spec):
            deadline = time.monotonic() + kit.patience
            while not runtime.resize("i1", 1, spec):
                assert time.monotonic() < deadline
                time.sleep(0.01)
        after = kit.until(runtime, Phase.RUNNING)
        assert (after.attempt, after.port) == (before.attempt, before.port)
        assert runtime.logs("i1", 100).count("run 1") == 1
        assert kit.running() == 1


class TwoLeadersContract:
    """What a runtime must do for two orchestrators that both believe they lead: nothing twice, nothing lost."""

    def test_who_was_overtaken_is_refused_and_sees_what_the_other_does(self, kit: RuntimeKit) -> None:
        late, leader = kit.open(), kit.open()
        late.lead(1)
        late.start(kit.launch("i1"))
        kit.until(late, Phase.RUNNING)
        leader.lead(2)
        acts: list[Callable[[], None]] = [
            lambda: late.start(kit.launch("i1", attempt=2)),
            lambda: late.start(kit.launch("i2")),
            lambda: late.stop("i1", force=False),
            lambda: late.stop("i1", force=True),
            lambda: late.remove("i1"),
        ]
        for act in acts:
            with pytest.raises(OvertakenError, match="another orchestrator leads by now"):
                act()
        with suppress(OvertakenError):  # most have nothing to tidy
            late.tidy()
        assert kit.until(leader, Phase.RUNNING).attempt == 1
        assert (kit.running("i1"), kit.running("i2")) == (1, 0)
        leader.start(kit.launch("i2"))
        kit.until(leader, Phase.RUNNING, "i2")
        kit.until(late, Phase.RUNNING, "i2")
        leader.stop("i1", force=True)
        kit.until(late, Phase.EXITED)
        leader.remove("i1")
        kit.until_gone(late)

    def test_the_first_look_of_a_leader_finds_what_the_one_before_has_begun(self, kit: RuntimeKit) -> None:
        late, leader = kit.open(), kit.open()
        late.lead(1)
        leader.observe()
        late.start(kit.launch())
        kit.until(late, Phase.RUNNING)
        leader.lead(2)
        assert leader.observe()["i1"].attempt == 1, "what it did not see it would begin anew"

    def test_the_leader_of_the_latest_epoch_acts_whoever_it_is(self, kit: RuntimeKit) -> None:
        first, second = kit.open(), kit.open()
        first.lead(1)
        second.lead(2)
        second.lead(2)
        with pytest.raises(OvertakenError):
            first.lead(1)
        first.lead(3)
        first.start(kit.launch())
        kit.until(first, Phase.RUNNING)
        with pytest.raises(OvertakenError):
            second.remove("i1")
        with pytest.raises(OvertakenError):
            kit.open().lead(2)
        kit.open().remove("i1")  # by a tool, for no leader
        kit.until_gone(first)

    def test_what_the_last_leader_began_a_moment_before_is_not_begun_twice(self, kit: RuntimeKit) -> None:
        late, leader = kit.open(), kit.open()
        late.lead(1)
        late.start(kit.launch())
        leader.lead(2)
        leader.start(kit.launch())
        kit.until(leader, Phase.RUNNING)
        assert kit.running() == 1
        leader.remove("i1")
        kit.until_gone(late)
        assert kit.running() == 0

    def test_two_that_start_the_same_at_once_get_one(self, kit: RuntimeKit) -> None:
        both = kit.open(), kit.open()
        together = threading.Barrier(2)

        def start(runtime: Runtime) -> None:
            together.wait()
            runtime.start(kit.launch())

        threads = [threading.Thread(target=start, args=(runtime,)) for runtime in both]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for runtime in both:
            assert kit.until(runtime, Phase.RUNNING).attempt == 1
        assert kit.running() == 1

    def test_a_start_that_comes_after_the_instance_was_removed_begins_nothing(self, kit: RuntimeKit) -> None:
        late, leader = kit.open(), kit.open()
        late.lead(1)
        leader.lead(2)
        leader.start(kit.launch())
        kit.until(leader, Phase.RUNNING)
        leader.remove("i1")
        with pytest.raises(OvertakenError):
            late.start(kit.launch())
        kit.until_gone(leader)
        assert kit.running() == 0

    def test_a_later_run_is_neither_ended_nor_doubled_by_an_earlier_one(self, kit: RuntimeKit) -> None:
        late, leader = kit.open(), kit.open()
        late.start(kit.launch(attempt=1))
        kit.until(late, Phase.RUNNING)
        leader.start(kit.launch(attempt=2))
        port = kit.until(leader, Phase.RUNNING).port
        _until(lambda: late.observe()["i1"].attempt == 2)
        with pytest.raises(OvertakenError, match="attempt 2 of i1 runs"):
            late.start(kit.launch(attempt=1))
        seen = kit.until(late, Phase.RUNNING)
        assert (seen.attempt, seen.port, kit.running()) == (2, port, 1)

    def test_who_leads_again_goes_by_what_is_there_and_not_by_what_it_remembers(self, kit: RuntimeKit) -> None:
        first, second = kit.open(), kit.open()
        first.lead(1)
        for instance in ("removed", "anew", "stays"):
            first.start(kit.launch(instance))
        for instance in ("removed", "anew", "stays"):
            kit.until(first, Phase.RUNNING, instance)
        second.lead(2)
        for instance in ("removed", "anew", "stays"):
            kit.until(second, Phase.RUNNING, instance)
        second.remove("removed")
        second.start(kit.launch("anew", attempt=2))
        kit.until(second, Phase.RUNNING, "anew")
        first.lead(3)
        _until(lambda: {i: seen.attempt for i, seen in first.observe().items()} == {"anew": 2, "stays": 1})
        first.start(kit.launch("removed", attempt=2))
        kit.until(first, Phase.RUNNING, "removed")
        assert [kit.running(instance) for instance in ("removed", "anew", "stays")] == [1, 1, 1]


def _until(what: Callable[[], Any], patience: float = 30.0) -> None:
    deadline = time.monotonic() + patience
    while not what():
        assert time.monotonic() < deadline, f"it did not come to pass in {patience} s"
        time.sleep(0.01)
