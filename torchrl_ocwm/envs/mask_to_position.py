"""Transforms from segmentation masks to object positions: with one camera, and with several."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, TypeAlias, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import Transform

from torchrl_ocwm.envs.keys import read
from torchrl_ocwm.envs.positions import hold_last_seen, mask_centroid, masks_to_positions
from torchrl_ocwm.envs.rays import check_distortion, intersect_rays, pixel_rays, undistort

Matrix: TypeAlias = Tensor | np.ndarray


class View(nn.Module):
    """What one camera adds to a position: which masks it makes, and where its pixels lie in the world.

    Args:
        intrinsics: ``[3, 3]`` pinhole matrix in pixels, or the key that holds one per step.
        extrinsics: ``[4, 4]`` camera-to-world matrix (x right, y down, z into the scene) in metres, or its key: a
            camera that moves.
        distortion: ``[K]`` OpenCV's coefficients of the lens (:func:`~torchrl_ocwm.envs.undistort`).
        masks: Key of the masks, ``[..., O, H, W]`` bool, or integers that are 0 outside the object.

    Raises:
        ValueError: for a matrix or coefficients of another shape.

    Examples:
        >>> View(torch.eye(3), "camera_to_world").keys
        ['masks', 'camera_to_world']
    """

    distortion: Tensor | None

    def __init__(
        self,
        intrinsics: Matrix | NestedKey,
        extrinsics: Matrix | NestedKey,
        *,
        distortion: Tensor | Sequence[float] | None = None,
        masks: NestedKey = "masks",
    ) -> None:
        super().__init__()
        matrices = {"intrinsics": (intrinsics, 3), "extrinsics": (extrinsics, 4)}
        self._matrix_keys = {name: value for name, (value, _) in matrices.items() if isinstance(value, (str, tuple))}
        for name, (value, size) in matrices.items():
            if name not in self._matrix_keys:
                self.register_buffer(name, _matrix(name, value, size))
        self.register_buffer("distortion", None if distortion is None else _coefficients(distortion))
        self.masks = masks

    @property
    def keys(self) -> list[NestedKey]:
        """What is read."""
        return [self.masks, *self._matrix_keys.values()]

    def matrices(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Intrinsics ``[..., 3, 3]`` and extrinsics ``[..., 4, 4]``."""
        return self._matrix("intrinsics", tensordict), self._matrix("extrinsics", tensordict)

    def _matrix(self, name: str, tensordict: TensorDictBase) -> Tensor:
        key = self._matrix_keys.get(name)
        return getattr(self, name) if key is None else read(self, tensordict, key)

    def rays(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Origins and directions ``[..., O, 3]`` of the rays through the objects, and ``[..., O]`` which it sees."""
        centroid, count = mask_centroid(read(self, tensordict, self.masks).bool())
        intrinsics, extrinsics = (matrix.float() for matrix in self.matrices(tensordict))
        if self.distortion is not None:
            centroid = undistort(centroid, intrinsics, self.distortion)
        origin, directions = pixel_rays(centroid, intrinsics, extrinsics)
        return origin.expand_as(directions), directions, count.squeeze(-1) > 0


class _ToPosition(Transform):
    """Positions and visibility of objects; a hidden object keeps the position where it was last seen."""

    def __init__(
        self,
        inputs: list[NestedKey],
        *,
        masks: NestedKey,
        start: tuple[float, float, float],
        axes: tuple[int, ...],
        is_init: NestedKey,
        object_position: NestedKey,
        object_visible: NestedKey,
    ) -> None:
        super().__init__(in_keys=inputs, out_keys=[object_position, object_visible])
        self.register_buffer("start", torch.as_tensor(start, dtype=torch.float32))
        self.masks, self.is_init, self.axes = masks, is_init, list(axes)

    @abstractmethod
    def _locate(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Positions ``[..., O, 3]`` in the world, metres, and ``[..., O]`` bool, which are known."""

    def _estimate(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        position, visible = self._locate(tensordict)
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


class MaskToPosition(_ToPosition):
    """Estimate object positions from segmentation masks, in an environment or in a replay buffer.

    Works on any masks, depth and camera matrices, of a simulator or of a real camera. Pixels without a valid depth
    (zero, negative, infinite, not a number) are ignored. An object that cannot be seen keeps the position where it was
    last seen in its episode, zero if it was not seen yet, and is flagged. So is one without any valid depth, or whose
    ray misses the plane.

    Args:
        intrinsics: ``[3, 3]`` pinhole matrix in pixels, or the key that holds one per step.
        extrinsics: ``[4, 4]`` camera-to-world matrix (x right, y down, z into the scene) in metres, or its key: a
            camera that moves.
        distortion: ``[K]`` OpenCV's coefficients of the lens (:func:`~torchrl_ocwm.envs.undistort`).
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
        ValueError: unless exactly one of ``depth`` and ``plane`` is given; for a matrix or coefficients of another
            shape, a plane without a direction, masks of probabilities, depth of integers.
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
        distortion: Tensor | Sequence[float] | None = None,
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
        view = View(intrinsics, extrinsics, distortion=distortion, masks=masks)
        super().__init__(
            [*view.keys, *([depth] if depth is not None else [])],
            masks=masks,
            start=start,
            axes=axes,
            is_init=is_init,
            object_position=object_position,
            object_visible=object_visible,
        )
        self.view, self.depth = view, depth
        self.register_buffer("plane", None if plane is None else torch.as_tensor(plane, dtype=torch.float32))

    def _locate(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        return masks_to_positions(
            read(self, tensordict, self.masks),
            *self.view.matrices(tensordict),
            distortion=self.view.distortion,
            depth=None if self.depth is None else read(self, tensordict, self.depth),
            plane=self.plane,
        )


class ViewsToPosition(_ToPosition):
    """Estimate object positions from the masks of two or more cameras, without depth and without a plane.

    The position is the point nearest to the rays through the centroids (:func:`~torchrl_ocwm.envs.intersect_rays`). An
    object counts as visible if all cameras see it; otherwise it keeps its position, as with
    :class:`~torchrl_ocwm.envs.MaskToPosition`.

    Args:
        views: The cameras, each with masks under a key of its own, of the same objects in the same order.
        start: ``[3]`` world position that the output is relative to, metres.
        axes: Which world axes to keep.
        is_init: Key that says where episodes start, ``[..., 1]`` bool; read by :meth:`forward` where it is present.
        object_position: Key written, ``[..., O, len(axes)]`` float32, metres from ``start``.
        object_visible: Key written, ``[..., O]`` bool.

    Raises:
        ValueError: for less than two views, or two with the same masks.
        KeyError: if masks or a camera matrix are missing from the data.

    Examples:
        >>> from tensordict import TensorDict
        >>> intrinsics = torch.tensor([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]])
        >>> right = torch.eye(4)
        >>> right[0, 3] = 0.4  # metres beside the first camera
        >>> transform = ViewsToPosition([View(intrinsics, torch.eye(4)), View(intrinsics, right, masks="right")])
        >>> masks = torch.zeros(2, 1, 10, 10, dtype=torch.bool)
        >>> masks[0, 0, 4:6, 6:8] = masks[1, 0, 4:6, 4:6] = True
        >>> transform(TensorDict({"masks": masks[0], "right": masks[1]}))["object_position"]
        tensor([[0.4000, 0.0000, 2.0000]])
    """

    def __init__(
        self,
        views: Sequence[View],
        *,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        axes: tuple[int, ...] = (0, 1, 2),
        is_init: NestedKey = "is_init",
        object_position: NestedKey = "object_position",
        object_visible: NestedKey = "object_visible",
    ) -> None:
        masks = [view.masks for view in views]
        if len(set(masks)) < max(2, len(masks)):
            raise ValueError(f"ViewsToPosition needs two or more views, each with masks of its own, got {masks}")
        super().__init__(
            list(dict.fromkeys(key for view in views for key in view.keys)),
            masks=masks[0],
            start=start,
            axes=axes,
            is_init=is_init,
            object_position=object_position,
            object_visible=object_visible,
        )
        self.views = cast(Sequence[View], nn.ModuleList(views))

    def _locate(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        with torch.autocast(self.start.device.type, enabled=False):  # half precision does not count pixels
            rays = [view.rays(tensordict) for view in self.views]
            origins, directions, seen = map(torch.stack, zip(*rays, strict=True))
            position = intersect_rays(origins, directions)
        visible = seen.all(0) & position.isfinite().all(-1)
        return torch.where(visible.unsqueeze(-1), position, 0), visible


def _matrix(name: str, value: Any, size: int) -> Tensor:
    matrix = torch.as_tensor(value, dtype=torch.float32)
    if matrix.shape != (size, size):
        raise ValueError(f"the camera's {name} must be a matrix [{size}, {size}], got shape {tuple(matrix.shape)}")
    return matrix


def _coefficients(value: Any) -> Tensor:
    coefficients = torch.as_tensor(value, dtype=torch.float32)
    check_distortion(coefficients)
    return coefficients
