r"""Train TorchRL's own DreamerV3 with the object terms of FOCUS in its model loss.

    ocwm collect env=reacher steps=50000 dataset=data/reacher
    python examples/compose/focus_terms_in_dreamer_v3.py data/reacher

Networks, losses, optimiser and update are TorchRL's. From here come the modules that decode each object by itself
(``see_objects``) and :class:`~torchrl_ocwm.objectives.FOCUSModelLoss` in the place of TorchRL's ``DreamerV3ModelLoss``.
The agent learns the rewards of the records, to which :class:`~torchrl_ocwm.data.RelabelGoals` gives new goals.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.nn import TensorDictModule as Mod
from tensordict.utils import NestedKey
from torch import nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.model_based import DreamerEnv
from torchrl.modules import (
    DreamerV3ImageEncoder,
    DreamerV3MLP,
    IndependentNormal,
    RSSMPosteriorV3,
    RSSMPriorV3,
    RSSMRolloutV3,
    SymExpTwoHot,
    WorldModelWrapper,
)
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3Loss, DreamerV3ValueLoss, SoftUpdate
from torchrl.record import CSVLogger
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper, DreamerV3Optimizer
from tqdm import trange

from torchrl_ocwm.data import EpisodeDataset, RelabelGoals, make_replay_buffer
from torchrl_ocwm.envs import Task
from torchrl_ocwm.modules import (
    Architecture,
    BoundedNormalActor,
    InitialLatent,
    ObjectDecoder,
    ObjectLatentExtractor,
    WorkspaceUnits,
)
from torchrl_ocwm.objectives import FOCUSModelLoss

LATENT: list[NestedKey] = ["state", "belief"]
NEXT: list[NestedKey] = [("next", "state"), ("next", "belief")]


class Dreamer(DreamerV3Loss):
    """TorchRL's loss, which also tells TorchRL's stepper that the model loss reads masks and positions."""

    @property
    def in_keys(self) -> list[NestedKey]:
        return list(dict.fromkeys([*super().in_keys, *self.model_loss.in_keys]))


def see_objects(task: Task, features: int, width: int) -> list[TensorDictModuleBase]:
    """The object terms: a latent for each object and the background, and from it colours, mask and position."""
    objects = len(task.objects)
    units = WorkspaceUnits(task.workspace.low, task.workspace.high)
    extractor = ObjectLatentExtractor(features, instances=objects + 1, features=width, units=width)
    decoder = ObjectDecoder(width, task.image_size, Architecture(cnn_depth=max(width // 16, 1)))
    position = DreamerV3MLP(width, units.dim, depth=2, num_cells=width)
    latent, objects_only = ("next", "object_latent"), ("next", "object_latent_without_background")
    return [
        Mod(nn.Sequential(units, nn.Flatten(-2)), [("next", "object_position")], [("next", "object_units")]),
        Mod(extractor, NEXT, [latent]),
        Mod(decoder, [latent], [("next", "reco_object_pixels"), ("next", "mask_logits")]),
        Mod(lambda latents: latents[..., :-1, :], [latent], [objects_only]),
        Mod(nn.Sequential(position, nn.Flatten(-2)), [objects_only], [("next", "reco_object_units")]),
    ]


def see_frame(task: Task, width: int) -> tuple[list[TensorDictModuleBase], int]:
    """Image and goal as one vector, and its features."""
    units = WorkspaceUnits(task.workspace.low, task.workspace.high)
    image = DreamerV3ImageEncoder(3, max(width // 16, 1), (1, 2, 4, 8))
    seen, goal = ("next", "seen"), ("next", "goal_units")
    modules = [
        Mod(image, [("next", "pixels")], [seen]),
        Mod(units, [("next", "goal_position")], [goal]),
        Mod(lambda *vectors: torch.cat(vectors, -1), [seen, goal], [("next", "encoded_latents")]),
    ]
    return modules, image.output_features((3, task.image_size, task.image_size)) + units.dim


def make_imagination(model: WorldModelWrapper, state: int, belief: int, action: int) -> DreamerEnv:
    """TorchRL's environment of a world model."""
    env = DreamerEnv(model, prior_shape=(state,), belief_shape=(belief,))
    env.observation_spec = Composite(state=Unbounded(state), belief=Unbounded(belief))
    env.state_spec = env.observation_spec.clone()
    env.action_spec, env.reward_spec = Bounded(-1, 1, (action,)), Unbounded((1,))
    return env


def make_dreamer(task: Task, width: int) -> Dreamer:
    """TorchRL's DreamerV3, but for ``see_objects`` and ``FOCUSModelLoss``."""
    state, belief, action = 16 * 16, width, task.action
    frame, embedded = see_frame(task, width)
    rssm = {"hidden_dim": width, "rnn_hidden_dim": belief, "num_categoricals": 16, "num_classes": 16, "unimix": 0.01}
    prior = RSSMPriorV3(action_shape=(action,), action_dim=action, **rssm)
    posterior = RSSMPosteriorV3(obs_embed_dim=embedded, **rssm)
    rollout = RSSMRolloutV3(
        Mod(prior, [*LATENT, "action"], [("next", "prior_logits"), *NEXT]),
        Mod(posterior, [NEXT[1], ("next", "encoded_latents")], [("next", "posterior_logits"), NEXT[0]]),
    )
    mlp, two_hot = partial(DreamerV3MLP, state + belief, 255, depth=2, num_cells=width, outscale=0.0), SymExpTwoHot()
    reward = mlp()
    model_loss = FOCUSModelLoss(
        TensorDictSequential(
            *[InitialLatent(state, belief), *frame, rollout, Mod(reward, NEXT, [("next", "reward_logits")])],
            *see_objects(task, state + belief, width),
        ),
        lambda_object_position=200.0,
    )
    imagined_reward = TensorDictSequential(Mod(reward, LATENT, ["logits"]), Mod(two_hot, ["logits"], ["reward"]))
    model = WorldModelWrapper(Mod(prior, [*LATENT, "action"], ["_", *LATENT]), imagined_reward)
    actor = ProbabilisticTensorDictSequential(
        Mod(BoundedNormalActor(state + belief, action, layers=2, units=width), LATENT, ["loc", "scale"]),
        ProbabilisticTensorDictModule(["loc", "scale"], ["action"], distribution_class=IndependentNormal),
    )
    critic = TensorDictSequential(
        Mod(mlp(), LATENT, ["state_value_logits"]), Mod(two_hot, ["state_value_logits"], ["state_value"])
    )
    imagination = make_imagination(model, state, belief, action)
    actor_loss = DreamerV3ActorLoss(actor, critic, imagination, imagination_horizon=10)
    value_loss = DreamerV3ValueLoss(critic, value_loss="two_hot", actor_loss=actor_loss, slow_critic_regularization=1.0)
    return Dreamer(model_loss, actor_loss, value_loss)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--updates", type=int, default=1500)
    parser.add_argument("--batch", type=int, default=8, help="sequences")
    parser.add_argument("--length", type=int, default=16, help="records of each")
    parser.add_argument("--width", type=int, default=128, help="of all layers")
    parser.add_argument("--warmup", type=int, default=100, help="updates until the learning rate is whole")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("outputs/focus_terms_in_dreamer_v3"))
    given = parser.parse_args(arguments)

    torch.manual_seed(given.seed)
    dataset = EpisodeDataset.open(given.dataset)
    relabel = RelabelGoals(dataset.task.workspace)
    buffer = make_replay_buffer(dataset, batch_size=given.batch, slice_len=given.length, transform=relabel)
    loss = make_dreamer(dataset.task, given.width).to(given.device)
    stepper = DreamerV3OptimizationStepper(
        loss,
        DreamerV3Optimizer(loss.parameters(), lr=1e-3, warmup_steps=given.warmup),
        SoftUpdate(loss.value_loss, tau=0.02),
        compile_train_step=False,
        cudagraph=False,
    )
    logger = CSVLogger("log", str(given.output))
    for update in (progress := trange(given.updates, unit="update")):
        metrics = stepper.step(None, buffer.sample().to(given.device))
        if update % 10 == 0:
            for name, value in metrics.items():
                logger.log_scalar(name, float(value), step=update)
            progress.set_postfix(masks=float(metrics["loss_model_masks"]))
    torch.save(loss.state_dict(), given.output / "dreamer_v3.pt")


if __name__ == "__main__":
    main()
