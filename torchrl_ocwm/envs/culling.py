"""Frustum culling: geoms that cannot be in a picture, so that nobody draws them. MuJoCo itself draws all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from torchrl_ocwm.envs.opengl import import_mujoco

if TYPE_CHECKING:
    import mujoco
else:
    mujoco = import_mujoco()

_ROUNDING = 1e-4  # metres that a geom must be out of the picture


def culled_geoms(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    pose: np.ndarray,
    window: np.ndarray,
    *,
    wanted: Sequence[int] | None = None,
) -> np.ndarray:
    """Geoms of which a camera cannot see anything, ``[ngeom]`` bool.

    A geom counts as its box, a plane as all that is below it. It is culled if all of that lies outside one side of the
    pyramid that the camera sees.

    Args:
        model: The MuJoCo model.
        data: A state of it, up to date (``mj_forward``).
        pose: ``[4, 4]`` camera-to-world matrix; x points right in the image, y down, z into the scene.
        window: ``[2, 2]``, x/z and y/z of the rays through the first corner of the image, then those through the last.
        wanted: Geoms to look for. Given, geoms are culled too that can neither be these nor hide a part of them:
            the pyramid is then a narrower one around their bounding spheres, and ends behind them.

    Examples:
        >>> import mujoco
        >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><geom size=".1"/>
        ...     <geom size=".1" pos="2 0 0"/><geom size=".1" pos="0 0 -1"/></worldbody></mujoco>''')
        >>> data = mujoco.MjData(model)
        >>> mujoco.mj_forward(model, data)
        >>> from_above = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
        >>> window = np.array([[-1.0, -1.0], [1.0, 1.0]])  # 90 degrees; one metre above the first ball
        >>> culled_geoms(model, data, from_above, window).tolist()
        [False, True, False]
        >>> culled_geoms(model, data, from_above, window, wanted=[0]).tolist()
        [False, True, True]
    """
    rotation, origin = pose[:3, :3], pose[:3, 3]
    end = np.inf
    if wanted is not None:
        window, end = _narrowed(model, (data.geom_xpos[wanted] - origin) @ rotation, wanted, window)
    (left, top), (right, bottom) = window
    inwards = np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom], [0, 0, 1], [0, 0, -1]])
    turns = data.geom_xmat.reshape(-1, 3, 3).swapaxes(1, 2) @ rotation  # from a geom's axes to the camera's
    middles = (data.geom_xpos - origin) @ rotation + (model.geom_aabb[:, None, :3] @ turns)[:, 0]
    reach = (model.geom_aabb[:, None, 3:] @ np.abs(turns @ inwards.T))[:, 0]
    furthest_in = middles @ inwards.T + reach + (0, 0, 0, 0, 0, end)  # (ngeom, 6): metres within each side, at most
    return (furthest_in < -_ROUNDING).any(1)


def _narrowed(
    model: mujoco.MjModel, middles: np.ndarray, wanted: Sequence[int], window: np.ndarray
) -> tuple[np.ndarray, float]:
    """The part of a window in which wanted geoms can be, (2, 2), and how far from the camera they end, metres."""
    radius, depth = model.geom_rbound[wanted], middles[:, 2]
    unbounded = model.geom_type[wanted] == mujoco.mjtGeom.mjGEOM_PLANE
    if (unbounded | (depth <= radius)).any():  # a plane, or around the camera
        return window, np.inf
    sideways = middles[:, :2]
    angle = np.arctan2(sideways, depth[:, None])
    half = np.arcsin(radius[:, None] / np.hypot(sideways, depth[:, None]))
    first, last = np.tan((angle - half).min(0)), np.tan((angle + half).max(0))
    return np.array([np.maximum(window[0], first), np.minimum(window[1], last)]), (depth + radius).max()
