"""RGB-D cameras that look at a MuJoCo model: one off-screen picture gives colour and depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.errors import ConfigError, InputError, nearest
from pred_core.plant.stereo_noise import StereoNoise, add_noise
from pred_core.types import CameraFrame

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Depth = NDArray[np.float32]
NEAR, FAR = 0.05, 20.0  # [m]
MAX_GEOMS = 5000
NEXT_STEP = "Install software rendering: apt install libegl1 libgl1-mesa-dri"


@dataclass(frozen=True)
class CameraConfig:
    """A camera: where it stands, where it looks, and its picture. A D455-like field of view by default."""

    name: str = setting("cam0", doc="prefix of its topics")
    eye: tuple[float, float, float] = setting((0.8, 0.0, 0.6), unit="m", doc="optical centre in world")
    target: tuple[float, float, float] = setting((0.0, 0.0, 0.05), unit="m", doc="point in the picture's middle")
    width: int = setting(640, unit="px", low=16, high=4096)
    height: int = setting(480, unit="px", low=16, high=4096)
    focal: float = setting(600.0, unit="px", low=10.0, high=10000.0, doc="focal length of the picture")
    rate: float = setting(30.0, unit="Hz", low=0.1, high=200.0, doc="pictures a second")
    delay: float = setting(0.0, unit="s", low=0.0, high=1.0, doc="from capture to arrival")
    phase: float = setting(0.0, unit="s", low=0.0, high=1.0, doc="capture time of the first picture")

    @property
    def intrinsics(self) -> Array:
        """(3, 3) [px]. Pixel centres are whole numbers, so the middle is half a pixel before width / 2."""
        f, cx, cy = self.focal, 0.5 * (self.width - 1), 0.5 * (self.height - 1)
        return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])

    @property
    def world_from_camera(self) -> Array:
        """(4, 4) optical frame (x right, y down, z forward) in world."""
        return look_at(self.eye, self.target)


def look_at(eye: Sequence[float], target: Sequence[float]) -> Array:
    """world_from_camera (4, 4) of an upright camera at `eye` [m] that looks at `target` [m].

    Raises: ConfigError if the two coincide. A camera that looks straight down has world +y at the top.
    """
    forward = np.subtract(target, eye).astype(np.float64)
    distance = float(np.linalg.norm(forward))
    if distance < 1e-9:
        raise ConfigError("camera: eye and target are the same point", got=tuple(eye), next_step="Move one of them")
    forward /= distance
    up = np.array([0.0, 0.0, 1.0])
    if abs(float(forward @ up)) > 1.0 - 1e-9:
        up = np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((right, np.cross(forward, right), forward), axis=1)
    pose[:3, 3] = eye
    return pose


def ring_of_cameras(
    count: int = 4,
    target: tuple[float, float, float] = (0.0, 0.0, 0.05),
    distance: float = 1.0,
    elevation: float = 0.8,
    *,
    width: int = 640,
    height: int = 480,
    rate: float = 30.0,
    first: float = np.pi / 4,
) -> tuple[CameraConfig, ...]:
    """`count` cameras evenly around `target` at `distance` [m] and `elevation` [rad]; the focal length fits 640 px."""
    configs = []
    for i in range(count):
        a = first + 2 * np.pi * i / count
        out = np.array([np.cos(a) * np.cos(elevation), np.sin(a) * np.cos(elevation), np.sin(elevation)])
        x, y, z = (np.array(target) + distance * out).tolist()
        configs.append(
            CameraConfig(
                f"cam{i}", (x, y, z), target, width=width, height=height, focal=600.0 * width / 640.0, rate=rate
            )
        )
    return tuple(configs)


class Cameras:
    """Renders any number of cameras of one compiled model. Owns a GL context: close it, or use `with`.

    It must be used by the thread that made it. The model keeps no cameras: a camera may move or be bumped at any time.
    """

    def __init__(self, model: mujoco.MjModel, configs: Sequence[CameraConfig], noise: StereoNoise | None = None):
        """Raises: ConfigError for no camera or a repeated name; InputError where OpenGL is missing."""
        names = [c.name for c in configs]
        if not names or len(set(names)) != len(names):
            raise ConfigError("cameras", got=", ".join(names) or "none", allowed="one or more, each name once")
        self.configs = {c.name: c for c in configs}
        self.noise = noise or StereoNoise()
        self._model = model
        self._context, self._gl = _make_context(model, self.configs.values())
        self._scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()

    def frame(
        self,
        data: mujoco.MjData,
        name: str,
        stamp: int,
        generator: np.random.Generator,
        *,
        bumped: Array | None = None,
    ) -> CameraFrame:
        """What camera `name` measures at `stamp` [ns], with the pose it is believed to have.

        bumped: world_from_camera (4, 4) where it really is, if that is another place.
        """
        config = self._find(name)
        rgb, depth = self.truth(data, name, pose=bumped)
        measured = add_noise(depth, config.focal, self.noise, generator)
        return CameraFrame(stamp, rgb, measured, config.intrinsics, config.world_from_camera)

    def truth(self, data: mujoco.MjData, name: str, *, pose: Array | None = None) -> tuple[Picture, Depth]:
        """Colour (H, W, 3) and true depth (H, W) [m], NaN beyond 20 m. For ground truth."""
        config = self._find(name)
        pose = config.world_from_camera if pose is None else pose
        self._gl.make_current()
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        self._aim(config, pose)
        height, width = config.height, config.width
        rgb, depth = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)
        rect = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(rect, self._scene, self._context)
        mujoco.mjr_readPixels(rgb, depth, rect, self._context)
        nothing = depth <= 0.0
        # The depth map is 1 at NEAR and 0 at FAR: NEAR FAR / z = NEAR + d (FAR - NEAR).
        z = (NEAR * FAR) / (NEAR + depth.astype(np.float64) * (FAR - NEAR))
        z[nothing] = np.nan
        return np.ascontiguousarray(rgb[::-1]), np.ascontiguousarray(z[::-1], dtype=np.float32)

    def close(self) -> None:
        """Free the GL context."""
        self._context.free()
        self._gl.free()

    def __enter__(self) -> Cameras:
        return self

    def __exit__(self, kind: type | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _find(self, name: str) -> CameraConfig:
        if name not in self.configs:
            raise ConfigError(f"unknown camera '{name}'", next_step=nearest(name, self.configs))
        return self.configs[name]

    def _aim(self, config: CameraConfig, pose: Array) -> None:
        """Point both eyes of the scene; the picture is the mean of two equal ones."""
        half = 0.5 * config.height / config.focal * NEAR
        for camera in self._scene.camera:
            camera.pos[:] = pose[:3, 3]
            camera.forward[:] = pose[:3, 2]
            camera.up[:] = -pose[:3, 1]
            camera.orthographic = 0
            camera.frustum_center = 0.0
            camera.frustum_width = half * config.width / config.height
            camera.frustum_bottom, camera.frustum_top = -half, half
            camera.frustum_near, camera.frustum_far = NEAR, FAR


def _make_context(model: mujoco.MjModel, configs):  # type: ignore[no-untyped-def]
    """MuJoCo's rendering context, large enough for every camera, and the GL context under it."""
    width, height = max(c.width for c in configs), max(c.height for c in configs)
    try:
        from mujoco.egl import GLContext

        gl = GLContext(width, height)
        gl.make_current()
    except (ImportError, OSError, AttributeError, RuntimeError) as error:
        raise InputError("cameras cannot be rendered: no EGL", got=error, next_step=NEXT_STEP) from error
    screen, quality = model.vis.global_, model.vis.quality
    before = screen.offwidth, screen.offheight, quality.offsamples
    screen.offwidth, screen.offheight, quality.offsamples = width, height, 0
    try:
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    except mujoco.FatalError as error:
        gl.free()
        raise InputError("cameras cannot be rendered", got=error, next_step=NEXT_STEP) from error
    finally:
        screen.offwidth, screen.offheight, quality.offsamples = before
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
    context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    return context, gl
