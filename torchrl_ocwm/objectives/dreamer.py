"""One update: world model, actor and critic."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3Loss, DreamerV3ModelLoss, DreamerV3ValueLoss


class GoalConditionedDreamerLoss(DreamerV3Loss):
    """TorchRL's :class:`~torchrl.objectives.DreamerV3Loss` with goals in imagination.

    World model, actor and critic in one loss. Imagination starts from every posterior state of the batch, each with a
    goal of its own, which ``goal_source`` writes. Without a goal source it computes what ``DreamerV3Loss`` computes.

    State, belief and goal travel in one nested entry, ``latent`` (:class:`~torchrl_ocwm.modules.ImaginationEnv`),
    wherever the world model writes the first two (the keys ``state`` and ``belief``, under ``next``).
    No gradient of actor or critic reaches the world model, and none of any reaches the goal source.

    Args:
        model_loss: Loss of the world model, returning its outputs with gradients (``detach_output=False``).
        actor_loss: Imagines and trains the actor; its keys ``state`` and ``belief`` are set to ``"latent"`` here.
        value_loss: Trains the critic on the same imagined trajectories.
        goal_source: Reads ``latent = {state, belief}`` ``[B * T]``, and what else it names of the records of these
            states, and writes ``("latent", "goal")``.
        replay_value_loss_weight: Weight of TorchRL's critic loss on the recorded rewards; these belong to the goals
            of the records, so that it needs an agent without a goal source.
        continuation_horizon: Discount horizon of that term, steps.
        lmbda: λ of that term.

    Raises:
        ValueError: for a replay value loss together with a goal source.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> agent = build_agent("dreamer_pcp", reacher_task(), size="debug")
        >>> losses = agent.loss(random_records(reacher_task(), 2, 5))
        >>> sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        >>> losses["loss_actor"].shape
        torch.Size([])
    """

    def __init__(
        self,
        model_loss: DreamerV3ModelLoss,
        actor_loss: DreamerV3ActorLoss,
        value_loss: DreamerV3ValueLoss,
        *,
        goal_source: TensorDictModuleBase | None = None,
        replay_value_loss_weight: float = 0.0,
        continuation_horizon: float = 333.0,
        lmbda: float = 0.95,
    ) -> None:
        if goal_source is not None and replay_value_loss_weight:
            raise ValueError(
                "replay_value_loss_weight needs recorded rewards for the imagined goals, which do not exist; "
                "set it to 0 or drop the goal source"
            )
        super().__init__(
            model_loss,
            actor_loss,
            value_loss,
            replay_value_loss_weight=replay_value_loss_weight,
            continuation_horizon=continuation_horizon,
            lmbda=lmbda,
        )
        actor_loss.set_keys(state="latent", belief="latent")
        # TorchRL's losses do not say what they read and write, and cannot be printed without.
        actor_loss.in_keys, actor_loss.out_keys = ["latent"], ["loss_actor"]
        value_loss.in_keys, value_loss.out_keys = ["latent", "lambda_target"], ["loss_value"]
        # Not a submodule: the world model's parameters in it are the model loss's.
        self.__dict__["goal_source"] = goal_source

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the world model reads, the targets of its predictions, and what the goal source reads beside them."""
        model = self.model_loss
        source = [] if self.goal_source is None else self.goal_source.in_keys
        frames = [key for key in source if (key if isinstance(key, str) else key[0]) != "latent"]
        after = [unravel_key(("next", key)) for key in (*frames, self.value_loss.tensor_keys.done)]
        written = model.world_model.out_keys
        keys = [*model.in_keys, self.tensor_keys.is_init, *(key for key in after if key not in written)]
        return list(dict.fromkeys(keys))

    @property
    def out_keys(self) -> list[NestedKey]:
        """The losses, which are to be summed. There are metrics too, and ``replay_context``."""
        replay = ["loss_replay_value"] if self.replay_value_loss_weight else []
        return [*self.model_loss.out_keys, *self.actor_loss.out_keys, *self.value_loss.out_keys, *replay]

    def forward(self, sample: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of records ``[B, T]``, scalars, and the detached latents under ``replay_context``."""
        model_losses, records = self.model_loss(sample)
        after = records.get("next")
        latent = TensorDict(
            {"state": after.get(self.tensor_keys.state), "belief": after.get(self.tensor_keys.belief)},
            sample.batch_size,
        )
        actor_losses, imagined = self.actor_loss(self.imagination_start(after))
        value_losses, _ = self.value_loss(imagined.detach())
        losses = model_losses.update(actor_losses).update(value_losses)
        if self.replay_value_loss_weight:
            losses["loss_replay_value"] = self.replay_value_loss_weight * self._replay_value(sample, latent, imagined)
        return losses.set(self.tensor_keys.replay_context, latent.detach())

    def imagination_start(self, frames: TensorDictBase) -> TensorDictBase:
        """Start states ``[B * T]`` with goals, without gradients.

        Args:
            frames: ``[B, T]`` with posterior states, beliefs and what else the goal source reads.
        """
        frames = frames.detach().reshape(-1)
        keys = self.tensor_keys
        latent = TensorDict({"state": frames.get(keys.state), "belief": frames.get(keys.belief)}, frames.batch_size)
        start = TensorDict({"latent": latent}, frames.batch_size)
        if self.goal_source is None:
            return start
        known = [key for key in self.goal_source.in_keys if key not in start.keys(True)]
        with torch.no_grad():
            return self.goal_source(start.update(frames.select(*known)))

    def _replay_value(self, sample: TensorDictBase, latent: TensorDictBase, imagined: TensorDictBase):  # type: ignore[no-untyped-def]
        keys = self.value_loss.tensor_keys
        replay = TensorDict({"latent": latent}, latent.batch_size)
        replay.set(keys.bootstrap, imagined.get("lambda_target")[..., 0, 0].reshape(latent.batch_size))
        replay.set("next", sample.get("next").select(keys.reward, keys.done, keys.terminated))
        losses = self.value_loss.replay_value_loss(replay, horizon=self.continuation_horizon, lmbda=self.lmbda)
        return losses["loss_replay_value"]
