"""A robot whose output goes into a pipe that is full and that nobody reads: it hands over all the same."""

import signal

import psutil
import pytest
from ros1_graph import wait_for

pytestmark = [pytest.mark.ros1, pytest.mark.slow]


def service_process(folder):
    """The instance that the orchestrator runs."""
    for process in psutil.process_iter(["environ"]):
        if str(folder) in (process.info["environ"] or {}).get("SKYTETHER_GRANT", ""):
            return process
    return None


def test_a_log_that_nobody_reads_delays_no_hand_over(graph, config, walker, tmp_path, full_pipe):
    process = graph.skytether("robot", "run", str(config), stdout=full_pipe, stderr=full_pipe)
    for _ in range(3):
        wait_for(lambda: walker.speed and walker.speed > 0.15, "the service to drive")
        service = wait_for(lambda: service_process(tmp_path), "the service's process")
        service.suspend()
        wait_for(lambda: walker.speed == 0.0, "the hand-over")
        before = len(walker.told)
        wait_for(lambda before=before: len(walker.told) > before + 20, "the control loop to go on")
        service.resume()
    wait_for(lambda: walker.speed and walker.speed > 0.15, "the service to drive again")
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 128 + signal.SIGINT
    wait_for(lambda: walker.speed == 0.0, "the last standstill")
    wait_for(lambda: graph.publishers("/cmd_vel") == [], "the node to be gone from the graph")
