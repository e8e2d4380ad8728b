"""From segmentation masks to positions in the world (paper, section "Object Positioning Tasks")."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import Transform

Matrix: TypeAlias = Tensor | np.ndarray


def mask_centroid(masks: Tensor) -> tuple[Tensor, Tensor]:
    """Centroids of masks in pixel coordinates; the centre of the first pixel is (0.5, 0.5).

    Args:
        masks: ``[..., H, W]`` bool.

    Returns:
        Centroids ``[..., 2]`` float32 as (column, row), zero for an empty mask, and ``[..., 1]`` float32 pixel counts.

    Examples:
        >>> mask = torch.zeros(4, 4, dtype=torch.bool)
        >>> mask[1, 2:4] = True
        >>> mask_centroid(mask)[0]
        tensor([3.0000, 1.5000])
    """
    height, width = masks.shape[-2:]
    sums = masks.flatten(-2).float() @ _pixel_sums(height, width, masks.device)
    count = sums[..., 2:]
    return sums[..., :2] / count.clamp_min(1), count


@lru_cache(maxsize=32)
def _pixel_sums(height: int, width: int, device: torch.device) -> Tensor:
    """``[H * W, 3]``: column, row and 1 of each pixel, so that one product sums all three over a mask."""
    rows, columns = torch.meshgrid(torch.arange(0.5, height), torch.arange(0.5, width), indexing="ij")
    return torch.stack([columns, rows, torch.ones_like(rows)], -1).flatten(0, 1).to(device)


def pixels_to_world(
    pixels: Tensor,
    intrinsics: Tensor,
    extrinsics: Tensor,
    *,
    depth: Tensor | None = None,
    plane: Tensor | None = None,
) -> Tensor:
    """Points in the world behind pixels: along the pixel's ray, at a depth or where the ray meets a plane.

    Args:
        pixels: ``[..., N, 2]`` as (column, row).
        intrinsics: ``[..., 3, 3]`` pinhole matrix without skew, pixels.
        extrinsics: ``[..., 4, 4]`` camera-to-world matrix (x right, y down, z into the scene), metres.
        depth: ``[..., N]`` metres along the optical axis.
        plane: ``[4]`` plane (n, d) with n · x = d in world coordinates, used when there is no depth.

    Returns:
        ``[..., N, 3]`` metres, world frame; not a number where the ray misses the plane or the depth is no positive
        finite number.

    Raises:
        ValueError: unless exactly one of ``depth`` and ``plane`` is given.

    Examples:
        >>> intrinsics = torch.tensor([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]])
        >>> pixels_to_world(torch.tensor([[6.0, 5.0]]), intrinsics, torch.eye(4), depth=torch.tensor([2.0]))
        tensor([[0.2000, 0.0000, 2.0000]])
    """
    if (depth is None) == (plane is None):
        raise ValueError("give either the depth of the pixels or the plane that they lie on")
    focal = intrinsics.diagonal(dim1=-2, dim2=-1)[..., None, :2]
    in_camera = (pixels - intrinsics[..., None, :2, 2]) / focal
    rotation, origin = extrinsics[..., :3, :3], extrinsics[..., None, :3, 3]
    rays = in_camera @ rotation[..., :2].mT + rotation[..., None, :, 2]
    if depth is None:
        assert plane is not None
        normal, offset = plane[:3], plane[3]
        depth = (offset - origin @ normal) / (rays @ normal)
    depth = torch.where(_is_valid(depth), depth, torch.nan)
    return origin + rays * depth.unsqueeze(-1)


def _is_valid(depth: Tensor) -> Tensor:
    return depth.isfinite() & (depth > 0)


def masks_to_positions(
    masks: Tensor,
    intrinsics: Tensor,
    extrinsics: Tensor,
    *,
    depth: Tensor | None = None,
    plane: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """World positions of segmented objects: centroid of the mask → ray of the camera → depth or plane.

    Pixels without a valid depth (zero, negative, infinite, not a number) count as no part of any mask.

    Args:
        masks: ``[..., O, H, W]`` bool, one mask per object; of integers, all but 0 belong to the object.
        intrinsics: ``[..., 3, 3]``, pixels.
        extrinsics: ``[..., 4, 4]`` camera to world, metres.
        depth: ``[..., 1, H, W]`` metres, of any floating-point type; the mean over the mask is taken.
        plane: ``[4]`` plane (n, d) that the objects move on, if there is no depth.

    Returns:
        Positions ``[..., O, 3]`` float32 metres, and ``[..., O]`` bool: false, and the position zero, where nothing of
        a mask can be used or its ray misses the plane.

    Raises:
        ValueError: for masks of probabilities, depth of integers, and shapes that do not fit each other.

    Examples:
        >>> masks = torch.zeros(1, 10, 10, dtype=torch.bool)
        >>> masks[0, 5, 6:8] = True
        >>> intrinsics = torch.tensor([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]])
        >>> above = torch.diag(torch.tensor([1.0, -1, -1, 1]))
        >>> above[2, 3] = 2.0
        >>> masks_to_positions(masks, intrinsics, above, plane=torch.tensor([0.0, 0, 1, 0]))
        (tensor([[ 0.4000, -0.1000,  0.0000]]), tensor([True]))
    """
    _check_images(masks, depth)
    with torch.autocast(masks.device.type, enabled=False):  # half precision does not count pixels
        masks = masks.bool()
        if depth is not None:
            depth = depth.float()
            masks = masks & _is_valid(depth)
        centroid, count = mask_centroid(masks)
        if depth is not None:
            depth = torch.where(masks, depth, 0).sum((-1, -2)) / count.squeeze(-1)
        position = pixels_to_world(centroid, intrinsics.float(), extrinsics.float(), depth=depth, plane=plane)
        visible = (count.squeeze(-1) > 0) & position.isfinite().all(-1)
    return torch.where(visible.unsqueeze(-1), position, 0), visible


def _check_images(masks: Tensor, depth: Tensor | None) -> None:
    if masks.is_floating_point():
        raise ValueError(f"masks must be bool, got {masks.dtype}; for probabilities give masks > 0.5")
    if depth is None:
        return
    if not depth.is_floating_point():
        raise ValueError(
            f"depth must be in metres as float, got {depth.dtype}; for millimetres give depth.float() / 1000"
        )
    if depth.ndim != masks.ndim or depth.shape[-3] != 1 or depth.shape[-2:] != masks.shape[-2:]:
        raise ValueError(
            f"masks [..., O, H, W] need depth [..., 1, H, W], got {tuple(masks.shape)} and {tuple(depth.shape)}"
        )


def hold_last_seen(position: Tensor, visible: Tensor, before: Tensor, is_init: Tensor | None = None) -> Tensor:
    """Replace the positions of hidden objects by where they were last seen.

    Args:
        position: ``[T, ..., O, D]``.
        visible: ``[T, ..., O]`` bool.
        before: ``[..., O, D]``, what to use until an object is seen for the first time.
        is_init: ``[T, ..., 1]`` bool, true where an episode starts, in which nothing has been seen.

    Examples:
        >>> position, visible = torch.tensor([[[1.0]], [[9.0]]]), torch.tensor([[True], [False]])
        >>> hold_last_seen(position, visible, before=torch.zeros(1, 1)).flatten()
        tensor([1., 1.])
    """
    time = torch.arange(1, len(position) + 1, device=position.device).reshape(-1, *[1] * (visible.ndim - 1))
    last = (time * visible).cummax(0).values
    if is_init is not None:
        last = last * (last >= (time * is_init).cummax(0).values)
    return torch.cat([before.unsqueeze(0), position]).gather(0, last.unsqueeze(-1).expand_as(position))


class MaskToPosition(Transform):
    """Estimate object positions from segmentation masks, in an environment or in a replay buffer.

    Works on any masks, depth and camera matrices, of a simulator or of a real camera. Pixels without a valid depth
    (zero, negative, infinite, not a number) are ignored. An object that cannot be seen keeps the position where it was
    last seen in its episode, zero if it was not seen yet, and is flagged. So is one without any valid depth, or whose
    ray misses the plane.

    Args:
        intrinsics: ``[3, 3]`` pinhole matrix in pixels, or the key that holds one per step.
        extrinsics: ``[4, 4]`` camera-to-world matrix (x right, y down, z into the scene) in metres, or its key.
        depth: Key of the depth images ``[..., 1, H, W]``, metres, of any floating-point type.
        plane: ``(nx, ny, nz, d)`` of a known plane n · x = d that the objects move on, instead of depth.
        start: ``[3]`` world position that the output is relative to, metres.
        axes: Which world axes to keep.
        masks: Key of the masks, ``[..., O, H, W]`` bool, or integers that are 0 outside the object.
        is_init: Key that says where episodes start, ``[..., 1]`` bool; read by :meth:`forward` where it is present.
        object_position: Key written, ``[..., O, len(axes)]`` float32, metres from ``start``.
        object_visible: Key written, ``[..., O]`` bool.

    In a replay buffer the last dimension of the batch is time, and the keys are used as they are given: name
    ``masks=("next", "masks")`` to read those.

    Raises:
        ValueError: unless exactly one of ``depth`` and ``plane`` is given; for a matrix of another shape, a plane
            without a direction, masks of probabilities, depth of integers.
        KeyError: if the masks, the depth or a camera matrix is missing from the data.

    Examples:
        >>> from tensordict import TensorDict
        >>> above = torch.diag(torch.tensor([1.0, -1, -1, 1]))
        >>> above[2, 3] = 2.0
        >>> intrinsics = torch.tensor([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]])
        >>> transform = MaskToPosition(intrinsics, above, plane=(0.0, 0.0, 1.0, 0.0), axes=(0, 1))
        >>> masks = torch.zeros(2, 1, 10, 10, dtype=torch.bool)
        >>> masks[0, 0, 5, 6:8] = True  # seen at the first step, hidden at the second
        >>> data = transform(TensorDict({"masks": masks}, [2]))
        >>> data["object_position"][:, 0]
        tensor([[ 0.4000, -0.1000],
                [ 0.4000, -0.1000]])
        >>> data["object_visible"][:, 0]
        tensor([ True, False])
    """

    def __init__(
        self,
        intrinsics: Matrix | NestedKey,
        extrinsics: Matrix | NestedKey,
        *,
        depth: NestedKey | None = None,
        plane: tuple[float, float, float, float] | None = None,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        axes: tuple[int, ...] = (0, 1, 2),
        masks: NestedKey = "masks",
        is_init: NestedKey = "is_init",
        object_position: NestedKey = "object_position",
        object_visible: NestedKey = "object_visible",
    ) -> None:
        if (depth is None) == (plane is None):
            raise ValueError("MaskToPosition needs either the key of a depth image or a known plane")
        if plane is not None and not any(plane[:3]):
            raise ValueError(f"the plane {plane} has no direction: its first three numbers are zero")
        matrices = {"intrinsics": (intrinsics, 3), "extrinsics": (extrinsics, 4)}
        self._camera_keys = {name: value for name, (value, _) in matrices.items() if isinstance(value, (str, tuple))}
        inputs = [masks, *([depth] if depth is not None else []), *self._camera_keys.values()]
        super().__init__(in_keys=inputs, out_keys=[object_position, object_visible])
        for name, (value, size) in matrices.items():
            if name not in self._camera_keys:
                self.register_buffer(name, _matrix(name, value, size))
        self.register_buffer("plane", None if plane is None else torch.as_tensor(plane, dtype=torch.float32))
        self.register_buffer("start", torch.as_tensor(start, dtype=torch.float32))
        self.depth, self.masks, self.is_init, self.axes = depth, masks, is_init, list(axes)

    def _matrix(self, name: str, tensordict: TensorDictBase) -> Tensor:
        key = self._camera_keys.get(name)
        return getattr(self, name) if key is None else self._read(tensordict, key)

    def _read(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            raise KeyError(f"MaskToPosition found no {key!r} among {sorted(map(str, tensordict.keys(True, True)))}")
        return value

    def _estimate(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        position, visible = masks_to_positions(
            self._read(tensordict, self.masks),
            self._matrix("intrinsics", tensordict),
            self._matrix("extrinsics", tensordict),
            depth=None if self.depth is None else self._read(tensordict, self.depth),
            plane=self.plane,
        )
        return (position - self.start)[..., self.axes], visible

    def _write(self, tensordict: TensorDictBase, position: Tensor, visible: Tensor, before: Tensor) -> TensorDictBase:
        tensordict.set(self.out_keys[0], torch.where(visible.unsqueeze(-1), position, before))
        return tensordict.set(self.out_keys[1], visible)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write positions and visibility of a frame, or of sequences ``[..., T]``, where a hidden object stays put."""
        position, visible = self._estimate(tensordict)
        if tensordict.ndim:
            time = tensordict.ndim - 1
            is_init = tensordict.get(self.is_init, None)
            if is_init is not None:
                is_init = is_init.reshape(*tensordict.shape, 1).movedim(time, 0)
            position = position.movedim(time, 0)
            position = hold_last_seen(position, visible.movedim(time, 0), torch.zeros_like(position[0]), is_init)
            position = position.movedim(0, time)
        return self._write(tensordict, position, visible, position)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._write(next_tensordict, *self._estimate(next_tensordict), tensordict.get(self.out_keys[0]))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        position, visible = self._estimate(tensordict_reset)
        return self._write(tensordict_reset, position, visible, torch.zeros_like(position))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the positions, and whether objects are visible, to the observations."""
        batch_and_objects = observation_spec[self.masks].shape[:-2]
        device = observation_spec.device
        position = Unbounded((*batch_and_objects, len(self.axes)), dtype=torch.float32, device=device)
        observation_spec.set(self.out_keys[0], position)
        observation_spec.set(self.out_keys[1], Binary(shape=batch_and_objects, dtype=torch.bool, device=device))
        return observation_spec


def _matrix(name: str, value: Any, size: int) -> Tensor:
    matrix = torch.as_tensor(value, dtype=torch.float32)
    if matrix.shape != (size, size):
        raise ValueError(f"the camera's {name} must be a matrix [{size}, {size}], got shape {tuple(matrix.shape)}")
    return matrix
