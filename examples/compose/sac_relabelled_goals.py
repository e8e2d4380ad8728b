r"""Train TorchRL's soft actor-critic from vectors, with goals relabelled in hindsight: no world model.

    python examples/compose/sac_relabelled_goals.py --steps 20000 --output outputs/reacher/sac

Loss, collector and hindsight replay are TorchRL's, the environment is this library's. It renders, as it reads the
object's position from the masks, but no network sees an image. The scores are those of ``ocwm evaluate``:
``results.json`` and ``results.md`` have those at the end, ``log`` has the curve.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    NormalParamExtractor,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import HERReplayBuffer, LazyTensorStorage
from torchrl.envs import EnvBase, FlattenObservation, SelectTransform
from torchrl.modules import MLP, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate
from torchrl.record import CSVLogger
from tqdm import tqdm

from torchrl_ocwm.envs import Workspace, make_env, make_task
from torchrl_ocwm.evaluation import EvaluationEnvs, Report, measure
from torchrl_ocwm.modules import WorkspaceUnits

SEEN = ["proprio", "position", "goal_position"]


def make_vector_env(steps: int, seed: int) -> EnvBase:
    """Reacher without images; ``position`` ``[2]`` is that of its finger tip, metres."""
    env = make_env("ocwm/Reacher-v0", horizon=steps, seed=seed)
    env.append_transform(FlattenObservation(-2, -1, in_keys=["object_position"], out_keys=["position"]))
    env.append_transform(SelectTransform(*SEEN, "is_init"))
    return env


def reward(transition: TensorDictBase) -> Tensor:
    """Minus the distance to the goal, which may be another one than that of the episode."""
    return -torch.linalg.vector_norm(transition["next", "position"] - transition["goal_position"], dim=-1, keepdim=True)


class Network(nn.Module):
    """An MLP that sees joints, position and goal, the last two in workspace units, and in a critic the action."""

    def __init__(self, units: WorkspaceUnits, out_features: int, width: int) -> None:
        super().__init__()
        self.units, self.mlp = units, MLP(out_features=out_features, num_cells=[width, width])

    def forward(self, proprio: Tensor, position: Tensor, goal: Tensor, *action: Tensor) -> Tensor:
        return self.mlp(proprio, self.units(position), self.units(goal), *action)


def make_loss(env: EnvBase, workspace: Workspace, width: int, gamma: float) -> SACLoss:
    """Actor and two critics."""
    spec, units = env.action_spec_unbatched, WorkspaceUnits(workspace.low, workspace.high)
    actor = ProbabilisticTensorDictSequential(
        TensorDictModule(Network(units, 2 * spec.shape[-1], width), SEEN, ["parameters"]),
        TensorDictModule(NormalParamExtractor(), ["parameters"], ["loc", "scale"]),
        ProbabilisticTensorDictModule(
            ["loc", "scale"], ["action"], distribution_class=TanhNormal, return_log_prob=True
        ),
    )
    critic = ValueOperator(Network(units, 1, width), in_keys=[*SEEN, "action"])
    critic(actor(env.fake_tensordict()))  # the first call makes the first layers
    loss = SACLoss(actor, critic, action_spec=spec, alpha_init=0.01)  # rewards are tenths of metres
    loss.make_value_estimator(gamma=gamma)
    return loss


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20000, help="steps in the environment, with an update for each")
    parser.add_argument("--random", type=int, default=1000, help="of them at random, at first")
    parser.add_argument("--episode", type=int, default=150, help="steps of an episode")
    parser.add_argument("--batch", type=int, default=256, help="transitions of an update")
    parser.add_argument("--hindsight", type=float, default=0.8, help="share of them that get another goal")
    parser.add_argument("--every", type=int, default=2000, help="steps between evaluations, at least 50")
    parser.add_argument("--grid", type=int, default=3, help="goals of an evaluation along each side of the workspace")
    parser.add_argument("--width", type=int, default=256, help="of the networks")
    parser.add_argument("--gamma", type=float, default=0.95)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("outputs/sac_relabelled_goals"))
    given = parser.parse_args(arguments)

    torch.manual_seed(given.seed)
    env, task = make_vector_env(given.episode, given.seed), make_task("reacher")
    loss = make_loss(env, task.workspace, given.width, given.gamma)
    optimizer, slow = torch.optim.Adam(loss.parameters(), lr=1e-3), SoftUpdate(loss, tau=0.005)
    buffer = HERReplayBuffer(
        reward,
        her_ratio=given.hindsight,
        goal_key="goal_position",
        achieved_goal_key=("next", "position"),
        storage=LazyTensorStorage(given.steps),
        batch_size=given.batch,
    )
    steps = Collector(
        env, loss.actor_network, frames_per_batch=50, total_frames=given.steps, init_random_frames=given.random
    )
    flat = TensorDictModule(lambda position: position.flatten(-2), ["object_position"], ["position"])
    policy, goals = TensorDictSequential(flat, loss.actor_network), task.workspace.grid(given.grid).flatten(0, -2)
    report = Report(goals, {name: str(value) for name, value in vars(given).items()})
    logger, played = CSVLogger("log", str(given.output)), 0
    with (
        EvaluationEnvs(task, episode_steps=given.episode, workers=0, envs=len(goals)) as envs,
        tqdm(total=given.steps, unit="step") as progress,
    ):
        for collected in steps:
            buffer.extend(collected)
            for _ in range(len(collected)):
                losses = loss(buffer.sample())
                optimizer.zero_grad()
                sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
                optimizer.step()
                slow.step()
            played += len(collected)
            progress.update(len(collected))
            if played % given.every < len(collected) or played >= given.steps:
                scores = measure(envs.run(policy, goals, seed=0))
                for name, values in scores.items():
                    logger.log_scalar(f"evaluation/{name}", float(values.nanmean()), step=played)
                progress.set_postfix(final_distance=float(scores["final_distance"].mean()))
    report.add("SAC, goals relabelled", scores, source=f"seed {given.seed}")
    report.save(given.output)
    print(report.markdown())


if __name__ == "__main__":
    main()
