"""Whether a world model is object-centric, in numbers: masks and positions of what it sees and imagines."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_ocwm.evaluation.open_loop import open_loop_latents, posterior
from torchrl_ocwm.modules import ObjectWorldModel, RSSMWorldModel
from torchrl_ocwm.objectives.focus import instance_masks


def predict_latents(model: RSSMWorldModel, records: TensorDictBase, context: int) -> dict[str, TensorDictBase]:
    """Latents of what a world model sees and imagines.

    Args:
        model: The world model.
        records: ``[N, T]`` records, the first of each sequence with ``is_init`` set.
        context: Frames that are seen.

    Returns:
        ``filtered``: all frames are seen; ``imagined``: those of the context only. Each ``[N, T]`` with ``state`` and
        ``belief``.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> model = build_agent("focus_pcp", reacher_task(), size="debug").model
        >>> views = predict_latents(model, random_records(reacher_task(), 3, 8), context=2)
        >>> {name: tuple(latents.shape) for name, latents in views.items()}
        {'filtered': (3, 8), 'imagined': (3, 8)}
    """
    return {
        "filtered": posterior(model, records, "state", "belief"),
        "imagined": open_loop_latents(model, records, context),
    }


def predict_objects(model: ObjectWorldModel, records: TensorDictBase, context: int) -> dict[str, TensorDictBase]:
    """:func:`predict_latents` with the ``colours`` and ``masks`` of :func:`decode_objects`.

    These take 64 KiB for each object in an image of 64 x 64.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> model = build_agent("focus_pcp", reacher_task(), size="debug").model
        >>> views = predict_objects(model, random_records(reacher_task(), 3, 8), context=2)
        >>> views["imagined"]["masks"].shape
        torch.Size([3, 8, 2, 64, 64])
    """
    views = predict_latents(model, records, context)
    for latents in views.values():
        latents["colours"], latents["masks"] = decode_objects(model, latents)
    return views


def object_errors(
    model: RSSMWorldModel, records: TensorDictBase, context: int, *, views: Mapping[str, TensorDictBase] | None = None
) -> dict[str, dict[str, Tensor]]:
    """How far off masks and positions are in the frames after the context, step by step.

    Args:
        model: The world model.
        records: ``[N, T]`` records, the first of each sequence with ``is_init`` set.
        context: Frames that are seen.
        views: What :func:`predict_latents` or :func:`predict_objects` gives for these, if it is there already.

    Returns:
        ``filtered``: all frames are seen; ``imagined``: those of the context only; ``unmoved``: the guess that objects
        stay where they were last seen. In each, if the model has them, ``mask_overlap`` ``[O, T - context]``, mean
        intersection over union, and ``lower``, ``median`` and ``upper`` ``[O, T - context]``, quartiles of the distance
        from the recorded position in metres.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> model = build_agent("focus_pcp", reacher_task(), size="debug").model
        >>> errors = object_errors(model, random_records(reacher_task(), 3, 8), context=2)
        >>> errors["imagined"]["median"].shape
        torch.Size([1, 6])
    """
    views = predict_latents(model, records, context) if views is None else views
    views, future = {name: latents[:, context:] for name, latents in views.items()}, records[:, context:]
    errors: dict[str, dict[str, Tensor]] = {name: {} for name in (*views, "unmoved")}
    if "object_position" in model.decoded:
        errors = {name: quartiles(position_error(model, latents, future)) for name, latents in views.items()}
        errors["unmoved"] = quartiles(unmoved_error(records, context)[:, context:])
    if isinstance(model, ObjectWorldModel):
        masks = instance_masks(records["next", "masks"])[..., :-1, :, :]
        overlaps = {name: mask_overlap(model, latents, masks[:, context:]) for name, latents in views.items()}
        overlaps["unmoved"] = intersection_over_union(masks[:, context - 1 : context], masks[:, context:])
        for name, overlap in overlaps.items():
            errors[name]["mask_overlap"] = overlap.nanmean(0).mT
    return errors


@torch.no_grad()
def decode_objects(model: ObjectWorldModel, latents: TensorDictBase) -> tuple[Tensor, Tensor]:
    """What a world model says that its objects look like, and where they are in the image.

    Args:
        model: The world model.
        latents: ``[...]`` with ``state`` and ``belief``.

    Returns:
        Colours ``[..., O + 1, 3, H, W]`` in [0, 1], unbounded, and masks ``[..., O + 1, H, W]``, probabilities that
        add up to one over the instances; the background is the last.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import reacher_task
        >>> model = build_agent("focus_pcp", reacher_task(), size="debug").model
        >>> latents = TensorDict({"state": torch.zeros(3, 16), "belief": torch.zeros(3, 16)}, [3])
        >>> colours, masks = decode_objects(model, latents)
        >>> colours.shape, masks.shape
        (torch.Size([3, 2, 3, 64, 64]), torch.Size([3, 2, 64, 64]))
    """
    colours, logits = model.object_decoder(model.extractor(latents["state"], latents["belief"]))
    return colours, logits.softmax(-3)


def mask_overlap(model: ObjectWorldModel, latents: TensorDictBase, masks: Tensor) -> Tensor:
    """Intersection over union of the masks that a world model predicts and the true ones.

    Args:
        model: The world model.
        latents: ``[N, T]`` with ``state`` and ``belief``, and ``masks`` if they are decoded already.
        masks: True masks ``[N, T, O, H, W]`` bool. Where objects overlap, the first of them has the pixel.

    Returns:
        ``[N, T, O]``, NaN where an object is neither there nor predicted.
    """
    steps = zip(latents.unbind(1), masks.unbind(1), strict=True)
    decoded = "masks" in latents.keys()
    return torch.stack(
        [_overlap(step["masks"] if decoded else decode_objects(model, step)[1], true) for step, true in steps], 1
    )


def _overlap(probabilities: Tensor, masks: Tensor) -> Tensor:
    """:func:`intersection_over_union` of ``[..., O + 1, H, W]`` and ``[..., O, H, W]``, without the background."""
    return intersection_over_union(most_likely(probabilities), instance_masks(masks))[..., :-1]


def most_likely(masks: Tensor) -> Tensor:
    """Masks as probabilities ``[..., N, H, W]`` to masks ``[..., N, H, W]`` bool: each pixel has one instance.

    Examples:
        >>> most_likely(torch.tensor([[0.9, 0.2], [0.1, 0.8]]).unsqueeze(-1)).squeeze(-1)
        tensor([[ True, False],
                [False,  True]])
    """
    instances = torch.arange(masks.shape[-3], device=masks.device).reshape(-1, 1, 1)
    return masks.argmax(-3, keepdim=True) == instances


def intersection_over_union(predicted: Tensor, true: Tensor) -> Tensor:
    """How well masks ``[..., H, W]`` bool cover each other, ``[...]`` in [0, 1]; NaN where both are empty.

    Examples:
        >>> intersection_over_union(torch.tensor([[True, True, False]]), torch.tensor([[False, True, True]]))
        tensor(0.3333)
    """
    return (predicted & true).sum((-2, -1)) / (predicted | true).sum((-2, -1))


@torch.no_grad()
def position_error(model: RSSMWorldModel, latents: TensorDictBase, records: TensorDictBase) -> Tensor:
    """Distance between the object positions that a world model decodes and the recorded ones.

    Args:
        model: A world model that decodes object positions.
        latents: ``[N, T]`` with ``state`` and ``belief``.
        records: ``[N, T]`` records.

    Returns:
        ``[N, T, O]`` metres, NaN where an object is hidden.
    """
    decoded = model.object_position()(TensorDict({"latent": latents}, latents.batch_size))["object_units"]
    positions = model.units.to_metres(decoded.unflatten(-1, (-1, model.units.dim)))
    return _distance(positions, records)


def unmoved_error(records: TensorDictBase, context: int) -> Tensor:
    """Distance of the objects from where they were last seen, as far off as a guess that they do not move.

    Args:
        records: ``[N, T]`` records.
        context: Frames that are seen.

    Returns:
        ``[N, T, O]`` metres, NaN where an object is hidden.
    """
    return _distance(records["next", "object_position"][:, context - 1 : context], records)


def _distance(positions: Tensor, records: TensorDictBase) -> Tensor:
    error = torch.linalg.vector_norm(positions - records["next", "object_position"], dim=-1)
    return error.where(records["next", "object_visible"], torch.nan)


def quartiles(values: Tensor) -> dict[str, Tensor]:
    """Median and quartiles over the sequences, step by step; NaN counts nothing.

    Args:
        values: ``[N, T, O]``.

    Returns:
        ``lower``, ``median`` and ``upper``, each ``[O, T]``.

    Examples:
        >>> quartiles(torch.tensor([0.0, 1.0, 2.0, 3.0, 9.0]).reshape(5, 1, 1))
        {'lower': tensor([[1.]]), 'median': tensor([[2.]]), 'upper': tensor([[3.]])}
    """
    shares = torch.tensor([0.25, 0.5, 0.75], device=values.device)
    found = values.nanquantile(shares, dim=0).mT
    return dict(zip(("lower", "median", "upper"), found, strict=True))
