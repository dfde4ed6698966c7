"""How `make test` runs the slow tests: which ones side by side, which ones first, and which ones may be run again."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

import pytest

_TESTS = Path(__file__).parents[1]

TOGETHER = (
    "api/test_bounded.py",
    "bridge/test_mtu.py",
    "bridge/test_nat.py",
    "cli/commands/bridge/test_bridge.py",
    "cli/commands/robot/test_commission.py",
    "cli/test_names.py",
    "cli/test_lazy.py",
    "cli/commands/test_doctor.py",
    "cli/commands/test_group.py",
    "cli/commands/robot/test_never_wait.py",
    "cli/commands/test_relay.py",
    "cli/commands/test_nouns.py",
    "cli/commands/site/test_machine.py",
    "cli/commands/robot/test_gate_process.py",
    "contracts/",
    "e2e/test_compose.py",
    "e2e/test_demo.py::test_demo_prints_one_json_object",
    "e2e/test_navigation_guide.py",
    "e2e/test_replay.py",
    "e2e/test_rolling_nodes.py",
    "jepsen/",
    "lab/test_bench_api.py",
    "lab/test_bench_bridge.py",
    "lab/test_bench_bridge_ros2.py",
    "lab/test_bench_failover.py",
    "lab/test_bench_face.py",
    "lab/test_bench_fleet.py",
    "lab/test_bench_legs.py",
    "lab/test_bench_mapping.py",
    "lab/test_bench_migrate.py",
    "lab/test_bench_resize.py",
    "lab/test_bench_ros.py",
    "lab/test_bench_safety.py",
    "lab/test_bench_scale.py",
    "lab/test_bench_join.py",
    "lab/test_bench_start.py",
    "lab/test_embedded.py",
    "lab/test_follow_in_front.py",
    "lab/test_nine_goals.py",
    "lab/test_person.py",
    "lab/test_walk.py",
    "lab/world/",
    "orchestrator/test_backup.py",
    "orchestrator/runtimes/test_confinement.py",
    "orchestrator/test_crowd.py",
    "orchestrator/test_disk_full.py",
    "orchestrator/runtimes/docker/test_runtime.py",
    "orchestrator/domain/test_clock_jump.py",
    "orchestrator/http/test_api.py",
    "orchestrator/runtimes/docker/test_docker_resize.py",
    "orchestrator/runtimes/docker/test_fence.py",
    "orchestrator/runtimes/docker/test_namespaces.py",
    "orchestrator/runtimes/docker/test_docker_orchestrated.py",
    "orchestrator/nodes/test_nodes_attacks.py",
    "orchestrator/nodes/test_nodes_docker.py",
    "orchestrator/nodes/test_nodes_replicas.py",
    "orchestrator/test_faults.py",
    "orchestrator/test_faults_engine.py",
    "orchestrator/runtimes/test_file_log.py",
    "orchestrator/test_follow_image.py",
    "orchestrator/groups/test_group_end.py",
    "orchestrator/groups/test_group_joins.py",
    "orchestrator/groups/test_groups_docker.py",
    "orchestrator/test_image_push.py",
    "orchestrator/test_images.py",
    "orchestrator/runtimes/kubernetes/test_pace.py",
    "orchestrator/runtimes/kubernetes/test_kubernetes_storm.py",
    "orchestrator/runtimes/test_left_behind.py",
    "orchestrator/store/test_migrations.py",
    "orchestrator/scheduling/test_successors.py",
    "orchestrator/test_navigation_image.py",
    "orchestrator/http/test_openapi.py",
    "orchestrator/scheduling/test_plan.py",
    "orchestrator/runtimes/test_process.py",
    "orchestrator/runtimes/test_process_fence.py",
    "orchestrator/scheduling/test_reconcile.py",
    "orchestrator/test_rolling.py",
    "orchestrator/test_replicas.py",
    "orchestrator/groups/test_scaler.py",
    "orchestrator/http/test_server.py",
    "orchestrator/telemetry/test_heartbeat.py",
    "orchestrator/telemetry/test_service_events.py",
    "orchestrator/store/test_store.py",
    "orchestrator/telemetry/test_tls_and_logs.py",
    "robot/graphs/test_registry.py",
    "robot/safety/geometry/test_footprint.py",
    "robot/safety/gate/test_gate_loop.py",
    "robot/safety/rules/test_rules.py",
    "robot/safety/sensing/test_sensing.py",
    "robot/safety/geometry/test_stopping.py",
    "robot/control/test_failure_detector.py",
    "robot/control/test_arbiter.py",
    "robot/graphs/ros2/",
    "robot/agent/test_agent_survives.py",
    "robot/agent/test_status.py",
    "robot/control/test_supervisor.py",
    "robot/offload/test_task_manager.py",
    "ros/ros1/",
    "ros/ros2/test_console.py",
    "ros/ros2/test_display.py",
    "ros/ros2/test_gate.py",
    "ros/ros2/native/",
    "ros/ros2/test_navigation_action.py",
    "ros/ros2/test_node.py",
    "ros/ros2/test_own_gate.py",
    "ros/ros2/test_parameters.py",
    "ros/ros2/test_port.py",
    "ros/ros2/test_robot_run.py",
    "service/test_actions_live.py",
    "service/test_calls.py",
    "services/",
    "terraform/",
    "wire/",
)
"""Where slow tests bear company: their time is made up, or they wait for what they expect, however long it takes."""

LONGEST = (
    "e2e/test_navigation_guide.py",
    "orchestrator/test_faults_engine.py",
    "ros/ros2/native/test_walk.py",
    "e2e/test_compose.py",
    "jepsen/test_short.py",
    "ros/ros2/native/test_robot_run.py",
    "orchestrator/test_navigation_image.py",
    "e2e/test_rolling_nodes.py",
    "lab/test_nine_goals.py",
    "orchestrator/runtimes/docker/test_fence.py",
    "orchestrator/runtimes/docker/test_runtime.py",
    "lab/test_bench_safety.py",
    "contracts/test_runtime_contract.py",
    "contracts/test_two_leaders.py",
    "ros/ros1/test_service_container.py",
    "lab/test_bench_bridge.py",
    "orchestrator/runtimes/docker/test_docker_resize.py",
    "ros/ros2/native/test_service_container.py",
    "lab/test_bench_mapping.py",
    "orchestrator/groups/test_scaler.py",
    "orchestrator/test_follow_image.py",
    "ros/ros2/native/test_node.py",
    "cli/commands/robot/test_commission.py",
    "robot/safety/gate/test_guard_processes.py",
    "robot/safety/gate/test_processes.py",
)
"""The files of a minute and more: they begin first, so that at the end nobody waits for one of them."""

ALONE = (
    "orchestrator/http/test_server.py::test_a_killed_orchestrator_comes_back",
    "orchestrator/http/test_server.py::test_a_killed_service_is_seen_within_a_second",
    "orchestrator/http/test_server.py::test_at_shutdown_what_was_asked",
    "orchestrator/http/test_server.py::test_killed_in_the_middle_of_starting",
    "orchestrator/http/test_server.py::test_watchers_do_not_hold_up_the_end",
    "ros/ros2/native/test_walk.py",
)
"""Among those the ones that look at the clock."""

CLUSTER_LONGEST = (
    "test_a_release_drives_robots",
    "test_eviction_a_kill_in_mid_start",
    "test_two_orchestrators_over_postgresql",
    "test_an_api_server_that_stands_still",
    "test_a_standby_is_given_out",
)
"""Of those with a cluster the ones that take half a minute and more: several processes share them, and begin with them,
or the end of the row would be a wait for one."""

RERUN = {
    "bridge/test_clock.py": "measures one-way delays to a millisecond, on cores that others use too",
    "lab/test_bench_failover.py": "judges a cut to within three periods of the commands",
    "lab/test_bench_safety.py": "judges each velocity that the wheels are told by the moment it was told",
    "lab/test_handover.py": "judges the time without commands at a hand-over",
    "lab/test_tun.py": "judges the emulated delays of packets by the clock",
    "orchestrator/test_hostile.py": "judges how quick others' renewals are beside an attacker who takes a core",
    "orchestrator/http/test_server.py": "judges how soon a killed program is back",
    "robot/safety/gate/test_cloud_processes.py": "as test_guard_processes.py",
    "robot/safety/gate/test_cut_network.py": "as test_guard_processes.py",
    "robot/safety/gate/test_guard_processes.py": "judges each velocity of the wheels by the moment it was told",
    "robot/safety/gate/test_processes.py": "as test_guard_processes.py",
    "robot/safety/gate/test_sensing_processes.py": "as test_guard_processes.py",
    "robot/agent/test_agent_live.py": "judges how soon a silent service is noticed",
    "service/test_process.py": "judges the periods of a service's loop",
}
"""The only tests that may be run again when they fail, and why: they judge moments to some 10 ms, and the machine may
be taken for longer by somebody else. What fails anywhere else is a finding: the product is wrong, or the test."""


def arrange(items: list[pytest.Item]) -> None:
    """Mark what runs beside others, and what may be run again; the longest files come first.

    Raises:
        UsageError: A test asks by itself to be run again.
    """
    for path, ours in groupby(items, key=lambda item: item.path):
        if not path.is_relative_to(_TESTS):
            continue
        file = path.relative_to(_TESTS).as_posix()
        for item in ours:
            name = f"{file}::{item.name}"
            if name.startswith(TOGETHER) and not name.startswith(ALONE):
                item.add_marker(pytest.mark.together)
            if item.get_closest_marker("flaky"):
                raise pytest.UsageError(
                    f"{name}: what may be run again stands in RERUN in tests/support/slow_tests.py, with why"
                )
            if item.get_closest_marker("slow") and name.startswith(tuple(RERUN)):
                item.add_marker(pytest.mark.flaky(reruns=2, reruns_delay=3))
    rank = {_TESTS / file: number for number, file in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))
    _order(items)


def _order(items: list[pytest.Item]) -> None:
    """Of what needs a cluster first what takes longest, each with another, for a process is given two at a time; what
    wants to be alone last."""
    ours = [item for item in items if item.get_closest_marker("kubernetes")]
    ours.sort(key=lambda item: item.get_closest_marker("whole_cluster") is not None)
    longest = [item for name in CLUSTER_LONGEST for item in ours if item.name.startswith(name)]
    others = [item for item in ours if item not in longest]
    pairs = [item for pair in zip(longest, others, strict=False) for item in pair]
    rest = [item for item in (*longest, *others) if item not in pairs]
    items[:] = [item for item in items if not item.get_closest_marker("kubernetes")] + pairs + rest
