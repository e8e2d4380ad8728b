"""One MuJoCo camera for every suite: RGB, segmentation and depth, and where its pixels lie in the world."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from torchrl_ocwm.envs.culling import culled_geoms
from torchrl_ocwm.envs.opengl import OPEN, close_at_exit, import_mujoco
from torchrl_ocwm.envs.shared_context import SharedContext, shared_context

if TYPE_CHECKING:
    import mujoco
else:
    mujoco = import_mujoco()


_MAX_GEOMS = 1 << 16  # two bytes of their colour hold their number
_NOT_DRAWN = 5  # a group of geoms that MuJoCo leaves out unless asked for it


class Frame(NamedTuple):
    """What a camera saw.

    Args:
        pixels: ``[H, W, 3]`` uint8.
        geoms: ``[S * H, S * W]`` int32, the id of the geom seen at each pixel, -1 where there is none; S is the
            ``mask_scale`` of the camera.
        depth: ``[S * H, S * W]`` float32, metres along the optical axis; ``None`` unless asked for.
    """

    pixels: np.ndarray
    geoms: np.ndarray
    depth: np.ndarray | None


class Camera:
    """Renders a MuJoCo model from one of its cameras, off screen.

    A frame takes two passes of OpenGL, one for the colours and one for segmentation and depth together. Shadows,
    reflections and multisampling are off by default: they cost most of the time of a software renderer. So do meshes:
    those that cannot be in the picture are not drawn, unless they may cast a shadow or a reflection into it.

    Args:
        model: The MuJoCo model. It may be stepped by any suite.
        camera: Name of a camera of the model.
        height: Image height, pixels.
        width: Image width, pixels.
        mask_scale: How many times finer than the colours segmentation and depth are, in height and width.
        shadows: Draw shadows.
        reflections: Draw reflections.
        multisampling: Samples per pixel of the colour pass, 0 for none.
        max_geoms: Geoms that a picture may have, at most 65,535.

    Raises:
        ValueError: if the model has no such camera, the camera is orthographic, or a picture has more geoms.
        RuntimeError: if no OpenGL library works, with what to install; if the camera is closed, or used in another
            thread than the one that made it.

    Examples:
        >>> import mujoco
        >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><camera name="top" pos="0 0 1"/>
        ...     <geom name="ball" type="sphere" size=".1"/></worldbody></mujoco>''')
        >>> data = mujoco.MjData(model)
        >>> mujoco.mj_forward(model, data)
        >>> camera = Camera(model, "top", height=32, width=32)
        >>> frame = camera.render(data, depth=True)
        >>> frame.pixels.shape, int(frame.geoms[16, 16]), bool(abs(frame.depth[16, 16] - 0.9) < 0.01)
        ((32, 32, 3), 0, True)
        >>> camera.close()
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: str,
        *,
        height: int = 64,
        width: int = 64,
        mask_scale: int = 1,
        shadows: bool = False,
        reflections: bool = False,
        multisampling: int = 0,
        max_geoms: int = 2000,
    ) -> None:
        self.camera_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if self.camera_id < 0:
            names = [model.camera(index).name for index in range(model.ncam)]
            raise ValueError(f"the model has no camera {camera!r}; it has {names}")
        if model.cam_orthographic[self.camera_id]:
            raise ValueError(f"camera {camera!r} is orthographic; positions need one with perspective")
        if not 0 < max_geoms < _MAX_GEOMS:
            raise ValueError(f"max_geoms must be from 1 to {_MAX_GEOMS - 1}, got {max_geoms}")
        self.model, self.height, self.width, self.mask_scale = model, height, width, mask_scale
        self._thread = threading.current_thread()
        fine = self._fine_size
        self._context: SharedContext | None = None  # if there is none, what follows raises
        self._context = shared_context(
            model, height=fine[0], width=fine[1], multisampling=multisampling, shadows=shadows
        )
        close_at_exit(self)
        self._max_geoms = max_geoms
        self._scene = mujoco.MjvScene(model, maxgeom=max_geoms + 1)  # the last one shows that there are too many
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = reflections
        self._culls = model.nmesh > 0 and not (shadows or reflections)  # a few simple shapes are drawn at once
        self._options = mujoco.MjvOption()
        self._view = mujoco.MjvCamera()
        self._view.type, self._view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, self.camera_id
        self._rectangle, self._fine = mujoco.MjrRect(0, 0, width, height), mujoco.MjrRect(0, 0, *fine[::-1])
        self._pixels = np.empty((height, width, 3), np.uint8)
        self._ids = np.empty((*fine, 3), np.uint8)
        self._depth = np.empty(fine, np.float32)

    @property
    def _fine_size(self) -> tuple[int, int]:
        return self.mask_scale * self.height, self.mask_scale * self.width

    def render(self, data: mujoco.MjData, *, depth: bool = False, wanted: Sequence[int] | None = None) -> Frame:
        """Render the state in ``data``, which must be up to date (``mj_forward``).

        Args:
            data: A state of the camera's model.
            depth: Read the depth too; it comes out of the segmentation pass.
            wanted: Ids of the geoms that you look for, one or more. Segmentation and depth then hold where these are
                seen, and other geoms may be missing elsewhere. With detailed meshes this takes much less time.
        """
        pixels = self.picture(data)
        assert self._context is not None
        context = self._context.mujoco
        if self._culls and wanted is not None:
            self._update_scene(data, wanted)
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        mujoco.mjr_render(self._fine, self._scene, context)
        mujoco.mjr_readPixels(self._ids, self._depth if depth else None, self._fine, context)
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False
        return Frame(pixels, self._geoms(), self._metres() if depth else None)

    def picture(self, data: mujoco.MjData, *, fine: bool = False) -> np.ndarray:
        """Render the colours alone, ``[H, W, 3]`` uint8: the first pass of :meth:`render`.

        Args:
            data: A state of the camera's model.
            fine: As large as the segmentation, ``[S * H, S * W, 3]``.
        """
        context = self._current()
        self._update_scene(data)
        size, buffer = (self._fine, self._ids) if fine else (self._rectangle, self._pixels)
        mujoco.mjr_render(size, self._scene, context)
        mujoco.mjr_readPixels(buffer, None, size, context)
        return buffer[::-1].copy()  # OpenGL's rows run upwards

    def _update_scene(self, data: mujoco.MjData, wanted: Sequence[int] | None = None) -> None:
        with self._culling(data, wanted) if self._culls else nullcontext():
            everything = mujoco.mjtCatBit.mjCAT_ALL
            mujoco.mjv_updateScene(self.model, data, self._options, None, self._view, everything, self._scene)
        if self._scene.ngeom > self._max_geoms:
            raise ValueError(f"the scene has more than {self._max_geoms} geoms; give the camera a larger max_geoms")

    @contextmanager
    def _culling(self, data: mujoco.MjData, wanted: Sequence[int] | None) -> Iterator[None]:
        """Meanwhile, geoms that cannot be in the picture are in a group that is not drawn."""
        culled = culled_geoms(self.model, data, self.extrinsics(data), self._window, wanted=wanted)
        groups = self.model.geom_group.copy()
        try:
            self.model.geom_group[culled] = _NOT_DRAWN
            yield
        finally:
            self.model.geom_group[:] = groups

    def _current(self) -> Any:
        """MuJoCo's context, ready to be used."""
        if self._context is None:
            raise RuntimeError("this camera is closed")
        if threading.current_thread() is not self._thread:
            raise RuntimeError(
                f"this camera belongs to the thread {self._thread.name!r}, as OpenGL wants it; make, step and close an "
                "environment in one thread"
            )
        self._context.make_current()
        return self._context.mujoco

    def _geoms(self) -> np.ndarray:
        geom_of_segment = np.full(self._scene.ngeom + 1, -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                geom_of_segment[geom.segid + 1] = geom.objid
        ids = self._ids[::-1]
        return geom_of_segment[ids[..., 0] + (ids[..., 1].astype(np.int32) << 8)]

    def _metres(self) -> np.ndarray:
        extent, clip = self.model.stat.extent, self.model.vis.map
        near, far = clip.znear * extent, clip.zfar * extent
        # The buffer holds 1 at the near plane and 0 at the far one, linear in 1/z.
        inverse = self._depth[::-1].astype(np.float64) * (1 / near - 1 / far) + 1 / far
        return (1 / inverse).astype(np.float32)

    @property
    def _window(self) -> np.ndarray:
        """Slopes of the rays through the first and the last corner of the image, (2, 2)."""
        corners = np.array([[0, 0, 1], [self.width, self.height, 1]]).T
        return (np.linalg.inv(self.intrinsics) @ corners)[:2].T

    @property
    def intrinsics(self) -> np.ndarray:
        """``[3, 3]`` float32 pinhole matrix in pixels; the centre of the first pixel is (0.5, 0.5)."""
        size, centre = np.array([self.width, self.height]), np.array([self.width, self.height]) / 2
        sensor, lens = self.model.cam_sensorsize[self.camera_id], self.model.cam_intrinsic[self.camera_id]
        if sensor.all():  # metres; it fills the image, so that pixels need not be square
            focal = lens[:2] / sensor * size
            centre = centre + lens[2:] * (-1, 1) / sensor * size
        else:
            focal = np.full(2, centre[1] / np.tan(np.deg2rad(self.model.cam_fovy[self.camera_id]) / 2))
        return np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]], np.float32)

    def extrinsics(self, data: mujoco.MjData) -> np.ndarray:
        """``[4, 4]`` float32 camera-to-world matrix; x points right in the image, y down, z into the scene."""
        pose = np.eye(4, dtype=np.float32)
        # MuJoCo's cameras look along -z with y up.
        pose[:3, :3] = data.cam_xmat[self.camera_id].reshape(3, 3) * np.array([1, -1, -1])
        pose[:3, 3] = data.cam_xpos[self.camera_id]
        return pose

    def close(self) -> None:
        """Leave the OpenGL context, which the last camera frees. Closing twice does nothing."""
        if self._context is not None:
            self._current()
            self._context.release()
        self._context = None
        OPEN.discard(self)

    def __del__(self) -> None:
        # Python may collect it in another thread, which cannot free what is OpenGL's.
        if not sys.is_finalizing() and self.__dict__.get("_thread") is threading.current_thread():
            self.close()
