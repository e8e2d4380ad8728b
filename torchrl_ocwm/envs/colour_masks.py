"""Masks of objects by their colours, learnt from a few labelled or clicked frames."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn.functional import conv3d, pad

from torchrl_ocwm.envs.masks import ToMasks, check_clicks, check_images
from torchrl_ocwm.envs.missing import needs

_LEVELS = 32  # of red, green and blue each
_UNSEEN = 0.02  # pixels; what is a level away in red, green and blue weighs 1/64 for each labelled pixel
_POOR = 0.5


class ColourMasks(ToMasks):
    """Find objects by their colours, without a simulator or a network: ``pixels`` → ``masks``, ``object_visible``.

    Stands before :class:`~torchrl_ocwm.envs.MaskToPosition` in an environment, a replay buffer, or over a dataset
    (:func:`~torchrl_ocwm.data.transform_dataset`). Make one with :meth:`fit` or :meth:`from_clicks`. A pixel belongs to
    an object if, among the labelled pixels of its colour, most are of that object. The largest connected component is
    the mask. Where no pixel is that sure, the mask is empty and the object counts as hidden.

    It holds as long as light and camera are those of the labelled frames, and the object has colours of its own
    (docs/results/benchmarks.md has what it finds in the environments of this package).

    Args:
        objects: How many objects O; one that is made so, not fitted, waits for ``load_state_dict``.
        smallest: A component of fewer pixels counts as nothing.
        pixels: Key of the images, ``[..., 3, H, W]`` uint8.
        masks: Key written, ``[..., O, H, W]`` bool.
        object_visible: Key written, ``[..., O]`` bool: whether the mask has a pixel.

    Raises:
        KeyError: if there are no images.
        ValueError: for images of another shape or dtype.
        MissingPackageError: if OpenCV is missing, with the extra to install.

    Examples:
        >>> pixels = torch.zeros(1, 3, 8, 8, dtype=torch.uint8)
        >>> pixels[0, 0, 2:4, 3:6] = 200  # a red thing on black
        >>> transform = ColourMasks.fit(pixels, pixels[:, :1] > 0)
        >>> from tensordict import TensorDict
        >>> moved = TensorDict({"pixels": pixels.roll(2, -1)}, [1])
        >>> transform(moved)["masks"][0, 0].nonzero()[0], moved["object_visible"]
        (tensor([2, 5]), tensor([[True]]))
    """

    share: Tensor

    def __init__(
        self,
        objects: int,
        *,
        smallest: int = 1,
        pixels: NestedKey = "pixels",
        masks: NestedKey = "masks",
        object_visible: NestedKey = "object_visible",
    ) -> None:
        super().__init__(objects, pixels=pixels, masks=masks, object_visible=object_visible)
        self.smallest = smallest
        #: ``[O, 32 * 32 * 32]``: of the labelled pixels of a colour, the share that is the object's.
        self.register_buffer("share", torch.zeros(objects, _LEVELS**3))

    @classmethod
    def fit(cls, pixels: Tensor, masks: Tensor, /, **options: Any) -> ColourMasks:
        """Learn the colours of labelled frames; five are often enough, if they show the object in different places.

        Args:
            pixels: ``[F, 3, H, W]`` uint8.
            masks: ``[F, O, H, W]`` bool; of a frame that is labelled, all objects that it shows.
            options: Passed to the class.

        Raises:
            ValueError: for other shapes or dtypes, or an object without a labelled pixel.
        """
        check_images(pixels)
        if masks.dtype != torch.bool or masks.ndim != 4 or masks[:, 0].shape != pixels[:, 0].shape:
            raise ValueError(
                f"pixels {(*pixels.shape,)} need masks [F, O, H, W] of bool, got {masks.dtype} {(*masks.shape,)}"
            )
        empty = (~masks.transpose(0, 1).flatten(1).any(1)).nonzero().flatten().tolist()
        if empty:
            raise ValueError(f"objects {empty} have no pixel in any labelled frame; label frames that show them")
        transform = cls(masks.shape[1], **options)
        colours = _colours(pixels)
        seen = torch.stack([_counts(colours), *(_counts(colours[mask]) for mask in masks.unbind(1))])
        transform.share = seen[1:] / (seen[:1] + _UNSEEN)
        transform._warn_if_poor(pixels, masks)
        return transform

    @classmethod
    def from_clicks(cls, pixels: Tensor, points: Tensor, /, *, tolerance: int = 30, **options: Any) -> ColourMasks:
        """Learn the colours of what was clicked on: each click labels the pixels around it that look like it.

        Args:
            pixels: ``[F, 3, H, W]`` uint8.
            points: ``[F, O, N, 2]`` clicks on each object as (column, row), NaN for those that are fewer or missing.
                Click on each side of an object that has a shade of its own.
            tolerance: How far red, green and blue may be from those at the click, of 255.
            options: Passed to the class.

        Raises:
            ValueError: as :meth:`fit`, and for clicks beside the image.

        Examples:
            >>> pixels = torch.zeros(1, 3, 8, 8, dtype=torch.uint8)
            >>> pixels[0, 0, 2:4, 3:6] = 200
            >>> transform = ColourMasks.from_clicks(pixels, torch.tensor([[[[4.5, 2.5]]]]))
            >>> int(transform.segment(pixels).sum())
            6
        """
        check_images(pixels)
        check_clicks(pixels, points)
        masks = torch.stack(
            [
                torch.stack([_around(image, clicks, tolerance) for clicks in objects])
                for image, objects in zip(pixels, points, strict=True)
            ]
        )
        return cls.fit(pixels, masks, **options)

    def _warn_if_poor(self, pixels: Tensor, masks: Tensor) -> None:
        found = self.segment(pixels).transpose(0, 1).flatten(1)
        labelled = masks.transpose(0, 1).flatten(1)
        overlap = (found & labelled).sum(1) / (found | labelled).sum(1)
        for number in (overlap < _POOR).nonzero().flatten().tolist():
            warnings.warn(
                f"object {number} has the colours of other things: in the labelled frames its masks overlap its labels "
                f"by {overlap[number]:.2f} only (intersection over union)",
                stacklevel=3,
            )

    def segment(self, pixels: Tensor) -> Tensor:
        """Masks ``[..., O, H, W]`` bool of images ``[..., 3, H, W]`` uint8."""
        check_images(pixels)
        sure = self.share[:, _colours(pixels)] > 0.5  # of two objects, at most one
        return largest_component(sure.movedim(0, -3), self.smallest)


def largest_component(masks: Tensor, smallest: int = 1) -> Tensor:
    """Keep of each mask the largest part that hangs together, also over corners.

    Args:
        masks: ``[..., H, W]`` bool.
        smallest: A part of fewer pixels is dropped.

    Raises:
        MissingPackageError: if OpenCV is missing, with the extra to install.

    Examples:
        >>> largest_component(torch.tensor([[True, False, True, True]]))
        tensor([[False, False,  True,  True]])
    """
    with needs("ColourMasks", "camera"):
        import cv2

    height, width = masks.shape[-2:]
    images = pad(masks.reshape(-1, height, width), (0, 0, 0, 1))  # one above the other, a row apart
    column = images.flatten(0, 1).cpu().numpy().astype(np.uint8)
    _, labels, parts, _ = cv2.connectedComponentsWithStats(column, connectivity=8)
    area, image = parts[:, cv2.CC_STAT_AREA], parts[:, cv2.CC_STAT_TOP] // (height + 1)
    area[0] = 0  # what is outside of all masks
    order = area.argsort(kind="stable")
    largest = np.zeros(len(images), labels.dtype)
    largest[image[order]] = np.where(area[order] >= smallest, order, 0)  # the last of an image counts
    kept = (labels == largest.repeat(height + 1)[:, None]) & (labels > 0)
    return torch.from_numpy(kept).reshape(-1, height + 1, width)[:, :-1].reshape(masks.shape).to(masks.device)


def _colours(pixels: Tensor) -> Tensor:
    """Number of each pixel's colour, ``[..., 3, H, W]`` → ``[..., H, W]``."""
    red, green, blue = (pixels.long() * _LEVELS // 256).unbind(-3)
    return (red * _LEVELS + green) * _LEVELS + blue


def _counts(colours: Tensor) -> Tensor:
    """How many pixels have each colour or one beside it, weighted."""
    counts = colours.flatten().bincount(minlength=_LEVELS**3).float().reshape(1, 1, _LEVELS, _LEVELS, _LEVELS)
    near = torch.tensor([0.25, 0.5, 0.25], device=colours.device)
    weights = near[:, None, None] * near[:, None] * near
    return conv3d(counts, weights[None, None], padding=1).flatten()


def _around(image: Tensor, clicks: Tensor, tolerance: int) -> Tensor:
    """Mask ``[H, W]`` of what looks like the clicked pixels and hangs together with them."""
    with needs("ColourMasks", "camera"):
        import cv2

    height, width = image.shape[-2:]
    mask = np.zeros((height + 2, width + 2), np.uint8)
    picture = np.ascontiguousarray(image.movedim(0, -1).cpu().numpy())
    how = 4 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE
    for column, row in clicks[clicks.isfinite().all(-1)].tolist():
        near = (tolerance,) * 3
        cv2.floodFill(picture, mask, (int(column), int(row)), (0,), near, near, how)
    return torch.from_numpy(mask[1:-1, 1:-1] > 0).to(image.device)
