r"""Plan at test time in a trained agent's imagination, without its policy, and compare both.

    python examples/compose/plan_in_imagination.py outputs/reacher/focus_lcp/cpu/seed_0/checkpoint.zip

TorchRL's cross-entropy planner takes the agent's imagination as its environment: the world model predicts what a
sequence of actions leads to, the agent's imagined reward judges it. The first action of the best plan is done, then a
new plan is made. The agent's policy acts from the same starts towards the same goals. The table of both is printed and
written to ``results.md``, goal by goal to ``results.json``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.modules import CEMPlanner
from tqdm import tqdm

from torchrl_ocwm.agents import Policy, load_agent
from torchrl_ocwm.evaluation import EvaluationEnvs, Report, goal_images, measure


class LatentPlanner(CEMPlanner):
    """TorchRL's planner, which copies what it is given for every candidate: the latent, and no images."""

    def planning(self, tensordict: TensorDictBase) -> Tensor:
        return super().planning(tensordict.select(*self.in_keys))


def plan_instead(policy: Policy, planner: TensorDictModuleBase) -> TensorDictSequential:
    """The policy with a planner in the place of its actor: filter and goal encoder stay."""
    return TensorDictSequential(*(planner if part is policy.behaviour.actor else part for part in policy.module))


def act(policy: TensorDictModuleBase, device: str, progress: tqdm, step: TensorDictBase) -> TensorDictBase:
    """Act on a device; the environments are on the CPU."""
    progress.update()
    return policy(step.to(device)).to("cpu")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--grid", type=int, default=3, help="goals along each side of the workspace")
    parser.add_argument("--steps", type=int, default=150, help="steps of an episode")
    parser.add_argument("--horizon", type=int, default=15, help="steps of a plan")
    parser.add_argument("--candidates", type=int, default=64, help="plans that are tried at once")
    parser.add_argument("--iterations", type=int, default=4, help="how often the candidates are drawn anew")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0, help="of the episodes")
    parser.add_argument("--output", type=Path, default=Path("outputs/plan_in_imagination"))
    given = parser.parse_args(arguments)

    policy = load_agent(given.checkpoint, device=given.device)
    planner = LatentPlanner(
        policy.behaviour.imagination,
        planning_horizon=given.horizon,
        optim_steps=given.iterations,
        num_candidates=given.candidates,
        top_k=max(given.candidates // 8, 2),
    )
    task, about = policy.agent.task, policy.object_index
    goals = task.workspace.grid(given.grid).flatten(0, -2)
    images = None if policy.takes_positions else goal_images(task, goals, object_index=about)
    options = {name: value for name, value in vars(given).items() if name not in ("checkpoint", "device", "output")}
    report = Report(goals, options)
    at_once = min(len(goals), 10)
    steps = given.steps * -(-len(goals) // at_once)
    with EvaluationEnvs(task, episode_steps=given.steps, workers=0, envs=at_once) as envs:
        for name, acting in {"policy": policy, "planner": plan_instead(policy, planner)}.items():
            with tqdm(desc=name, total=steps, unit="step") as progress:
                acted = partial(act, acting, given.device, progress)
                episodes = envs.run(acted, goals, images=images, seed=given.seed)
            report.add(name, measure(episodes, object_index=about), source=str(given.checkpoint))
    report.save(given.output)
    print(report.markdown())


if __name__ == "__main__":
    main()
