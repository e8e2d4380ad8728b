"""What people see of an environment: a picture of any size, or a window."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_ocwm.envs.camera import Camera
from torchrl_ocwm.envs.opengl import RenderingError

if TYPE_CHECKING:
    from torchrl_ocwm.envs.positioning import PositioningEnv

MODES = ("rgb_array", "human")


class Screen:
    """Shows an environment as gymnasium's render modes say.

    Args:
        mode: ``"rgb_array"``: pictures from the environment's camera; ``"human"``: MuJoCo's viewer, in which the view
            can be moved; ``None``: nothing.
        size: Pixels on a side of a picture; ``None``: what the agent sees.

    Raises:
        ValueError: for another mode, or a size below one.
    """

    def __init__(self, mode: str | None, size: int | None) -> None:
        if mode not in (None, *MODES):
            raise ValueError(f"render_mode must be one of {', '.join(MODES)} or None, got {mode!r}")
        if size is not None and size < 1:
            raise ValueError(f"render_size must be at least 1, got {size}")
        self.mode, self.size = mode, size
        self._camera: Camera | None = None
        self._viewer: Any = None

    def picture(self, env: PositioningEnv) -> np.ndarray | None:
        """The picture ``[H, W, 3]`` uint8 of the mode ``"rgb_array"``.

        Raises:
            RenderingError: if there is no screen for the mode ``"human"``.
        """
        if self.mode == "human":
            self.follow(env)
        if self.mode != "rgb_array":
            return None
        if self.size is None:
            return np.ascontiguousarray(env._observe(env.data)["pixels"].transpose(1, 2, 0))
        if self._camera is None:
            self._camera = Camera(env.model, env.camera_name, height=self.size, width=self.size, multisampling=4)
        return self._camera.picture(env.data)

    def follow(self, env: PositioningEnv) -> None:
        """Show the state of the environment in the window, which is opened first if the mode is ``"human"``.

        Raises:
            RenderingError: if there is no screen.
        """
        if self.mode != "human":
            return
        if self._viewer is None:
            self._viewer = _open(env)
        self._viewer.sync()

    def close(self) -> None:
        """Close the window, and free the camera."""
        for shown in (self._camera, self._viewer):
            if shown is not None:
                shown.close()
        self._camera = self._viewer = None


def _open(env: PositioningEnv) -> Any:
    try:
        from mujoco import viewer

        return viewer.launch_passive(env.model, env.data, show_left_ui=False, show_right_ui=False)
    except Exception as error:  # whatever glfw and the thread of the window raise
        raise RenderingError(
            f"render_mode='human' needs a screen ({error}); use 'rgb_array', which needs none"
        ) from error
