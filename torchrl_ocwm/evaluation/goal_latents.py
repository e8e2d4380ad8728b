"""How well the latents that goals are made of match those of frames with the object there."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import cosine_similarity

from torchrl_ocwm.evaluation.open_loop import posterior
from torchrl_ocwm.modules import ObjectWorldModel


def latent_pairs(
    model: ObjectWorldModel, records: TensorDictBase, *, frames: int = 100, object_index: int = 0, seed: int = 0
) -> tuple[dict[str, tuple[Tensor, Tensor]], Tensor]:
    """The latents of an object that should be the same: of its position, of a frame, and of the frame's image alone.

    Args:
        model: A world model with a positional encoder.
        records: ``[N, T]`` records, the first of each sequence with ``is_init`` set.
        frames: Frames K to take at random of those in which the object is visible; all, if they are fewer.
        object_index: Which object.
        seed: Of the choice.

    Returns:
        What is compared with what → goal latents ``[K, L]`` and the latents ``[K, L]`` that they stand for; and the
        object's positions ``[K, D]`` in metres in these frames.
    """
    visible = records["next", "object_visible"][..., object_index].flatten().nonzero().squeeze(-1)
    generator = torch.Generator().manual_seed(seed)
    chosen = visible[torch.randperm(len(visible), generator=generator)[:frames].to(visible.device)]
    names = ("positional_latent", "image_latent", "object_latent")
    latents = posterior(model, records, *names).flatten()[chosen]
    position, image, frame = (latents[name][:, object_index] for name in names)
    pairs = {
        "position, frame": (position, frame),
        "image, frame": (image, frame),
        "position, image": (position, image),
    }
    return pairs, records["next", "object_position"].flatten(0, 1)[chosen, object_index]


def cosines(goals: Tensor, latents: Tensor) -> Tensor:
    """Cosine of each of the goal latents ``[K, L]`` with each of the latents ``[M, L]``: ``[K, M]``.

    Examples:
        >>> cosines(torch.tensor([[1.0, 0.0]]), torch.tensor([[2.0, 0.0], [0.0, 1.0], [-3.0, 0.0]]))
        tensor([[ 1.,  0., -1.]])
    """
    return cosine_similarity(goals.unsqueeze(1), latents.unsqueeze(0), dim=-1)


def distances(positions: Tensor) -> Tensor:
    """Distance of each of the positions ``[K, D]`` from each: ``[K, K]``."""
    return torch.linalg.vector_norm(positions.unsqueeze(1) - positions.unsqueeze(0), dim=-1)


def ranks(similarity: Tensor) -> Tensor:
    """Rank of the true frame for each goal: one, and one more for each other frame that is more similar.

    Args:
        similarity: ``[K, K]``, goal × frame, the true frames on the diagonal.

    Returns:
        ``[K]`` int64, from 1 to K.

    Examples:
        >>> ranks(torch.tensor([[0.9, 0.5, 0.2], [0.8, 0.7, 0.1], [0.9, 0.8, 0.7]]))
        tensor([1, 2, 3])
    """
    return 1 + (similarity > similarity.diagonal().unsqueeze(1)).sum(1)


def match(goals: Tensor, latents: Tensor, positions: Tensor) -> dict[str, float]:
    """How well goal latents match the latents that they stand for, among those of other positions.

    Args:
        goals: ``[K, L]``.
        latents: ``[K, L]``, the true one of each goal in the same place.
        positions: ``[K, D]`` metres, of goals and latents.

    Returns:
        ``cosine`` with the true latent and ``cosine_with_others``, means, and ``contrast``, their difference: what of
        the cosine is about the position, 0 for latents that are the same everywhere; ``median_rank``, ``mean_rank``
        and ``ranked_first``, of the true latent (:func:`ranks`); ``distance`` in metres between the position of a goal
        and that of its best match, and ``distance_to_others`` between positions at all, means.

    Examples:
        >>> match(torch.eye(2), 3 * torch.eye(2), torch.tensor([[0.0, 0.0], [0.0, 0.1]]))["ranked_first"]
        1.0
    """
    similarity, apart = cosines(goals, latents), distances(positions)
    rank = ranks(similarity).float()
    best = similarity.argmax(1, keepdim=True)
    others = ~torch.eye(len(goals), dtype=torch.bool, device=goals.device)
    means = {
        "cosine": similarity.diagonal(),
        "cosine_with_others": similarity[others],
        "mean_rank": rank,
        "ranked_first": (rank == 1).float(),
        "distance": apart.gather(1, best),
        "distance_to_others": apart[others],
    }
    found = {name: float(values.mean()) for name, values in means.items()}
    contrast = found["cosine"] - found["cosine_with_others"]
    return {"median_rank": float(rank.quantile(0.5)), "contrast": contrast, **found}
