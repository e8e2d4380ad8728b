"""Where an agent that decodes positions believes its object to be, while it acts and sees every frame.

    python docs/results/cube_move/limits/believed.py CHECKPOINT [...]

Run from the repository root. For episodes to a grid of goals, after so many steps: how far the object is from its goal,
how far the agent believes it is, and how far apart object and belief are; mean in metres.
"""

from __future__ import annotations

import argparse

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import Policy
from torchrl_ocwm.evaluation import EvaluationEnvs

AFTER = (1, 20, 100)
HEAD = ("goal", "believed", "off")


def measure(policy: Policy, goals: Tensor) -> list[str]:
    """As in :data:`HEAD`, after each of :data:`AFTER`."""
    units, decode = policy.agent.model.units, TensorDictSequential(*policy.agent.model.vectors("latent"))

    def inspect(step: TensorDictBase) -> dict[str, Tensor]:
        latent = step["latent"].select("state", "belief")
        known = decode(TensorDict({"latent": latent}, latent.batch_size))["latent", "reco_object_units"]
        return {"object": step["object_position_true"][:, 0], "believed": units.to_metres(known[:, : units.dim])}

    with EvaluationEnvs(policy.agent.task, episode_steps=max(AFTER), workers=0, envs=len(goals)) as envs:
        episodes = envs.run(policy, goals, inspect=inspect)
    true, believed, goal = (episodes[name] for name in ("object", "believed", "goal_position"))
    apart = [torch.linalg.vector_norm(pair, dim=-1) for pair in (true - goal, believed - goal, believed - true)]
    return [f"{one[:, step - 1].mean():.3f}" for step in AFTER for one in apart]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", metavar="CHECKPOINT", help="of agents that decode positions")
    parser.add_argument("--grid", type=int, default=4, help="goals along each side of the workspace")
    arguments = parser.parse_args()
    head = ["checkpoint", *(f"{one}, {step}" for step in AFTER for one in HEAD)]
    print("| " + " | ".join(head) + " |\n|---|" + "---:|" * (len(head) - 1))
    for file in arguments.checkpoints:
        policy = load_agent(file)
        goals = policy.agent.task.workspace.grid(arguments.grid).flatten(0, 1)
        print("| " + " | ".join([file, *measure(policy, goals)]) + " |", flush=True)


if __name__ == "__main__":
    main()
