"""How well Dreamer knows the reward, which it has to learn: in frames that it sees, and in those that it imagines.

    python docs/results/reacher/reward_prediction.py CHECKPOINT [...] --dataset data/reacher

Run from the repository root. For sequences of a dataset: the share of the rewards' variance that the world model's
reward head predicts (1: all of it; 0: no better than the mean), and how far off the positions of entity and goal are
that it decodes, mean in metres. Seen: the last frame of each sequence, all frames seen. Imagined: the same frame, after
as many steps as the actor is taught over, imagined from the recorded actions.
"""

from __future__ import annotations

import argparse

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import Agent
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.evaluation import predict_latents, random_sequences

CONTEXT = 6  # frames before the imagination begins
HEAD = ("reward", "entity, m", "goal, m")


@torch.no_grad()
def measure(agent: Agent, records: TensorDictBase) -> list[str]:
    """Seen and imagined, each as in :data:`HEAD`."""
    model, last = agent.model, records[:, -1]["next"]
    decode, cells = TensorDictSequential(*model.vectors("latent"), *model.reward()), []
    for latents in predict_latents(model, records, CONTEXT).values():
        known = decode(TensorDict({"latent": latents[:, -1]}, [len(records)]))
        off = [
            torch.linalg.vector_norm(model.units.to_metres(known["latent", f"reco_{name}_units"]) - true, dim=-1)
            for name, true in (("object", last["object_position"][:, 0]), ("goal", last["goal_position"]))
        ]
        cells += [f"{explained(known['reward'], last['reward']):.2f}", *(f"{one.mean():.3f}" for one in off)]
    return cells


def explained(predicted: Tensor, true: Tensor) -> float:
    """The share of the variance."""
    return 1 - float((predicted - true).square().mean() / true.var(correction=0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "checkpoints", nargs="+", metavar="CHECKPOINT", help="of agents with one object and a reward head"
    )
    parser.add_argument("--dataset", required=True)
    parser.add_argument("--sequences", type=int, default=300)
    arguments = parser.parse_args()
    head = ["checkpoint", *(f"{one}, {view}" for view in ("seen", "imagined") for one in HEAD)]
    print("| " + " | ".join(head) + " |\n|---|" + "---:|" * (len(head) - 1))
    for file in arguments.checkpoints:
        agent = load_agent(file).agent
        length = CONTEXT + agent.size.learning.imagination_horizon
        with EpisodeDataset.open(arguments.dataset) as dataset:
            records = random_sequences(dataset, arguments.sequences, length)
        torch.manual_seed(0)
        print("| " + " | ".join([file, *measure(agent, records)]) + " |", flush=True)


if __name__ == "__main__":
    main()
