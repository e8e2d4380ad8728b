"""A disc in the image where the goal is (paper, "Size matters!")."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.envs import Transform

from torchrl_ocwm.envs.keys import read

TARGET_COLOUR = (230, 40, 40)


def draw_target(pixels: np.ndarray, centre: np.ndarray, diameter: float, *, behind: np.ndarray) -> np.ndarray:
    """Draw a disc into an image, at least the pixel that its middle is nearest to.

    Args:
        pixels: (H, W, 3) uint8, drawn into.
        centre: (2,) pixels, as (column, row).
        diameter: Pixels.
        behind: (H, W) bool, what hides the disc.

    Returns:
        ``pixels``.

    Examples:
        >>> nothing = np.zeros((5, 5), bool)
        >>> draw_target(np.zeros((5, 5, 3), np.uint8), np.array([2.5, 1.5]), 3, behind=nothing)[..., 0]
        array([[  0, 230, 230, 230,   0],
               [  0, 230, 230, 230,   0],
               [  0, 230, 230, 230,   0],
               [  0,   0,   0,   0,   0],
               [  0,   0,   0,   0,   0]], dtype=uint8)
    """
    rows, columns = np.ogrid[: len(pixels), : pixels.shape[1]]
    distance = np.hypot(columns + 0.5 - centre[0], rows + 0.5 - centre[1])
    disc = (distance <= diameter / 2) | (distance == distance.min())
    pixels[disc & ~behind] = TARGET_COLOUR
    return pixels


class DrawTarget(Transform):
    """Draw a disc at the goal into images that do not show it: ``pixels``, ``masks``, ``goal_position`` → ``pixels``.

    What the option ``virtual_target`` does in this package's environments, for any other, for a replay buffer, and for
    frames that are there already (:func:`~torchrl_ocwm.data.draw_targets`). Objects hide the disc. The camera must not
    move.

    Args:
        project: Where positions ``[N, D]``, metres, are in the image: ``[N, 2]`` as (column, row); an environment's
            :meth:`~torchrl_ocwm.envs.PositioningEnv.project`.
        diameter: Pixels.
        pixels: Key of the images, ``[..., 3, H, W]`` uint8, and of those that are written.
        masks: Key of the masks, ``[..., O, H, W]`` bool.
        goal_position: Key of the goals, ``[..., D]`` metres.

    Raises:
        KeyError: if there are no images, masks or goals.

    Examples:
        >>> from tensordict import TensorDict
        >>> frames = TensorDict({
        ...     "pixels": torch.zeros(2, 3, 8, 8, dtype=torch.uint8),
        ...     "masks": torch.zeros(2, 1, 8, 8, dtype=torch.bool),
        ...     "goal_position": torch.tensor([[1.5, 2.5], [3.5, 2.5]]),
        ... }, [2])
        >>> DrawTarget(lambda position: position, 1)(frames)["pixels"][1, 0].nonzero()
        tensor([[2, 3]])
    """

    def __init__(
        self,
        project: Callable[[np.ndarray], np.ndarray],
        diameter: float,
        *,
        pixels: NestedKey = "pixels",
        masks: NestedKey = "masks",
        goal_position: NestedKey = "goal_position",
    ) -> None:
        super().__init__(in_keys=[pixels, masks, goal_position], out_keys=[pixels])
        self.project, self.diameter = project, diameter

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        pixels, masks, goals = (read(self, next_tensordict, key) for key in self.in_keys)
        size = pixels.shape[-2:]
        images = pixels.movedim(-3, -1).reshape(-1, *size, 3).numpy(force=True).copy()
        hidden = masks.any(-3).reshape(-1, *size).numpy(force=True)
        centres = self.project(goals.reshape(-1, goals.shape[-1]).numpy(force=True))
        for image, centre, behind in zip(images, centres, hidden, strict=True):
            draw_target(image, centre, self.diameter, behind=behind)
        drawn = torch.from_numpy(images).movedim(-1, -3).reshape(pixels.shape).contiguous().to(pixels.device)
        return next_tensordict.set(self.out_keys[0], drawn)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Draw into a copy of the images of frames."""
        return self._call(tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return self._call(tensordict_reset)
