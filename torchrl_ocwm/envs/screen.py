"""What people see of an environment: a picture of any size."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchrl_ocwm.envs.camera import Camera

if TYPE_CHECKING:
    from torchrl_ocwm.envs.positioning import PositioningEnv


class Screen:
    """Pictures of an environment for people, from its own camera.

    Args:
        size: Pixels on a side; ``None``: what the agent sees.

    Raises:
        ValueError: for a size below one.
    """

    def __init__(self, size: int | None) -> None:
        if size is not None and size < 1:
            raise ValueError(f"render_size must be at least 1, got {size}")
        self.size = size
        self._camera: Camera | None = None

    def picture(self, env: PositioningEnv) -> np.ndarray:
        """The picture ``[H, W, 3]`` uint8."""
        if self.size is None:
            return np.ascontiguousarray(env._observe(env.data)["pixels"].transpose(1, 2, 0))
        if self._camera is None:
            self._camera = Camera(env.model, env.camera_name, height=self.size, width=self.size, multisampling=4)
        return self._camera.picture(env.data)

    def close(self) -> None:
        """Free the camera."""
        if self._camera is not None:
            self._camera.close()
        self._camera = None
