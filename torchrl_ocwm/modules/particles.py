"""Exploration by entropy: states that lie far from their neighbours are worth a visit."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, cdist, nn
from torch.autograd.function import once_differentiable


def particle_entropy(particles: Tensor, *, k: int = 12, clip: float = 0.0, chunk: int = 1024) -> Tensor:
    """What each particle adds to the entropy of all: how far it lies from its k nearest neighbours (APT, FOCUS).

    log(1 + the mean of max(d − clip, 0) over the distances d to the k nearest others). Gradients go through the
    particle and its neighbours. Memory grows with N, not N².

    Args:
        particles: ``[..., N, F]``; all in the last but one dimension are compared.
        k: Neighbours; all others, if there are fewer.
        clip: Distance that counts as none.
        chunk: Particles that are compared with all others at a time.

    Returns:
        ``[..., N]``; zeros for a single particle.

    Examples:
        >>> particle_entropy(torch.tensor([[0.0], [1.0], [4.0]]), k=1).expm1()
        tensor([1., 1., 3.])
    """
    count = min(k, particles.shape[-2] - 1)
    nearest = _NearestDistances.apply(particles.float(), count, chunk)
    return ((nearest - clip).clamp_min(0).sum(-1) / max(count, 1)).log1p()


class _NearestDistances(torch.autograd.Function):
    """Distances ``[..., N, k]`` of particles ``[..., N, F]`` from their nearest others.

    Which these are is found once, and kept for the backward pass: finding them takes longer than the distances.
    """

    @staticmethod
    def forward(ctx: Any, particles: Tensor, k: int, chunk: int) -> Tensor:
        found = [cdist(part, particles).topk(k + 1, largest=False) for part in particles.split(chunk, -2)]
        distances, index = (torch.cat([one[i][..., 1:] for one in found], -2) for i in (0, 1))  # the first is itself
        ctx.save_for_backward(particles, distances, index)
        ctx.chunk = chunk
        return distances

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        particles, distances, index = ctx.saved_tensors
        # d = |x − y| has the gradient (x − y) / d by x, and the negative of it by y.
        pull = torch.where(distances > 0, gradient / distances, 0)
        own, others = [], torch.zeros_like(particles)
        for x, weight, nearest in zip(*(one.split(ctx.chunk, -2) for one in (particles, pull, index)), strict=True):
            weights = x.new_zeros(*x.shape[:-1], particles.shape[-2]).scatter(-1, nearest, weight)
            own.append(x * weight.sum(-1, keepdim=True) - weights @ particles)
            others = others + particles * weights.sum(-2).unsqueeze(-1) - weights.mT @ x
        return torch.cat(own, -2) + others, None, None


class ParticleEntropy(nn.Module):
    """:func:`particle_entropy` of each of a batch of states among all of them, summed over objects.

    Args:
        k: Neighbours.
        clip: Distance that counts as none.
        chunk: States that are compared with all others at a time.

    Called with object latents ``[*batch, O, L]``; returns ``[*batch, 1]``. All of ``batch`` are compared with each
    other, object by object; imagination gives all states of all rollouts at once.

    Examples:
        >>> ParticleEntropy(k=3)(torch.rand(5, 4, 2, 8)).shape
        torch.Size([5, 4, 1])
    """

    def __init__(self, *, k: int, clip: float = 0.0, chunk: int = 1024) -> None:
        super().__init__()
        self.k, self.clip, self.chunk = k, clip, chunk

    def forward(self, latents: Tensor) -> Tensor:
        """The entropy ``[..., 1]`` at each of the latents ``[..., O, L]``, summed over the objects."""
        *batch, objects, features = latents.shape
        particles = latents.reshape(-1, objects, features).transpose(0, 1)
        entropy = particle_entropy(particles, k=self.k, clip=self.clip, chunk=self.chunk)
        return entropy.sum(0).reshape(*batch, 1)


class EntropyReward(TensorDictModule):
    """How far the latents of objects lie from those of other imagined states (FOCUS; APT on a flat latent).

    Args:
        k: Neighbours.
        clip: Distance that counts as none.
        latent_key: Object latents ``[..., O, L]``; flat latents ``[..., L]`` with ``flat``.
        flat: Whether they are flat.
        reward_key: Key written, ``[..., 1]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> reward = EntropyReward(k=2, latent_key=("latent", "belief"), flat=True)
        >>> reward(TensorDict({"latent": {"belief": torch.rand(5, 3)}}, [5]))["reward"].shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        *,
        k: int,
        clip: float = 0.0,
        latent_key: NestedKey = "object_latent",
        flat: bool = False,
        reward_key: NestedKey = "reward",
    ) -> None:
        entropy = ParticleEntropy(k=k, clip=clip)
        module = nn.Sequential(nn.Unflatten(-1, (1, -1)), entropy) if flat else entropy
        super().__init__(module, in_keys=[latent_key], out_keys=[reward_key])
