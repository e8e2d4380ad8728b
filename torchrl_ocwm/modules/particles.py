"""Exploration by entropy: states that lie far from their neighbours are worth a visit."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint


def particle_entropy(particles: Tensor, *, k: int = 12, clip: float = 0.0, chunk: int = 1024) -> Tensor:
    """What each particle adds to the entropy of all: how far it lies from its k nearest neighbours (APT, FOCUS).

    log(1 + the mean of max(d − clip, 0) over the distances d to the k nearest others). Gradients go through the
    particle and its neighbours. Distances are computed again in the backward pass, so that memory grows with N, not N².

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
    particles = particles.float()
    count = min(k, particles.shape[-2] - 1)

    def distance(part: Tensor) -> Tensor:
        nearest = torch.cdist(part, particles).topk(count + 1, largest=False).values[..., 1:]  # the first is itself
        return (nearest - clip).clamp_min(0).sum(-1) / max(count, 1)

    parts = [
        checkpoint(distance, part, use_reentrant=False, preserve_rng_state=False) for part in particles.split(chunk, -2)
    ]
    return torch.cat(parts, -1).log1p()


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
