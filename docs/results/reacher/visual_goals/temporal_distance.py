"""What LEXA temporal's distance says of recorded frames, by the steps between them, and what its parts make of it.

    python docs/results/reacher/visual_goals/temporal_distance.py --dataset data/reacher CHECKPOINT

The reward takes the embedding of the state from a head, and that of the goal from the image. The distance is taught
with the head's on both sides.
"""

from __future__ import annotations

import argparse

import torch
from tensordict import TensorDict

from torchrl_ocwm import load_agent
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.evaluation import posterior, random_sequences
from torchrl_ocwm.modules import TemporalDistance

STEPS = (0, 1, 2, 4, 8, 15, 25, 40)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint")
    parser.add_argument("--dataset", required=True)
    arguments = parser.parse_args()
    torch.manual_seed(0)
    policy = load_agent(arguments.checkpoint)
    behaviour = policy.behaviour
    records = random_sequences(EpisodeDataset.open(arguments.dataset), 32, 64)
    seen = posterior(policy.agent.model, records, "state", "belief", *behaviour.goal.frame.in_keys)
    images = behaviour.goal.frame(seen.clone())["latent", "goal"]
    latent = seen.select("state", "belief")
    heads = behaviour.reward[0](TensorDict({"latent": latent}, seen.batch_size))["embedding"]
    (distance,) = (module for module in behaviour.reward.modules() if isinstance(module, TemporalDistance))
    left = (heads - images).square().mean() / (images - images.mean((0, 1))).square().mean()
    print(f"The head explains {1 - float(left):.0%} of the variance of the images' embeddings.\n")
    print(
        f"| distance of the head's embedding to | {' | '.join(f'{steps} steps' for steps in STEPS)} | other sequences |"
    )
    print(f"|{'---|' * (len(STEPS) + 2)}")
    for name, goals in (("that of the image, as rewarded", images), ("the head's, as taught", heads)):
        apart = [distance(heads[:, : heads.shape[1] - steps], goals[:, steps:]).mean() for steps in STEPS]
        apart.append(distance(heads, goals.roll(1, 0)).mean())
        print(f"| {name} | {' | '.join(f'{float(value):.2f}' for value in apart)} |")


if __name__ == "__main__":
    main()
