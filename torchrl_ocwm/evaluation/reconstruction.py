"""What a world model has kept of the positions."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor

from torchrl_ocwm.agents.agent import Agent


class ReconstructionError:
    """Distance in metres between decoded and true positions, at the latents that a policy acts on.

    Args:
        agent: The agent whose world model decodes.
        object_index: Which object is to be positioned.

    Called with a step's tensordict after the policy, ``[E]``; returns ``entity_error`` ``[E]`` and, if the model
    decodes the goal, ``goal_error`` ``[E]``. A model that does not decode the object gives no ``entity_error``.
    """

    def __init__(self, agent: Agent, *, object_index: int = 0) -> None:
        self.units, self.object_index = agent.model.units, object_index
        self.decode = TensorDictSequential(*agent.model.vectors("latent"))

    def __call__(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Decode and compare."""
        latent = tensordict["latent"].select("state", "belief")
        decoded = self.decode(TensorDict({"latent": latent}, latent.batch_size))["latent"]
        errors = {}
        if "reco_object_units" in decoded:
            positions = decoded["reco_object_units"].unflatten(-1, (-1, self.units.dim))
            true = tensordict["object_position_true"][..., self.object_index, :]
            errors["entity_error"] = self._distance(positions[..., self.object_index, :], true)
        if "reco_goal_units" in decoded:
            errors["goal_error"] = self._distance(decoded["reco_goal_units"], tensordict["goal_position"])
        return errors

    def _distance(self, units: Tensor, metres: Tensor) -> Tensor:
        return torch.linalg.vector_norm(self.units.to_metres(units) - metres, dim=-1)
