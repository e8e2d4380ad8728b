"""Masks by SAM 2, which is shown the objects once and tracks them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_ocwm.envs.keys import read
from torchrl_ocwm.envs.masks import ToMasks, check_clicks, check_images
from torchrl_ocwm.envs.missing import needs

_QUALITY = 100  # of the JPEG files that the predictor reads


class SAM2Masks(ToMasks):
    """Find objects with SAM 2's video predictor: ``pixels`` → ``masks``, ``object_visible``.

    Stands before :class:`~torchrl_ocwm.envs.MaskToPosition`, as :class:`~torchrl_ocwm.envs.ColourMasks` does, where
    colours are not enough. You bring the weights, and click on the objects in one or a few frames. These are put
    before each sequence, as the beginning of its video, and the predictor tracks the objects from there. So they are
    enough for a whole dataset (:func:`~torchrl_ocwm.data.transform_dataset`).

    In an environment, each step is a video of its own: the prompted frames and the frame of that moment. This is slow,
    and the predictor does not remember the steps before.

    **This class has not been run with trained weights.** It is written for ``SAM2VideoPredictor`` of the package
    ``sam2`` 1.1 (``device``, ``init_state``, ``add_new_points_or_box``, ``propagate_in_video``). It ran through with
    that package and random weights, and is tested with a stand-in of this interface. How well SAM 2 finds things in
    images as small as 64 × 64, and over the cut from the prompts to an episode, is not known here: look at the masks
    before you train on them, and rather give it large images.

    Args:
        predictor: A ``SAM2VideoPredictor``, or what has its methods.
        prompts: ``[F, 3, H, W]`` uint8, frames in which the objects were clicked on, as large as those to come.
        points: ``[F, O, N, 2]`` clicks on each object as (column, row), NaN for those that are fewer or missing. Each
            object has at least one.
        pixels: Key of the images, ``[..., 3, H, W]`` uint8.
        masks: Key written, ``[..., O, H, W]`` bool.
        object_visible: Key written, ``[..., O]`` bool: whether the mask has a pixel.
        is_init: Key that says where episodes start, ``[..., 1]`` bool; read by :meth:`forward` where it is present. A
            new video starts there.

    Raises:
        KeyError: if there are no images.
        ValueError: for images or points of another shape or dtype, or an object without a click.
        MissingPackageError: if the package is missing, with the extra to install.

    Examples:
        >>> masks = SAM2Masks.load("configs/sam2.1/sam2.1_hiera_t.yaml", "sam2.1_hiera_tiny.pt",
        ...     prompts=frames, points=clicks)  # doctest: +SKIP
        >>> dataset = transform_dataset(recorded, "data/with_masks", masks)  # doctest: +SKIP
    """

    def __init__(
        self,
        predictor: Any,
        *,
        prompts: Tensor,
        points: Tensor,
        pixels: NestedKey = "pixels",
        masks: NestedKey = "masks",
        object_visible: NestedKey = "object_visible",
        is_init: NestedKey = "is_init",
    ) -> None:
        check_images(prompts, "prompts")
        check_clicks(prompts, points)
        super().__init__(points.shape[1], pixels=pixels, masks=masks, object_visible=object_visible)
        self.register_buffer("prompts", prompts)
        self.register_buffer("points", points)
        self.predictor, self.is_init = predictor, is_init

    @classmethod
    def load(cls, config: str, weights: str | Path, *, device: torch.device | str = "cpu", **options: Any) -> SAM2Masks:
        """Load the predictor with your weights.

        Args:
            config: Name of SAM 2's configuration of these weights, such as ``configs/sam2.1/sam2.1_hiera_t.yaml``.
            weights: Their file.
            device: Where it runs.
            options: Passed to the class.

        Raises:
            FileNotFoundError: if there are no weights.
            MissingPackageError: if the package is missing, with the extra to install.
        """
        with needs("SAM2Masks", "sam2"):
            from sam2.build_sam import build_sam2_video_predictor
        if not Path(weights).is_file():
            raise FileNotFoundError(f"{weights}: no weights of SAM 2 here; its authors' repository says where they are")
        return cls(build_sam2_video_predictor(config, str(weights), device=str(device)), **options)

    def track(self, video: Tensor) -> Tensor:
        """Masks ``[T, O, H, W]`` bool of a video ``[T, 3, H, W]`` uint8."""
        check_images(video)
        if video.shape[1:] != self.prompts.shape[1:]:
            raise ValueError(
                f"images must be as large as the prompts, {(*self.prompts.shape[1:],)}, got {(*video.shape[1:],)}"
            )
        frames = torch.cat([self.prompts, video.to(self.prompts.device)])
        masks = torch.zeros(len(frames), self.points.shape[1], *frames.shape[2:], dtype=torch.bool)
        # The predictor keeps its memory in bfloat16, also where its weights are float32.
        half = torch.autocast(torch.device(self.predictor.device).type, dtype=torch.bfloat16)
        with TemporaryDirectory() as folder, torch.inference_mode(), half:
            _save(frames, Path(folder))
            state = self.predictor.init_state(video_path=folder)
            self._prompt(state)
            for number, objects, logits in self.predictor.propagate_in_video(state):
                masks[number, objects] = (logits > 0).squeeze(1).cpu()
        return masks[len(self.prompts) :].to(video.device)

    def _prompt(self, state: Any) -> None:
        for frame, objects in enumerate(self.points.cpu()):
            for number, clicks in enumerate(objects):
                clicks = clicks[clicks.isfinite().all(-1)]
                if len(clicks):
                    labels = torch.ones(len(clicks), dtype=torch.int32)  # on the object
                    self.predictor.add_new_points_or_box(
                        state, frame_idx=frame, obj_id=number, points=clicks.float(), labels=labels
                    )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Track through a frame, or through sequences ``[..., T]``; a new episode is a new video."""
        pixels = read(self, tensordict, self.in_keys[0])
        sequences = pixels.reshape(-1, *(tensordict.shape[-1:] or (1,)), *pixels.shape[-3:])
        is_init = tensordict.get(self.is_init, None)
        starts = torch.zeros(sequences.shape[:2], dtype=torch.bool) if is_init is None else is_init
        starts = starts.reshape(sequences.shape[:2])
        tracked = [
            self.track(video) for sequence in zip(sequences, starts, strict=True) for video in _videos(*sequence)
        ]
        return self._write(tensordict, _like(torch.cat(tracked), pixels))

    def segment(self, pixels: Tensor) -> Tensor:
        """Masks ``[..., O, H, W]`` bool of images ``[..., 3, H, W]`` uint8, each tracked from the prompts alone."""
        frames = pixels.reshape(-1, 1, *pixels.shape[-3:])
        return _like(torch.cat([self.track(frame) for frame in frames]), pixels)


def _like(masks: Tensor, pixels: Tensor) -> Tensor:
    return masks.reshape(*pixels.shape[:-3], *masks.shape[1:])


def _videos(sequence: Tensor, starts: Tensor) -> Iterator[Tensor]:
    """``[T, 3, H, W]`` cut where episodes start."""
    cuts = [0, *(starts[1:].nonzero().flatten() + 1).tolist(), len(sequence)]
    return (sequence[begin:end] for begin, end in pairwise(cuts))


def _save(frames: Tensor, folder: Path) -> None:
    """As files ``0.jpg``, ``1.jpg``, …, which the predictor reads."""
    with needs("SAM2Masks", "sam2"):
        from PIL import Image

    for number, frame in enumerate(frames.movedim(1, -1).cpu().numpy()):
        Image.fromarray(frame).save(folder / f"{number}.jpg", quality=_QUALITY, subsampling=0)
