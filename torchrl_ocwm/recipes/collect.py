"""Collect a dataset: ``ocwm collect env=reacher steps=100000``.

Can be stopped at any moment and run again: it goes on where it was. Run with another policy, it goes on with that one:

    ocwm collect env=cube_move steps=50000 policy=scripted
    ocwm collect env=cube_move steps=100000 policy=random
"""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_ocwm.agents import collecting_policy
from torchrl_ocwm.data import Collection, collect
from torchrl_ocwm.envs import EnvChoice
from torchrl_ocwm.recipes.config import recipe
from torchrl_ocwm.signals import ended_by_signals


@dataclass(frozen=True, kw_only=True)
class Collect(Collection):
    """Settings of the recipe.

    Args:
        env: Where to collect.
        dataset: Folder of the dataset. One that is there already is continued.
    """

    env: EnvChoice
    dataset: str = "data/${env.name}"


@recipe("collect", {"env": "reacher"})
@ended_by_signals()
def main(config: Collect) -> None:
    """Collect what is missing."""
    options = dict(config.env.options)
    policy = collecting_policy(config, config.env.name, options)
    dataset = collect(config.dataset, config.env.name, config, policy=policy, options=options)
    index = dataset.metadata
    policies = ", ".join(f"{number} {policy}" for policy, number in index.get("policies", {}).items())
    print(f"{dataset.path}: {dataset.num_steps} steps in {len(dataset.episode_lengths)} episodes ({policies})")
    for name, seen in index["coverage"].items():
        print(f"{name}: moves in {seen['moves']:.0%} of the steps, visits {seen['visited']:.0%} of the workspace")
    if index.get("failures"):
        print(f"{index['failures']} episodes failed and were left out")
