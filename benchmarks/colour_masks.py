"""How well colours find the first object (``ColourMasks``), beside the simulator's own masks.

    python benchmarks/colour_masks.py [--envs reacher cube_move] [--episodes 8] [--labelled 1 5 20] [--image-size 64]

Episodes of 60 steps, every third frame: of the scripted policy with a fifth of random actions, and of random actions,
in turn. Colours are learnt from frames of the first two episodes, evenly spread, and tested on all later ones. Labelled
by masks, or by two clicks: one in the middle of the object, and one where its colour is farthest from there. "removed"
is the share of frames in which something is still found after the place of the object was replaced by what lies there
in another frame; it should be none.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from torchrl_ocwm.envs import ENVIRONMENTS, ColourMasks, find_environment, make_scene, mask_centroid

STEPS, EVERY = 60, 3


def play(env: Any, episodes: int) -> tuple[Tensor, Tensor]:
    """``[N, 3, H, W]`` images and ``[N, H, W]`` masks of the first object."""
    random, frames = np.random.default_rng(0), []
    for episode in range(episodes):
        env.reset(seed=episode)
        for step in range(STEPS):
            wander = episode % 2 or random.random() < 0.2
            action = random.uniform(-1, 1, env.action_space.shape) if wander else env.scripted_action()
            observation = env.step(action)[0]
            if step % EVERY == 0:
                frames.append((observation["pixels"], observation["masks"][0]))
    return tuple(torch.from_numpy(np.stack(part)) for part in zip(*frames, strict=True))  # type: ignore[return-value]


def clicks(image: Tensor, mask: Tensor) -> Tensor:
    """``[2, 2]`` clicks as (column, row)."""
    places = mask.nonzero()
    middle = places[(places - places.float().mean(0)).norm(dim=-1).argmin()]
    colours = image[:, places[:, 0], places[:, 1]].float().T
    other = places[(colours - image[:, middle[0], middle[1]]).norm(dim=-1).argmax()]
    return torch.stack([middle, other]).flip(-1) + 0.5


def removed(pixels: Tensor, masks: Tensor) -> Tensor:
    """Images ``[M, 3, H, W]`` without the object, where another frame shows what lies behind it."""
    around = max_pool2d(masks.float().unsqueeze(1), 5, 1, 2).squeeze(1) > 0
    free = ~(around.unsqueeze(1) & around).flatten(2).any(2)  # [N, N]: is the place of one free in the other
    other = free.float().argmax(1)
    return torch.where(around.unsqueeze(1), pixels[other], pixels)[free.any(1)]


def cells(transform: ColourMasks, pixels: Tensor, masks: Tensor) -> Iterator[str]:
    """Overlap, share found, error of the centroid in pixels, share found after removal."""
    seen = masks.flatten(1).any(1)
    found, true = transform.segment(pixels)[seen, 0], masks[seen]
    there = found.flatten(1).any(1)
    overlap = (found & true).flatten(1).sum(1) / (found | true).flatten(1).sum(1)
    yield f"{overlap.mean():.2f}"
    yield f"{there.float().mean():.1%}"
    error = (mask_centroid(found)[0] - mask_centroid(true)[0]).norm(dim=-1)[there]
    yield from (f"{error.quantile(q):.2f}" if len(error) else "" for q in (0.5, 0.95))
    yield f"{transform.segment(removed(pixels, masks)).flatten(1).any(1).float().mean():.1%}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", choices=ENVIRONMENTS, default=[*ENVIRONMENTS])
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--labelled", type=int, nargs="+", default=[1, 5, 20])
    parser.add_argument("--image-size", type=int, default=64)
    arguments = parser.parse_args()
    size = arguments.image_size
    head = ["environment", "pixels of the object", "learnt from", "IoU", "found", "centroid, median", "95 %", "removed"]
    print(f"Images of {size} x {size}; centroids in pixels\n\n| {' | '.join(head)} |\n|---|---:|---|{'---:|' * 5}")
    for name in arguments.envs:
        env = make_scene(find_environment(name), image_size=size, horizon=10**9)
        pixels, masks = play(env, arguments.episodes)
        env.close()
        first = 2 * STEPS // EVERY
        area = f"{masks[first:].flatten(1).sum(1).float().mean():.1f}"
        for number in arguments.labelled:
            shown = masks[:first].flatten(1).any(1).nonzero().flatten()
            chosen = shown[torch.linspace(0, len(shown) - 1, number + 2).long()[1:-1]]
            images, labels = pixels[chosen], masks[chosen].unsqueeze(1)
            points = torch.stack([clicks(image, label[0]) for image, label in zip(images, labels, strict=True)])
            learnt = {
                f"{number} labelled": ColourMasks.fit(images, labels),
                f"{number} clicked": ColourMasks.from_clicks(images, points.unsqueeze(1)),
            }
            for what, transform in learnt.items():
                row = [f"`{name}`", area, what, *cells(transform, pixels[first:], masks[first:])]
                print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
