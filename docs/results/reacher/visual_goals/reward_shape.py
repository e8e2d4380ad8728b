"""How the reward imagined by agents falls with the distance of the object from the goal, by the true one.

    python docs/results/reacher/visual_goals/reward_shape.py --dataset data/reacher CHECKPOINT ...

Recorded frames stand for states and for goals. The reward of the first for the second is compared with the distance of
the object between them: its mean in each range of distances, as a share of the fall from 0 to 30 cm, and how well it
orders the pairs of a range (Spearman). A policy that is to approach its goal needs an order at every distance.
"""

from __future__ import annotations

import argparse
from itertools import pairwise

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.evaluation import posterior, random_sequences

EDGES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3)


def spearman(first: Tensor, second: Tensor) -> float:
    """Correlation of ranks."""
    ranks = torch.stack([values.argsort().argsort().double() for values in (first, second)])
    return float(torch.corrcoef(ranks)[0, 1])


@torch.no_grad()
def rewards(checkpoint: str, dataset: EpisodeDataset, pairs: int) -> tuple[str, Tensor, Tensor]:
    """Name of an agent, its rewards of pairs of frames, and how far the object is apart in them, metres."""
    torch.manual_seed(0)
    policy = load_agent(checkpoint)
    behaviour, model = policy.behaviour, policy.agent.model
    assert behaviour.goal is not None
    records = random_sequences(dataset, 32, 64)
    seen = posterior(model, records, "state", "belief", *behaviour.goal.frame.in_keys).flatten()
    goals = behaviour.goal.frame(seen.clone())["latent", "goal"]
    position = records["next", "object_position"].flatten(0, 1)[:, 0]
    here, there = torch.randint(len(seen), (2, pairs), generator=torch.Generator().manual_seed(0))
    latent = {"state": seen["state"][here], "belief": seen["belief"][here], "goal": goals[there]}
    reward = behaviour.reward(TensorDict({"latent": TensorDict(latent, [pairs])}, [pairs]))["reward"].squeeze(-1)
    return checkpoint, reward, torch.linalg.vector_norm(position[here] - position[there], dim=-1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+")
    parser.add_argument("--dataset", required=True)
    parser.add_argument("--pairs", type=int, default=50_000)
    arguments = parser.parse_args()
    dataset = EpisodeDataset.open(arguments.dataset)
    ranges = list(pairwise(EDGES))
    head = ["checkpoint", "order, all", *(f"{100 * low:.0f}–{100 * high:.0f} cm: mean, order" for low, high in ranges)]
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for checkpoint in arguments.checkpoints:
        name, reward, apart = rewards(checkpoint, dataset, arguments.pairs)
        inside = [(apart >= low) & (apart < high) for low, high in ranges]
        parts = [(reward[within], apart[within]) for within in inside]
        top, bottom = parts[0][0].mean(), parts[-1][0].mean()
        cells = [f"{(part.mean() - bottom) / (top - bottom):.2f}, {spearman(part, -far):.2f}" for part, far in parts]
        print(f"| {name} | {spearman(reward, -apart):.2f} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
