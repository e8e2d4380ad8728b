"""An imagined reward, and a row that uses it."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor

from torchrl_ocwm import agents
from torchrl_ocwm.settings import setting


@agents.register("nearness")
@dataclass(frozen=True)
class Nearness(agents.Reward):
    """One at the goal, and less with the distance from it, exponentially.

    Args:
        width: Metres in which it falls to 1/e.
    """

    width: float = setting(0.1, above=0)

    def build(self, scene: agents.Scene, goal: agents.GoalEncoding | None) -> agents.ImaginedReward:
        """The nearness, from the decoded positions."""

        def nearness(positions: Tensor, goals: Tensor) -> Tensor:
            position = positions.unflatten(-1, (-1, scene.model.units.dim))[..., scene.object_index, :]
            away = scene.model.units.to_metres(position) - scene.model.units.to_metres(goals)
            return (-away.norm(dim=-1, keepdim=True) / self.width).exp()

        judge = TensorDictModule(nearness, ["object_units", ("latent", "goal")], ["reward"])
        return agents.ImaginedReward(TensorDictSequential(scene.model.object_position(), judge))


reach = agents.Behaviour(agents.Position(), Nearness(), agents.UniformGoalSource())
agents.AGENTS["nearness"] = agents.AgentConfig(agents.Flat(), {"reach": reach})
