"""Pictures of the simulated world, as a robot's camera takes them: rendered without a display, coded as JPEG.

A picture takes longer than a tick of the control loop, and what draws belongs to one thread: so `Camera` has its own,
with its own copy of the world's state. What it cannot draw in time it leaves out. MuJoCo lets go of Python's lock while
it draws. `FaceStudio` draws heads in one's own thread, one by one, for what judges the eyes for faces.
"""

from __future__ import annotations

import ctypes.util
import io
import math
import os
import threading
import time
from collections.abc import Callable, Sequence
from types import ModuleType, TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from skytether.lab.trail import Pose
from skytether.messages import CompressedImage, Header, Message

from .model import LEGS, WorldError, compile_model, load_mujoco
from .operator import NAME as OPERATOR
from .people import HIP
from .plan import Plan, hall
from .robot import RearParams, RobotParams
from .simulation import CAMERA, TICK, Readings, Simulation, State

Picture = NDArray[np.uint8]
"""Rows from above, shape (height, width, 3): red, green, blue."""

QUALITY = 85
"""Of JPEG; with the noise a picture has the 47 kB of table 2 of the thesis."""
NOISE = 4.0
"""Standard deviation of the sensor's noise, of 255."""
_NOISES = 8
"""So many pictures of noise are drawn in advance; each picture gets one of them, moved."""
_GEOMS = 500
_START_S = 30.0
"""A machine that is busy compiles slowly."""


class Sensor:
    """What becomes of a picture in the camera: noise, and a JPEG file."""

    def __init__(self, rear: RearParams, seed: int, *, noise: float = NOISE, quality: int = QUALITY) -> None:
        self._random = np.random.default_rng(seed)
        shape = (_NOISES, rear.height, rear.width, 1)
        self._noises = np.rint(noise * self._random.standard_normal(shape, np.float32)).astype(np.int16)
        self._quality = quality

    def noisy(self, picture: Picture) -> Picture:
        """The same as the sensor sees it."""
        which, down, right = (int(v) for v in self._random.integers(0, (_NOISES, *picture.shape[:2])))
        noise = np.roll(self._noises[which], (down, right), (0, 1))
        noisy: Picture = np.clip(picture + noise, 0, 255).astype(np.uint8)
        return noisy

    def jpeg(self, picture: Picture) -> bytes:
        """As a file."""
        file = io.BytesIO()
        Image.fromarray(picture).save(file, format="JPEG", quality=self._quality)
        return file.getvalue()


class Renderer:
    """Draws what one robot's camera sees. To be made, used and closed in one thread.

    Raises:
        WorldError: There is no OpenGL that draws without a display.
    """

    def __init__(self, model: Any, rear: RearParams, robot: int = 0) -> None:
        self._mujoco = mujoco = load_mujoco()
        self._model = model
        self._context = _gl().GLContext(rear.width, rear.height)
        self._context.make_current()
        self._drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawing)
        self._scene = mujoco.MjvScene(model, maxgeom=_GEOMS)
        # Both would take three times as long.
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = model.camera(f"robot-{robot}-camera").id
        self._rect = mujoco.MjrRect(0, 0, rear.width, rear.height)
        self._pixels = np.empty((rear.height, rear.width, 3), np.uint8)

    def draw(self, data: Any) -> Picture:
        """What the camera sees of the world in this state (``MjData``), without noise."""
        mujoco = self._mujoco
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_camlight(self._model, data)
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, every, self._scene)
        mujoco.mjr_render(self._rect, self._scene, self._drawing)
        mujoco.mjr_readPixels(self._pixels, None, self._rect, self._drawing)
        return self._pixels[::-1].copy()

    def close(self) -> None:
        """Give everything back."""
        self._drawing.free()
        self._context.free()


def _gl() -> ModuleType:
    """What MuJoCo brings for one of the two ways to draw without a display; ``MUJOCO_GL`` says which, if it is set."""
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    ways = [asked] if asked in ("osmesa", "egl") else ["osmesa", "egl"]
    libraries = {"osmesa": "OSMesa", "egl": "EGL"}
    # Tried one after the other they would be in each other's way: PyOpenGL decides once in a process.
    way = next((way for way in ways if ctypes.util.find_library(libraries[way]) is not None), None)
    why = f"there is no library for {' or '.join(ways)}"
    if way is not None:
        try:
            if way == "egl":
                from mujoco import egl

                return egl  # type: ignore[no-any-return]
            from mujoco import osmesa

            return osmesa  # type: ignore[no-any-return]
        except (ImportError, AttributeError, RuntimeError) as error:
            why = f"{way} does not work: {error}"
    raise WorldError(
        f"a camera needs OpenGL that draws without a display, and {why}; on Debian: apt-get install libosmesa6"
    )


class Camera:
    """The camera of one robot, in real time. A context manager; `observe` goes to the `Clockwork` that moves the world.

    Args:
        simulation: Whose robots have `RobotParams.rear`.
        publish: Called in this camera's thread with each topic and message, as `WorldGraph.publish`.
        robot: Its number.
        topic: Of the pictures.
        sensor: Noise and coding; None: usual ones, by the simulation's seed.

    Attributes:
        taken: Pictures so far.
        dropped: Those that were left out because the one before was not ready.
        drawing_s: Time by the clock that all so far took.
        trouble: Why there are no more pictures; empty: there are.

    Raises:
        WorldError: The robots have no camera. Entering: there is no OpenGL that draws without a display.
    """

    def __init__(
        self,
        simulation: Simulation,
        publish: Callable[[str, Message], object],
        *,
        robot: int = 0,
        topic: str = CAMERA,
        sensor: Sensor | None = None,
    ) -> None:
        rear = simulation.params.rear
        if rear is None:
            raise WorldError("this robot has no camera")
        self._simulation, self._rear, self._robot, self._publish = simulation, rear, robot, publish
        self._topic, self._sensor = topic, sensor or Sensor(rear, simulation.seed)
        self._every = 1 / (rear.rate * TICK)
        self._changed = threading.Condition()
        self._waiting: State | None = None
        self._busy = False
        self._ended = False
        self._ready = threading.Event()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self.taken = self.dropped = 0
        self.drawing_s = 0.0
        self.trouble = ""

    def __enter__(self) -> Camera:
        self._thread.start()
        if not self._ready.wait(_START_S):
            self.close()
            raise WorldError(f"the camera was not ready within {_START_S:.0f} s")
        if self._failure is not None:
            self._thread.join()
            raise self._failure
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Take no more pictures; returns when the last one is out."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(_START_S)

    def observe(self, simulation: Simulation, _: Sequence[Readings]) -> None:
        """`Observer`: take a picture if one is due. Only copies the state, which is some microseconds."""
        ticks = simulation.ticks - 1
        if math.floor(ticks / self._every + 1e-9) == math.floor((ticks - 1) / self._every + 1e-9):
            return
        with self._changed:
            if self._busy or self._waiting is not None:
                self.dropped += 1
                return
            self._waiting = simulation.state()
            self._changed.notify()

    def _run(self) -> None:
        try:
            model = self._simulation.model
            renderer = Renderer(model, self._rear, self._robot)
        except Exception as error:  # told to whoever enters
            self._failure = error if isinstance(error, WorldError) else WorldError(f"the camera does not draw: {error}")
            self._ready.set()
            return
        try:
            data = load_mujoco().MjData(model)
            renderer.draw(data)  # the first one takes longer, and holds everybody up
            self._ready.set()
            while (state := self._next()) is not None:
                begun = time.perf_counter()
                self._capture(renderer, data, state)
                self.taken += 1
                self.drawing_s += time.perf_counter() - begun
        except Exception as error:
            self.trouble = f"the camera does not draw: {error}"
            raise
        finally:
            self._ready.set()
            renderer.close()

    def _next(self) -> State | None:
        """Of the next picture; None: it is over."""
        with self._changed:
            self._busy = False
            self._changed.wait_for(lambda: self._ended or self._waiting is not None)
            if self._ended:
                return None
            state, self._waiting, self._busy = self._waiting, None, True
            return state

    def _capture(self, renderer: Renderer, data: Any, state: State) -> None:
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = state.qpos, state.mocap_pos, state.mocap_quat
        picture = self._sensor.noisy(renderer.draw(data))
        coded = np.frombuffer(self._sensor.jpeg(picture), np.uint8)
        self._publish(self._topic, CompressedImage(Header(state.stamp, "camera"), "jpeg", coded))


class FaceStudio:
    """The operator before the robot's camera, in any pose, for what judges the eyes for faces.

    To be made, used and closed in one thread.
    """

    def __init__(self, seed: int = 0, *, plan: Plan | None = None, sensor: Sensor | None = None) -> None:
        """Raises WorldError where there is no OpenGL that draws without a display."""
        self._rear = RearParams()
        model = compile_model(plan or hall(), (), 1, RobotParams(rear=self._rear), OPERATOR)
        self._data = load_mujoco().MjData(model)
        self._renderer = Renderer(model, self._rear)
        self._places = {part: int(model.body(f"{OPERATOR}-{part}").mocapid[0]) for part in (*LEGS, "trunk", "head")}
        self.sensor = sensor or Sensor(self._rear, seed)

    def __enter__(self) -> FaceStudio:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give everything back."""
        self._renderer.close()

    def draw(self, yaw: float, distance: float, *, aside: float = 0.0, robot: Pose | None = None) -> Picture:
        """A picture with the sensor's noise.

        Args:
            yaw: Of the face off the robot's heading, positive to its left, which is the picture's right [rad].
            distance: From the camera to the operator's middle, over the floor [m].
            aside: Direction of the operator off the camera's axis, positive to the same side [rad].
            robot: Where it stands in the hall; None: in its middle. What is behind the operator differs.
        """
        robot = robot or Pose(0.0, 0.0, 0.0)
        data, rear = self._data, self._rear
        away, side = rear.camera_x - distance * math.cos(aside), distance * math.sin(aside)
        cos, sin = math.cos(robot.heading), math.sin(robot.heading)
        x, y = robot.x + cos * away - sin * side, robot.y + sin * away + cos * side
        data.qpos[:3] = robot
        for part, place in self._places.items():
            heading = robot.heading + (yaw if part == "head" else 0.0)
            out = HIP * {"left": 1.0, "right": -1.0}.get(part, 0.0)
            data.mocap_pos[place] = (x - sin * out, y + cos * out, 0.0)
            data.mocap_quat[place] = (math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2))
        return self.sensor.noisy(self._renderer.draw(data))
