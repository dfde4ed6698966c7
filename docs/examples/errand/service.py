"""Drives straight on to where a client of move_base wants it."""

from skytether.messages import (
    MoveBase,
    MoveBaseFeedback,
    MoveBaseGoal,
    MoveBaseResult,
    Odometry,
    PoseStamped,
    Twist,
    Vector3,
)
from skytether.service import Action, Goal, Input, NoParams, Output, Service


class Errand(Service[NoParams]):
    """One goal at a time; a newer one takes its place."""

    rate_hz = 10.0

    odom = Input(Odometry)
    cmd_vel = Output(Twist)
    move_base = Action(MoveBase)

    goal: Goal[MoveBaseGoal, MoveBaseResult, MoveBaseFeedback] | None = None

    def step(self, now: float) -> None:
        while new := self.move_base.take():
            if new.message.target_pose.header.frame_id != "odom":
                new.reject("a goal is wanted in the frame odom")
                continue
            if self.goal is not None:
                self.goal.cancel(text="a newer goal has come")
            new.accept()
            self.goal = new
        speed = self.drive() if self.goal is not None else 0.0
        self.cmd_vel.publish(Twist(Vector3(x=speed)))

    def drive(self) -> float:
        goal, odom = self.goal, self.odom.latest
        if goal.cancel_requested:
            goal.cancel(text="as you wish")
            self.goal = None
        elif odom is not None:
            here = odom.message.pose.pose
            left = goal.message.target_pose.pose.position.x - here.position.x
            if left > 0.05:
                goal.feedback(MoveBaseFeedback(PoseStamped(odom.message.header, here)))
                return min(left, 0.2)
            goal.succeed()
            self.goal = None
        return 0.0
