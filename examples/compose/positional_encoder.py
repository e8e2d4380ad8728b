"""Positions as goals for object latents of your own: ``python examples/compose/positional_encoder.py``.

The encoder is yours and stays as it is: here an autoencoder of the pictures of single objects. A
``LatentPositionalEncoder`` learns which latent an object has at a position. The latent of a goal position is then what
your encoder would see there, without a picture of the goal.

The table compares the latent of each goal position with those of 500 new frames, one of which has the object there:
cosine with that one and with the others (their difference is the contrast), its rank by cosine, and how far from the
goal the object is in the frame that fits best.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor, nn
from tqdm import trange

from torchrl_ocwm.evaluation import match
from torchrl_ocwm.modules import LatentPositionalEncoder
from torchrl_ocwm.objectives import positional_latent_loss

COLOURS = torch.tensor([[1.0, 0.3, 0.1], [0.1, 0.5, 1.0]])  # of the objects
SIZE, FEATURES, BATCH = 16, 32, 64


def draw_frames(number: int) -> tuple[Tensor, Tensor]:
    """Positions ``[N, O, 2]`` in metres, and images ``[N, O, 3, H, W]`` that show each object alone."""
    positions = 0.4 * torch.rand(number, len(COLOURS), 2) - 0.2
    places = torch.stack(torch.meshgrid(*2 * [torch.linspace(-0.25, 0.25, SIZE)], indexing="xy"), -1)
    away = places - positions[..., None, None, :]
    shapes = (-away.square().sum(-1) / 0.05**2).exp()
    return positions, shapes.unsqueeze(-3) * COLOURS[..., None, None]


def train_autoencoder(steps: int) -> nn.Module:
    """Your encoder of objects; from here on nothing changes it."""
    pixels = 3 * SIZE * SIZE
    encoder = nn.Sequential(nn.Flatten(-3), nn.Linear(pixels, 128), nn.ELU(), nn.Linear(128, FEATURES))
    decoder = nn.Sequential(
        nn.Linear(FEATURES, 128), nn.ELU(), nn.Linear(128, pixels), nn.Unflatten(-1, (3, SIZE, SIZE))
    )
    optimizer = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], 1e-3)
    for _ in trange(steps, desc="autoencoder"):
        images = draw_frames(BATCH)[1]
        loss = (decoder(encoder(images)) - images).square().sum((-3, -2, -1)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return encoder.requires_grad_(False)


def train_positional_encoder(encoder: nn.Module, steps: int) -> LatentPositionalEncoder:
    """Learn the latents of positions, which go in as numbers from -1 to 1."""
    positional = LatentPositionalEncoder(2, objects=len(COLOURS), features=FEATURES, layers=2, units=128)
    optimizer = torch.optim.Adam(positional.parameters(), 1e-3)
    for _ in trange(steps, desc="positional encoder"):
        positions, images = draw_frames(BATCH)
        visible = torch.ones(positions.shape[:-1], dtype=torch.bool)
        loss = positional_latent_loss(positional(positions / 0.2), encoder(images), visible, gradient="encoder")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return positional


def main(steps: int = 1000, seed: int = 0) -> list[dict[str, float]]:
    torch.manual_seed(seed)
    encoder = train_autoencoder(steps)
    positional = train_positional_encoder(encoder, steps)
    positions, images = draw_frames(500)
    with torch.no_grad():
        goals, latents = positional(positions / 0.2), encoder(images)
    results = [match(goals[:, i], latents[:, i], positions[:, i]) for i in range(len(COLOURS))]
    print("object  cosine  with others  median rank of 500  best match is away")
    for i, found in enumerate(results):
        print(
            f"{i:6}  {found['cosine']:6.3f}  {found['cosine_with_others']:11.3f}  {found['median_rank']:18.0f}"
            f"  {100 * found['distance']:15.1f} cm"
        )
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000, help="of each of the two trainings")
    parser.add_argument("--seed", type=int, default=0)
    main(**vars(parser.parse_args()))
