"""What all transforms from images to masks have in common."""

from __future__ import annotations

from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite
from torchrl.envs import Transform

from torchrl_ocwm.envs.keys import read


class ToMasks(Transform):
    """Find objects in images: ``pixels`` → ``masks``, ``object_visible``.

    Args:
        objects: How many objects O.
        pixels: Key of the images, ``[..., 3, H, W]`` uint8.
        masks: Key written, ``[..., O, H, W]`` bool.
        object_visible: Key written, ``[..., O]`` bool: whether the mask has a pixel.
    """

    def __init__(self, objects: int, *, pixels: NestedKey, masks: NestedKey, object_visible: NestedKey) -> None:
        super().__init__(in_keys=[pixels], out_keys=[masks, object_visible])
        self.objects = objects

    @abstractmethod
    def segment(self, pixels: Tensor) -> Tensor:
        """Masks ``[..., O, H, W]`` bool of images ``[..., 3, H, W]`` uint8, each on its own."""

    def _write(self, tensordict: TensorDictBase, masks: Tensor) -> TensorDictBase:
        tensordict.set(self.out_keys[0], masks)
        return tensordict.set(self.out_keys[1], masks.flatten(-2).any(-1))

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._write(next_tensordict, self.segment(read(self, next_tensordict, self.in_keys[0])))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the masks of frames, and which objects they show."""
        return self._call(tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the masks, and whether objects are visible, to the observations."""
        *batch, _, height, width = observation_spec[self.in_keys[0]].shape
        shape, device = (*batch, self.objects), observation_spec.device
        observation_spec[self.out_keys[0]] = Binary(shape=(*shape, height, width), dtype=torch.bool, device=device)
        observation_spec[self.out_keys[1]] = Binary(shape=shape, dtype=torch.bool, device=device)
        return observation_spec


def check_images(pixels: Tensor, what: str = "images") -> None:
    """Whether they are ``[..., 3, H, W]`` uint8.

    Raises:
        ValueError: if they are not.
    """
    if pixels.dtype != torch.uint8 or pixels.ndim < 3 or pixels.shape[-3] != 3:
        raise ValueError(f"{what} must be [..., 3, H, W] of uint8, got {pixels.dtype} {(*pixels.shape,)}")


def check_clicks(pixels: Tensor, points: Tensor) -> None:
    """Whether clicks ``[F, O, N, 2]`` are on frames ``[F, 3, H, W]``, and each object has one; NaN is none.

    Raises:
        ValueError: naming what is wrong.
    """
    if pixels.ndim != 4 or points.ndim != 4 or len(points) != len(pixels) or points.shape[-1] != 2:
        raise ValueError(
            f"clicks need frames [F, 3, H, W] and points [F, O, N, 2], got {(*pixels.shape,)} and {(*points.shape,)}"
        )
    size = points.new_tensor([pixels.shape[-1], pixels.shape[-2]])
    beside = points[((points < 0) | (points >= size)).any(-1)].tolist()
    if beside:
        column, row = beside[0]
        raise ValueError(f"the click ({column:g}, {row:g}) is beside the image, which is {size[0]:g} x {size[1]:g}")
    without = (~points.isfinite().all(-1).any(2).any(0)).nonzero().flatten().tolist()
    if without:
        raise ValueError(f"objects {without} have no click in any frame; click on frames that show them")
