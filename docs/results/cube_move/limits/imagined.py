"""What an agent that decodes positions imagines that it will do, beside what it then does.

    python docs/results/cube_move/limits/imagined.py CHECKPOINT [...]

Run from the repository root. Episodes to a grid of goals; after so many steps the agent imagines as many as its actor
is taught over. Mean in metres, at the end of these: how far the object is from the goal in fact; how far it is in the
imagination from the goal, and from the decoded goal, of which the reward is made; and how far that goal is off.
"""

from __future__ import annotations

import argparse

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import Policy
from torchrl_ocwm.evaluation import EvaluationEnvs, imagined_rollout

AFTER = (1, 20)
HEAD = ("in fact", "imagined", "imagined, decoded goal", "goal off")


def inspect(step: TensorDictBase) -> dict[str, Tensor]:
    return {
        "object": step["object_position_true"][:, 0],
        **{name: step["latent", name] for name in ("state", "belief", "goal") if ("latent", name) in step.keys(True)},
    }


def measure(policy: Policy, goals: Tensor) -> list[str]:
    """As in :data:`HEAD`, after each of :data:`AFTER`."""
    agent, horizon = policy.agent, policy.agent.size.learning.imagination_horizon
    units, decode = agent.model.units, TensorDictSequential(*agent.model.vectors("latent"))
    with EvaluationEnvs(agent.task, episode_steps=max(AFTER) + horizon, workers=0, envs=len(goals)) as envs:
        episodes = envs.run(policy, goals, inspect=inspect)
    found = []
    for step in AFTER:
        goal = episodes["goal_position"][:, step]
        latent = episodes.select("state", "belief", "goal", strict=False)[:, step - 1]
        last = imagined_rollout(agent, latent, horizon + 1)[:, -1]
        known = decode(TensorDict({"latent": last["latent"]}, last.batch_size))["latent"]
        entity = units.to_metres(known["reco_object_units"][:, : units.dim])
        decoded = units.to_metres(known["reco_goal_units"]) if "reco_goal_units" in known.keys() else goal
        true = episodes["object"][:, step - 1 + horizon]
        found += [true - goal, entity - goal, entity - decoded, decoded - goal]
    return [f"{torch.linalg.vector_norm(one, dim=-1).mean():.3f}" for one in found]


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
