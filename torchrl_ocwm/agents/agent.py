"""An agent: a world model and the behaviours learnt in it, wired as a row of choices says."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn

from torchrl_ocwm.agents.behaviour import LearntBehaviour
from torchrl_ocwm.agents.config import AgentConfig, Behaviour, Size
from torchrl_ocwm.agents.scene import Scene
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.modules import ActingLatent, GivenGoals, ImaginationEnv
from torchrl_ocwm.modules.acting import refuse_export_without_latent
from torchrl_ocwm.objectives import GoalConditionedDreamerLoss
from torchrl_ocwm.settings import SettingsError


class Policy(TensorDictSequential):
    """The policy of one of an agent's behaviours, as a module that runs in any rollout of the agent's task.

    Reads the observations, ``is_init`` and a goal: ``goal_position`` ``[..., D]`` in metres as the environment gives
    it, or a position or images under ``goal`` (:class:`~torchrl_ocwm.modules.GivenGoals`). Writes ``action``, and
    ``latent``, which it reads back at the next step. Actions are the mean of the actor, or drawn from it under
    ``set_exploration_type(ExplorationType.RANDOM)``, which TorchRL's collectors set by themselves.

    After ``agent.bfloat16()`` or ``half()`` it computes in that type, from observations of any and to float32 actions.

    Attributes:
        agent: The agent that it belongs to.
        behaviour: The behaviour.
        takes_images: Whether goals can be given as images.
        takes_positions: Whether they can be given as positions.
    """

    def __init__(self, agent: Agent, behaviour: LearntBehaviour, *modules: TensorDictModuleBase) -> None:
        super().__init__(*modules)
        self.register_forward_pre_hook(refuse_export_without_latent, with_kwargs=True)
        # Not submodules: the modules hold the parameters.
        self.__dict__["agent"], self.__dict__["behaviour"] = agent, behaviour

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Act; takes the arguments of :class:`~tensordict.nn.TensorDictSequential`."""
        weight = next(self.behaviour.actor.parameters())
        if weight.dtype not in (torch.bfloat16, torch.float16):
            return super().forward(*args, **kwargs)
        with torch.autocast(weight.device.type, weight.dtype):
            return super().forward(*args, **kwargs)

    @property
    def takes_images(self) -> bool:
        """Whether it understands goals as images."""
        goal = self.behaviour.goal
        return goal is not None and goal.image is not None

    @property
    def object_index(self) -> int:
        """Which of the task's objects it is to position."""
        return self.behaviour.scene.object_index

    @property
    def takes_positions(self) -> bool:
        """Whether it understands goals as positions, or takes none."""
        goal = self.behaviour.goal
        return goal is None or goal.position is not None


class Agent(nn.Module):
    """A world model and behaviours for one task.

    Args:
        task: What the agent is for.
        config: The row of choices.
        size: How large it is.

    Attributes:
        model: The world model.
        behaviours: What is learnt in it, by name.
        loss: All of it in one loss, as TorchRL's DreamerV3 stepper takes it.
        recorded_object: Which object the goals and rewards of its training records are about
            (:class:`~torchrl_ocwm.data.RelabelGoals`).

    Raises:
        SettingsError: if the choices do not fit together, or the CNN does not take images of the task.
    """

    def __init__(self, task: Task, config: AgentConfig, size: Size) -> None:
        super().__init__()
        self.task, self.config, self.size = task, config, size
        needs = _merge(part.needs for one in config.behaviours.values() for part in (one.goal, one.reward))
        self.model = config.world_model.build(task, size.architecture, needs)
        self.behaviours = nn.ModuleDict({name: self._learn(name, one) for name, one in config.behaviours.items()})
        model_loss = config.world_model.loss(self.model, needs, lambda_dynamic=size.learning.lambda_dynamic)
        losses = {name: self.behaviour(name).loss for name in self.behaviours}
        self.loss = GoalConditionedDreamerLoss(model_loss, losses)
        self.recorded_object = self._recorded_object()

    def behaviour(self, name: str | None = None) -> LearntBehaviour:
        """A behaviour by its name; without one, that which acts.

        Raises:
            SettingsError: for an unknown name, with those that there are.
        """
        name = name or self.config.acting
        if name not in self.behaviours:
            raise SettingsError(f"unknown behaviour {name!r}; this agent has {', '.join(self.behaviours)}")
        found = self.behaviours[name]
        assert isinstance(found, LearntBehaviour)
        return found

    @property
    def actor(self) -> ProbabilisticTensorDictSequential:
        """The actor of the behaviour that acts."""
        return self.behaviour().actor

    @property
    def imagination(self) -> ImaginationEnv:
        """The imagination of the behaviour that acts."""
        return self.behaviour().imagination

    def policy(self, behaviour: str | None = None) -> Policy:
        """The policy of a behaviour, sharing the agent's parameters; without a name, of that which acts."""
        model, learnt = self.model, self.behaviour(behaviour)
        goal = learnt.goal
        encoder = [] if goal is None else [GivenGoals(model.units, goal.position, goal.image)]
        return Policy(
            self,
            learnt,
            ActingLatent(model.state, model.belief, self.task.action),
            model.filter(),
            *encoder,
            learnt.actor,
            # What is done is what the next step remembers.
            TensorDictModule(_clamp, ["action"], ["action"]),
            TensorDictModule(torch.clone, ["action"], [("latent", "action")]),
        )

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Parameters with their learning rates: world model, then actor, critic and reward of each behaviour."""
        learning = self.size.learning
        groups = [(self.loss.model_loss.parameters(), learning.model_lr)]
        for name in self.behaviours:
            learnt = self.behaviour(name)
            groups.append((learnt.loss.actor_loss.actor_model.parameters(), learning.actor_lr))
            groups.append((learnt.loss.value_loss.value_model_params.parameters(), learning.value_lr))
            if learnt.loss.reward_loss is not None:
                rate = learning.model_lr if learnt.reward_lr is None else learnt.reward_lr
                groups.append((learnt.loss.reward_loss.parameters(), rate))
        return [{"params": list(parameters), "lr": rate} for parameters, rate in groups]

    def _learn(self, name: str, config: Behaviour) -> LearntBehaviour:
        scene = Scene(self.model, self.task, self.size.architecture, self._index(config.object))
        prefix = "" if name == self.config.acting else f"{name}_"
        return LearntBehaviour(config, scene, self.size.learning, prefix=prefix)

    def _recorded_object(self) -> int:
        """That of the behaviours which learn the rewards of the records, or else of the one that acts."""
        learners = {name: one for name, one in self.config.behaviours.items() if "reward_head" in one.reward.needs}
        objects = {name: self._index(one.object) for name, one in learners.items()}
        if len(set(objects.values())) > 1:
            raise SettingsError(
                f"behaviours {', '.join(objects)} learn the rewards of the records, which are about one object; "
                "they must not differ in object"
            )
        return next(iter(objects.values()), self.behaviour().scene.object_index)

    def _index(self, name: str | None) -> int:
        objects = self.task.objects
        if name is None:
            return 0
        if name not in objects:
            raise SettingsError(f"object={name!r} is not in {self.task.name!r}, which has {', '.join(objects)}")
        return objects.index(name)


def _merge(needs: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """What all goals and rewards ask of the world model together."""
    merged: dict[str, Any] = {}
    for one in needs:
        for name, value in one.items():
            if merged.setdefault(name, value) != value:
                raise SettingsError(
                    f"two behaviours need another {name} of the world model: {merged[name]} and {value}"
                )
    return merged


def _clamp(action: Tensor) -> Tensor:
    return action.clamp(-1, 1)
