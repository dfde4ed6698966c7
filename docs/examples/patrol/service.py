"""Turns on the spot unless told to pause, once it knows the robot's map."""

from concurrent.futures import Future

from skytether.messages import (
    GetMap,
    GetMapRequest,
    GetMapResponse,
    OccupancyGrid,
    SetBool,
    SetBoolRequest,
    SetBoolResponse,
    Twist,
    Vector3,
)
from skytether.service import Call, CallError, NoParams, Output, Service, answers


class Patrol(Service[NoParams]):
    """Two calls: one that the robot makes, one that the service makes."""

    rate_hz = 10.0

    cmd_vel = Output(Twist)
    get_map = Call(GetMap)

    paused = False
    map: OccupancyGrid | None = None
    asked: Future[GetMapResponse] | None = None

    @answers(SetBool)
    def pause(self, request: SetBoolRequest) -> SetBoolResponse:
        if self.map is None:
            raise CallError("nothing to pause: the map is not known yet")
        self.paused = request.data
        return SetBoolResponse(success=True)

    def step(self, now: float) -> None:
        if self.map is None:
            self.learn_map()
        else:
            self.cmd_vel.publish(Twist(angular=Vector3(z=0.0 if self.paused else 0.5)))

    def learn_map(self) -> None:
        if self.asked is None:
            self.asked = self.get_map.ask(GetMapRequest(), timeout=2.0)
        elif self.asked.done():
            try:
                self.map = self.asked.result().map
            except CallError as error:
                self.log.warning("no map, asking again: %s", error)
                self.asked = None
