"""One update: the world model, and the behaviours that are learnt in its imagination."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3ModelLoss, DreamerV3ValueLoss, LossModule


class BehaviourLoss(LossModule):
    """Actor and critic of one behaviour, trained on one imagined rollout.

    Imagination starts from every posterior state of the batch, each with a goal of its own, which ``goal_source``
    writes. State, belief and goal travel in one nested entry, ``latent``
    (:class:`~torchrl_ocwm.modules.ImaginationEnv`). No gradient reaches the frames that imagination starts from, and
    none the goal source.

    Args:
        actor_loss: Imagines and trains the actor; its keys ``state`` and ``belief`` are set to ``"latent"`` here.
        value_loss: Trains the critic on the same imagined trajectories.
        goal_source: Reads ``latent = {state, belief}`` ``[B, T]``, and what else it names of the records of these
            states, and writes ``("latent", "goal")``.
        reward_loss: Trains what the imagined reward is computed with: called with ``records`` ``[B, T]`` and
            ``imagined`` ``[B * T, H]``, both without gradients, it gives ``loss_*`` entries.
        replay_value_loss_weight: Weight of TorchRL's critic loss on the recorded rewards; these belong to the goals
            of the records, so that it needs a behaviour without a goal source.
        continuation_horizon: Discount horizon of that term, steps.
        lmbda: λ of that term.
        prefix: Put before the names of all losses and metrics: ``loss_actor`` becomes ``loss_{prefix}actor``.

    Raises:
        ValueError: for a replay value loss together with a goal source.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> agent = build_agent("dreamer_pcp", reacher_task(), size="debug")
        >>> records = agent.model.records()(random_records(reacher_task(), 2, 5))
        >>> sorted(key for key in agent.behaviour("reach").loss(records).keys() if key.startswith("loss"))
        ['loss_actor', 'loss_value']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the frames that imagination starts from.

        Attributes:
            state (NestedKey): Posterior state under ``next``, ``[B, T, S]``. Defaults to ``"state"``.
            belief (NestedKey): Belief under ``next``, ``[B, T, H]``. Defaults to ``"belief"``.
            is_init (NestedKey): First records of episodes, ``[B, T, 1]`` bool, at the root; for goal sources that ask
                for it. Defaults to ``"is_init"``.
        """

        state: NestedKey = "state"
        belief: NestedKey = "belief"
        is_init: NestedKey = "is_init"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_loss: DreamerV3ActorLoss,
        value_loss: DreamerV3ValueLoss,
        *,
        goal_source: TensorDictModuleBase | None = None,
        reward_loss: LossModule | None = None,
        replay_value_loss_weight: float = 0.0,
        continuation_horizon: float = 333.0,
        lmbda: float = 0.95,
        prefix: str = "",
    ) -> None:
        if goal_source is not None and replay_value_loss_weight:
            raise ValueError(
                "replay_value_loss_weight needs recorded rewards for the imagined goals, which do not exist; "
                "set it to 0 or drop the goal source"
            )
        super().__init__()
        self.actor_loss, self.value_loss, self.reward_loss = actor_loss, value_loss, reward_loss
        self.goal_source = goal_source
        self.replay_value_loss_weight, self.prefix = replay_value_loss_weight, prefix
        self.continuation_horizon, self.lmbda = continuation_horizon, lmbda
        actor_loss.set_keys(state="latent", belief="latent")
        # TorchRL's losses do not say what they read and write, and cannot be printed without.
        actor_loss.in_keys, actor_loss.out_keys = ["latent"], ["loss_actor"]
        value_loss.in_keys, value_loss.out_keys = ["latent", "lambda_target"], ["loss_value"]

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> BehaviourLoss:
        # TorchRL's actor loss hides its critic from PyTorch: parameters are the critic's, buffers stay where they were.
        for module in self.actor_loss.value_model.modules():
            module._buffers.update({name: fn(buffer) for name, buffer in module.named_buffers(recurse=False)})
        return super()._apply(fn)

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        pass

    @property
    def in_keys(self) -> list[NestedKey]:
        """The posterior, and what goal source, reward loss and replay loss read of the records."""
        after = [self.tensor_keys.state, self.tensor_keys.belief, *self._source_keys()]
        start = self.tensor_keys.is_init
        keys = [key if key == start else unravel_key(("next", key)) for key in after]
        if self.reward_loss is not None:
            read = [key for key in self.reward_loss.in_keys if isinstance(key, tuple) and key[0] == "records"]
            keys += [unravel_key(key[1:]) for key in read]
        if self.replay_value_loss_weight:
            value = self.value_loss.tensor_keys
            keys += [unravel_key(("next", key)) for key in (value.reward, value.done, value.terminated)]
        return list(dict.fromkeys(keys))

    @property
    def out_keys(self) -> list[NestedKey]:
        """The losses, which are to be summed; there are metrics too."""
        replay = ["loss_replay_value"] if self.replay_value_loss_weight else []
        reward = [] if self.reward_loss is None else self.reward_loss.out_keys
        return [self._name(key) for key in ("loss_actor", "loss_value", *replay, *reward)]

    def forward(self, records: TensorDictBase) -> TensorDictBase:
        """Losses and metrics, scalars, of records ``[B, T]`` with what the world model made of them under ``next``."""
        actor_losses, imagined = self.actor_loss(self.imagination_start(self._frames(records)))
        losses = actor_losses.update(self.value_loss(imagined.detach())[0])
        if self.replay_value_loss_weight:
            losses["loss_replay_value"] = self.replay_value_loss_weight * self._replay_value(records, imagined)
        if self.reward_loss is not None:
            seen = TensorDict({"records": records.detach(), "imagined": imagined.detach()})
            losses.update(self.reward_loss(seen))
        return TensorDict({self._name(key): value for key, value in losses.items()})

    def imagination_start(self, frames: TensorDictBase) -> TensorDictBase:
        """Start states ``[B * T]`` with goals, without gradients.

        Args:
            frames: ``[B, T]`` with posterior states, beliefs and what else the goal source reads.
        """
        frames, keys = frames.detach(), self.tensor_keys
        latent = TensorDict({"state": frames.get(keys.state), "belief": frames.get(keys.belief)}, frames.batch_size)
        start = TensorDict({"latent": latent}, frames.batch_size)
        if self.goal_source is None:
            return start.reshape(-1)
        with torch.no_grad():
            return self.goal_source(start.update(frames.select(*self._source_keys()))).reshape(-1)

    def _frames(self, records: TensorDictBase) -> TensorDictBase:
        """What is known of the frames, and which are the first of their episodes if the goal source asks for it."""
        start, frames = self.tensor_keys.is_init, records.get("next")
        return frames.copy().set(start, records.get(start)) if start in self._source_keys() else frames

    def _source_keys(self) -> list[NestedKey]:
        """What the goal source reads beside state and belief."""
        source = [] if self.goal_source is None else self.goal_source.in_keys
        return [key for key in source if key not in (("latent", "state"), ("latent", "belief"))]

    def _name(self, key: str) -> str:
        return f"loss_{self.prefix}{key[5:]}" if key.startswith("loss_") else self.prefix + key

    def _replay_value(self, records: TensorDictBase, imagined: TensorDictBase) -> torch.Tensor:
        keys, after = self.value_loss.tensor_keys, records.get("next")
        latent = {"state": after.get(self.tensor_keys.state), "belief": after.get(self.tensor_keys.belief)}
        replay = TensorDict({"latent": TensorDict(latent, records.batch_size)}, records.batch_size)
        replay.set(keys.bootstrap, imagined.get("lambda_target")[..., 0, 0].reshape(records.batch_size))
        replay.set("next", after.select(keys.reward, keys.done, keys.terminated))
        losses = self.value_loss.replay_value_loss(replay, horizon=self.continuation_horizon, lmbda=self.lmbda)
        return losses["loss_replay_value"]


class GoalConditionedDreamerLoss(LossModule):
    """A world model's loss and those of the behaviours that are learnt in its imagination, in one.

    With one behaviour without a goal source it computes what TorchRL's :class:`~torchrl.objectives.DreamerV3Loss`
    computes. The behaviours start from the same posterior states; no gradient of theirs reaches the world model.

    Args:
        model_loss: Loss of the world model, returning its outputs with gradients (``detach_output=False``).
        behaviours: The behaviours by name, or a single one.
        return_context: Also return the detached latents under ``replay_context``, as TorchRL's stepper wants them.

    Raises:
        ValueError: when called, if two behaviours give a loss the same name.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> agent = build_agent("dreamer_pcp", reacher_task(), size="debug")
        >>> losses = agent.loss(random_records(reacher_task(), 2, 5))
        >>> sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        >>> losses["loss_actor"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the records.

        Attributes:
            state (NestedKey): Where the world model writes its posterior state, under ``next``. Defaults to
                ``"state"``.
            belief (NestedKey): Where it writes its belief, under ``next``. Defaults to ``"belief"``.
            is_init (NestedKey): First records of episodes, ``[B, T, 1]`` bool. Defaults to ``"is_init"``.
            replay_context (NestedKey): The detached latents, written if asked for. Defaults to ``"replay_context"``.
        """

        state: NestedKey = "state"
        belief: NestedKey = "belief"
        is_init: NestedKey = "is_init"
        replay_context: NestedKey = "replay_context"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    model_loss: DreamerV3ModelLoss

    def __init__(
        self,
        model_loss: DreamerV3ModelLoss,
        behaviours: BehaviourLoss | Mapping[str, BehaviourLoss],
        *,
        return_context: bool = False,
    ) -> None:
        super().__init__()
        self.model_loss = model_loss
        self.behaviours = nn.ModuleDict(
            {"behaviour": behaviours} if isinstance(behaviours, BehaviourLoss) else behaviours
        )
        self.return_context = return_context

    def _each(self) -> list[BehaviourLoss]:
        return [behaviour for behaviour in self.behaviours.children() if isinstance(behaviour, BehaviourLoss)]

    def set_keys(self, **kwargs: NestedKey) -> None:
        """Set keys, those that the behaviours have in common with it there too."""
        super().set_keys(**kwargs)
        shared = {name: key for name, key in kwargs.items() if name in ("state", "belief", "is_init")}
        if shared:
            for behaviour in self._each():
                behaviour.set_keys(**shared)

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        pass

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the world model reads, the targets of its predictions, and what behaviours read of the records."""
        written = set(self.model_loss.world_model.out_keys)
        behaviours = [key for one in self._each() for key in one.in_keys if key not in written]
        keys = [*self.model_loss.in_keys, self.tensor_keys.is_init, *behaviours]
        return list(dict.fromkeys(keys))

    @property
    def out_keys(self) -> list[NestedKey]:
        """The losses, which are to be summed; there are metrics too."""
        return [*self.model_loss.out_keys, *(key for one in self._each() for key in one.out_keys)]

    def forward(self, sample: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of records ``[B, T]``, scalars."""
        losses = TensorDict()
        for part in self.parts(sample):
            losses.update(part)
        return losses

    def parts(self, sample: TensorDictBase) -> Iterator[TensorDictBase]:
        """What :meth:`forward` returns: of the world model first, then of one behaviour after the other.

        Each part can be differentiated before the next is computed, which keeps one graph at a time in memory. It is
        one part if a behaviour trains the world model too, with its replay loss.
        """
        losses, records = self.model_loss(sample)
        reward = unravel_key(("next", self.model_loss.tensor_keys.reward))
        if (recorded := sample.get(reward, None)) is not None:
            records.set(reward, recorded)  # a world model writes its prediction in the same place
        if self.return_context:
            after, keys = records.get("next"), self.tensor_keys
            latent = {"state": after.get(keys.state), "belief": after.get(keys.belief)}
            losses.set(keys.replay_context, TensorDict(latent, sample.batch_size).detach())
        # Nothing else is kept: predicted images take much memory.
        records = records.select(*(key for one in self._each() for key in one.in_keys))
        names, apart = set(losses.keys()), not any(one.replay_value_loss_weight for one in self._each())
        for behaviour in self._each():
            if apart:
                yield losses
                losses = TensorDict()
            more = behaviour(records)
            if twice := names & set(more.keys()):
                raise ValueError(f"two losses have the name {sorted(twice)[0]!r}; give the behaviours a prefix each")
            names |= set(more.keys())
            losses = losses.update(more)
        yield losses
