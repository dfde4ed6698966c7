"""The shell of navigation: topics and calls in, `Navigator`, topics out."""

from __future__ import annotations

import json
import math
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from skytether.control.admittance import Velocity
from skytether.messages import (
    LaserScan,
    MoveBase,
    NavigateThroughPoses,
    NavigateToPose,
    OccupancyGrid,
    Odometry,
    PoseArray,
    PoseStamped,
    PoseWithCovarianceStamped,
    SetBool,
    SetBoolRequest,
    SetBoolResponse,
    String,
    TFMessage,
    Trigger,
    TriggerRequest,
    TriggerResponse,
    Twist,
    Vector3,
)
from skytether.messages import Path as PathMessage
from skytether.service import Action, ConfigError, Input, Lasting, MeanDelay, Output, Rate, Received, Service, answers
from skytether_services.planar.frames import MOST_BYTES, Frames

from . import conversions as convert
from .action_goals import ActionGoals
from .grid_map import GridMap, MapError, load_map
from .navigator import Navigator, Report
from .params import ModeName, Params
from .senses import LaserScan as Scan
from .senses import Senses
from .shared_word import read_said
from .status import Code, State, Trouble
from .surroundings import mask_of
from .zones import Mask

if TYPE_CHECKING:
    from .mapping_mode import MappingMode

_LASTS = 1.0
"""What lasts for so long [s] is reported; an end is at once."""
_TELLS = 1.0
"""How often the group is told what this robot sees [Hz]: as often as its agent brings what the others do."""
PARTICLES = 200
"""Shown of all."""


class Navigation(Service[Params]):
    """Drives a robot to goals on a map."""

    tf = Input(TFMessage, max_bytes=MOST_BYTES)
    odom = Input(Odometry)
    scan = Input(LaserScan)
    map = Input(OccupancyGrid)
    initialpose = Input(PoseWithCovarianceStamped)
    goal = Input(PoseStamped)
    goals = Input(PathMessage)
    obstacles_shared = Input(String)

    move_base = Action(MoveBase)
    navigate_to_pose = Action(NavigateToPose)
    navigate_through_poses = Action(NavigateThroughPoses)

    cmd_vel = Output(Twist)
    status = Output(String)
    plan = Output(PathMessage)
    pose = Output(PoseWithCovarianceStamped)
    particle_cloud = Output(PoseArray)
    local_costmap = Output(OccupancyGrid)
    global_costmap = Output(OccupancyGrid)
    new_map = Output(OccupancyGrid)
    obstacles_seen = Output(String)

    def start(self) -> None:
        params = self.params
        try:
            self.navigator = navigator = Navigator(params)
            self._mapping = self._mapping_mode() if params.mode is ModeName.MAP else None
        except ValueError as error:
            raise ConfigError(str(error)) from error
        self._clients = ActionGoals(self.actions, params.limits.max_linear, self.report)
        rates = params.rates
        self.rate_hz = rates.control
        self._due = {
            "status": Rate(rates.publish_status),
            "particles": Rate(rates.publish_particles),
            "local": Rate(rates.publish_local_costmap),
            "global": Rate(rates.publish_global_costmap),
            "word": Rate(_TELLS),
        }
        self._frames = Frames()
        self._odom_frame, self._base_frame = "odom", "base_link"
        self._delay = MeanDelay()
        self._stamp = 0.0
        self._told: tuple[object, ...] = ()
        self._lasting = Lasting((State.WAITING, str(Code.OK), None))
        self._shown_path: object = None
        self._shown_estimate: object = None
        self._shown_map: object = None
        if self._mapping is not None:
            return
        if params.start is not None:
            navigator.place(params.start.pose)
        if params.map:
            self._load(params.map)
        if params.goals:
            goals = [goal.pose for goal in params.goals]
            navigator.go(goals, rounds=params.rounds, stop_at_each=params.stop_at_each)

    def _mapping_mode(self) -> MappingMode:
        # Loads SciPy: a third of what a service that only drives would have to load.
        from .mapping_mode import MappingMode

        return MappingMode(self.params, self.context.data_dir, self.executor())

    def executor(self) -> Executor:
        """Does what would hold up the loop in the mode that maps."""
        return ThreadPoolExecutor(1, thread_name_prefix="mapping")

    def step(self, now: float) -> None:
        if self._mapping is not None:
            # No velocity, not even zero: whoever drives the robot when no service does, drives it.
            self._clients.refuse("A map is being built: the robot takes no goals.")
            self._sense(self._mapping.senses)
            self._mapping.step(now)
            self._publish_mapping(self._mapping, now)
            return
        self._sense(self.navigator.whereabouts)
        self._listen()
        if heard := self.obstacles_shared.take():
            late = max(0.0, heard.age(now))
            said = [replace(one, age=one.age + late) for one in read_said(heard.message.data)]
            self.navigator.receive(now, said)
        self._clients.listen(self.navigator, now)
        velocity = self.navigator.step(now, self._delay.seconds)
        self.cmd_vel.publish(Twist(Vector3(x=velocity.linear), Vector3(z=velocity.angular)))
        self._publish(now)
        self._clients.update_client(self.navigator, now, self._stamp)

    @answers(Trigger)
    def cancel(self, request: TriggerRequest) -> TriggerResponse:
        """Stand, and forget the goals."""
        del request
        done = self.navigator.cancel()
        return TriggerResponse(done, "The goals were called off." if done else "There are no goals to call off.")

    @answers(SetBool)
    def pause(self, request: SetBoolRequest) -> SetBoolResponse:
        """Stand until told to go on."""
        if not self.navigator.pause(request.data):
            return SetBoolResponse(False, "There are no goals that the robot is on its way to.")
        return SetBoolResponse(True, "The robot waits." if request.data else "The robot goes on.")

    @answers(Trigger)
    def clear_costmaps(self, request: TriggerRequest) -> TriggerResponse:
        """Forget what the laser saw."""
        del request
        self.navigator.clear(whole=True, near=True)
        return TriggerResponse(True, "What is still there is seen again.")

    @answers(Trigger)
    def save_map(self, request: TriggerRequest) -> TriggerResponse:
        """Save the map that is being built, and say where."""
        del request
        if self._mapping is None:
            return TriggerResponse(False, "No map is being built: the parameter mode is 'navigate'.")
        return TriggerResponse(*self._mapping.save())

    def stop(self) -> None:
        """Save the map."""
        if self._mapping is not None:
            done, text = self._mapping.close()
            self.report("map_saved" if done else str(Code.NOT_SAVED), text)

    def _sense(self, senses: Senses) -> None:
        """Hand what the robot measured on."""
        if tf := self.tf.take():
            self._frames.set_transforms(tf.message)
            self._delay.note(tf)
            if (found := self._frames.lookup(self._odom_frame, self._base_frame)) and math.isfinite(found[1]):
                senses.odometry(found[1], found[0], tf.sent_at)
                self._stamp = found[1]
        if odom := self.odom.take():
            message = odom.message
            self._delay.note(odom)
            self._odom_frame = message.header.frame_id or self._odom_frame
            self._base_frame = message.child_frame_id or self._base_frame
            twist = message.twist.twist
            velocity = Velocity(twist.linear.x, twist.angular.z)
            stamp = message.header.stamp.seconds()
            senses.odometry(stamp, convert.pose_of(message.pose.pose), odom.sent_at, velocity)
        if scan := self.scan.take():
            self._delay.note(scan)
            self._see(scan, senses)

    def _listen(self) -> None:
        """Hand what people ask for on to the navigator."""
        navigator = self.navigator
        if map_ := self.map.take():
            self._use(convert.grid_of(map_.message), "the topic map")
        if first := self.initialpose.take():
            pose, deviation, turn = convert.first_pose(first.message)
            navigator.place(pose, deviation, turn)
        if (goal := self.goal.take()) and self._is_on_map(goal.message.header.frame_id):
            navigator.go([convert.pose_of(goal.message.pose)])
        if goals := self.goals.take():
            frames = {goals.message.header.frame_id, *(pose.header.frame_id for pose in goals.message.poses)}
            if all(self._is_on_map(frame) for frame in frames):
                poses = [convert.pose_of(pose.pose) for pose in goals.message.poses]
                navigator.go(poses, rounds=self.params.rounds, stop_at_each=self.params.stop_at_each)

    def _see(self, received: Received[LaserScan], senses: Senses) -> None:
        scan = received.message
        laser = self.params.sensors.laser
        found = self._frames.lookup(self._base_frame, scan.header.frame_id) if laser is None else (laser.pose, 0.0)
        senses.laser_frame = None if found else scan.header.frame_id
        if found is None:
            return
        senses.scan(
            Scan(
                scan.header.stamp.seconds(),
                received.sent_at,
                scan.ranges,
                scan.angle_min,
                scan.angle_increment,
                scan.range_min,
                scan.range_max,
                found[0],
            )
        )

    def _is_on_map(self, frame: str) -> bool:
        if convert.is_map(frame):
            return True
        self.navigator.refuse(Trouble(Code.BAD_GOAL, convert.other_frame(frame)))
        return False

    def _load(self, name: str) -> None:
        """The map of a file. A broken one is told; another may come by topic."""
        try:
            self._use(load_map(self.context.data_dir / name), name)
        except MapError as error:
            self.navigator.no_map = Trouble(Code.MAP_BROKEN, f"The map cannot be used: {error}")

    def _use(self, grid: GridMap | None, source: str) -> None:
        try:
            if grid is None:
                raise MapError("its size does not fit its cells")
            self.navigator.use_map(grid, self._mask(self.params.keep_out), self._mask(self.params.speed_zones))
        except ValueError as error:  # a MapError is one
            self.navigator.no_map = Trouble(Code.MAP_BROKEN, f"The map of {source} cannot be used: {error}")

    def _mask(self, name: str) -> Mask | None:
        return mask_of(load_map(self.context.data_dir / name)) if name else None

    def _report(self, now: float, report: Report) -> None:
        """Make an event of what lasts, or is an end. That there is no goal yet is none."""
        is_end = report.doing in (State.SUCCEEDED, State.FAILED, State.CANCELED)
        new = (report.doing, report.code, report.task, *([report.message] if is_end else []))
        if self._lasting.due(new, now, 0.0 if is_end else _LASTS):
            self.report(report.code if report.trouble is not None else str(report.doing), report.message)

    def _publish(self, now: float) -> None:
        """Publish what people and programs want to see."""
        navigator = self.navigator
        report = navigator.report()
        self._report(now, report)
        told = (report.doing, report.code, report.task)
        if told != self._told or self._due["status"].due(now):
            self._told = told
            around = navigator.surroundings
            neighbours = around.neighbours.names(now) if around is not None else {}
            self.status.publish(String(json.dumps(convert.document(report, navigator.whereabouts, neighbours))))
        if navigator.path is not self._shown_path:
            self._shown_path = navigator.path
            self.plan.publish(convert.path_message(navigator.path, self._stamp))
        estimate = navigator.whereabouts.estimate
        if estimate is not None and estimate is not self._shown_estimate:
            self._shown_estimate = estimate
            self.pose.publish(convert.pose_message(estimate.pose, estimate.covariance, self._stamp))
        particles = navigator.whereabouts.particles
        if len(particles) and self._due["particles"].due(now):
            shown = particles[np.linspace(0, len(particles) - 1, min(len(particles), PARTICLES)).astype(int)]
            self.particle_cloud.publish(convert.particles_message(shown, self._stamp))
        if self._due["word"].due(now) and (word := navigator.word(now)) is not None:
            self.obstacles_seen.publish(String(word))
        surroundings = navigator.surroundings
        if surroundings is not None:
            if surroundings.near is not None and self._due["local"].due(now):
                self.local_costmap.publish(convert.costmap_message(surroundings.near, self._stamp))
            if surroundings.whole is not None and self._due["global"].due(now):
                self.global_costmap.publish(convert.costmap_message(surroundings.whole, self._stamp))

    def _publish_mapping(self, mapping: MappingMode, now: float) -> None:
        """Likewise, of the mode that maps."""
        trouble = mapping.trouble(now)
        message = trouble.message if trouble is not None else "A map is built of what the laser sees."
        report = Report(State.MAPPING, trouble, message, None, "", 0, math.nan)
        self._report(now, report)
        if report.code not in self._told or self._due["status"].due(now):
            self._told = (report.code,)
            self.status.publish(String(json.dumps(convert.mapping_document(report, mapping))))
        if mapping.progress is not self._shown_estimate and (pose := mapping.pose()) is not None:
            self._shown_estimate = mapping.progress
            self.pose.publish(convert.pose_message(np.array(pose), np.zeros((3, 3)), self._stamp))
        if mapping.new_map is not None and mapping.new_map is not self._shown_map:
            self._shown_map = mapping.new_map
            self.new_map.publish(convert.map_message(mapping.new_map, self._stamp))
