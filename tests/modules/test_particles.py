"""Entropy of particles, against the distances of all pairs."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_ocwm.modules import EntropyReward, particle_entropy
from torchrl_ocwm.modules.particles import ParticleEntropy


def slowly(particles: list[list[float]], k: int, clip: float) -> list[float]:
    """Pair by pair."""
    values = []
    for i, one in enumerate(particles):
        distances = sorted(math.dist(one, other) for j, other in enumerate(particles) if j != i)[:k]
        values.append(math.log1p(sum(max(d - clip, 0) for d in distances) / len(distances)))
    return values


def all_pairs(particles: Tensor, k: int) -> Tensor:
    """The whole matrix of distances at once."""
    differences = particles.unsqueeze(0) - particles.unsqueeze(1)
    others = ~torch.eye(len(particles), dtype=torch.bool)
    distances = differences[others].norm(dim=-1).reshape(len(particles), -1)
    return distances.sort(-1).values[:, :k].mean(-1).log1p()


@pytest.mark.parametrize("chunk", [1, 4, 7, 100])
@pytest.mark.parametrize(("k", "clip"), [(3, 0.0), (3, 0.9), (50, 0.0)])
def test_values(chunk: int, k: int, clip: float) -> None:
    """In parts of any size, and with fewer others than neighbours."""
    particles = torch.rand(19, 3)
    expected = slowly(particles.tolist(), k, clip)
    got = particle_entropy(particles, k=k, clip=clip, chunk=chunk)
    torch.testing.assert_close(got, torch.tensor(expected), rtol=1e-4, atol=1e-4)
    if clip:
        assert (got == 0).any() or min(expected) > 0


@pytest.mark.parametrize("chunk", [5, 100])
def test_gradients(chunk: int) -> None:
    """Through the particle and through its neighbours."""
    particles, weights = torch.randn(40, 6), torch.randn(40)
    grads = []
    for entropy in (lambda x: particle_entropy(x, k=4, chunk=chunk), lambda x: all_pairs(x, 4)):
        leaf = particles.clone().requires_grad_()
        (entropy(leaf) * weights).sum().backward()
        grads.append(leaf.grad)
    assert grads[0].isfinite().all()
    torch.testing.assert_close(grads[0], grads[1], rtol=1e-3, atol=1e-4)


def test_particles_in_one_place_have_finite_gradients() -> None:
    particles = torch.ones(10, 3, requires_grad=True)
    particle_entropy(particles, k=3).sum().backward()
    assert particles.grad.isfinite().all()


def test_a_single_particle_has_none() -> None:
    assert torch.equal(particle_entropy(torch.rand(1, 3), k=5), torch.zeros(1))


def test_memory_is_linear() -> None:
    """What is kept for the backward pass, of 8 times as many particles."""

    def kept(count: int) -> int:
        numbers: list[int] = []

        def pack(value: Tensor) -> Tensor:
            numbers.append(value.numel())
            return value

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda value: value):
            particle_entropy(torch.rand(count, 2, requires_grad=True), k=3, chunk=16)
        return sum(numbers)

    assert kept(1024) < 10 * kept(128)


def test_objects_are_judged_apart_and_summed() -> None:
    latents = torch.randn(4, 5, 3, 2)  # [N, H, O, L]
    got = ParticleEntropy(k=3)(latents)
    assert got.shape == (4, 5, 1)
    expected = sum(all_pairs(latents[:, :, number].reshape(20, 2), 3) for number in range(3))
    torch.testing.assert_close(got.flatten(), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("flat", [False, True])
def test_reward(flat: bool) -> None:
    latents = torch.randn(6, 2) if flat else torch.randn(6, 1, 2)
    reward: Any = EntropyReward(k=2, latent_key=("a", "b"), flat=flat, reward_key="bonus")
    got = reward(TensorDict({"a": {"b": latents}}, [6]))["bonus"]
    torch.testing.assert_close(got.squeeze(-1), all_pairs(latents.reshape(6, 2), 2), rtol=1e-4, atol=1e-4)


def test_compiled_it_is_the_same() -> None:
    """In one graph, as the update is compiled."""
    compiled = torch.compile(particle_entropy, backend="eager", fullgraph=True)
    particles = torch.randn(30, 4, requires_grad=True)
    grads = [
        torch.autograd.grad(one(particles, k=3, chunk=20).square().sum(), particles)[0]
        for one in (particle_entropy, compiled)
    ]
    torch.testing.assert_close(grads[0], grads[1])
