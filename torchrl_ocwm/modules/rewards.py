"""Rewards in imagination: any module that writes ``reward``."""

from __future__ import annotations

from typing import Literal

from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import cosine_similarity, normalize

from torchrl_ocwm.modules.latent import FullLatent
from torchrl_ocwm.modules.normalization import MovingCentre
from torchrl_ocwm.modules.units import WorkspaceUnits
from torchrl_ocwm.settings import read


def position_distance(position: Tensor, goal: Tensor, epsilon: float = 1e-6) -> Tensor:
    """−‖p − p_g‖₂, smooth at the goal so that its gradient is finite there (paper, equations 1 and 3).

    Args:
        position: ``[..., D]``.
        goal: ``[..., D]``, same unit.
        epsilon: The distance is at least this.

    Returns:
        ``[..., 1]``, in the unit of the arguments.

    Examples:
        >>> import torch
        >>> position_distance(torch.tensor([3.0, 4.0]), torch.zeros(2))
        tensor([-5.])
    """
    return -(position - goal).square().sum(-1, keepdim=True).clamp_min(epsilon**2).sqrt()


#: What a distance is measured in: metres, or half-widths of the workspace.
DistanceUnit = Literal["metre", "workspace"]


class PositionDistance(nn.Module):
    """:func:`position_distance` of one object, of positions in workspace units.

    Args:
        units: Workspace units of both positions.
        object_index: Which object is to be positioned.
        unit: What the distance is measured in.

    Called with positions ``[..., O * D]`` and goals ``[..., D]``, both in workspace units; returns ``[..., 1]``.

    Raises:
        ValueError: for another unit.
    """

    def __init__(self, units: WorkspaceUnits, object_index: int = 0, unit: DistanceUnit = "metre") -> None:
        super().__init__()
        read(DistanceUnit, unit, "unit")
        self.units, self.object_index, self.unit = units, object_index, unit

    def forward(self, positions: Tensor, goal: Tensor) -> Tensor:
        """The reward ``[..., 1]`` for positions of all objects ``[..., O * D]`` and goals ``[..., D]``."""
        position = positions.unflatten(-1, (-1, self.units.dim))[..., self.object_index, :]
        if self.unit == "workspace":
            return position_distance(position, goal)
        return position_distance(self.units.to_metres(position), self.units.to_metres(goal))  # Eq. 3


LatentReward = Literal["cosine", "mse", "chord"]


class LatentSimilarity(nn.Module):
    """Cosine similarity of an object's latent and a goal latent (paper, r_LCP), or minus a distance between them.

    Args:
        object_index: Which object is to be positioned.
        distance: ``"cosine"``; ``"mse"``, the mean squared error; ``"chord"``, the distance between the two directions,
            √(2 − 2 cos), which keeps its slope up to the goal as a distance of positions does.
        centre: Called with the directions ``[..., L]`` of the object's latents; what they have in common is taken from
            both directions before they are compared (:class:`~torchrl_ocwm.modules.MovingCentre`). For chords.

    Called with object latents ``[..., O + 1, L]`` and goals ``[..., L]``; returns ``[..., 1]``.

    Raises:
        ValueError: for another distance, and for a centre where lengths count.
    """

    def __init__(
        self, object_index: int = 0, distance: LatentReward = "cosine", centre: MovingCentre | None = None
    ) -> None:
        super().__init__()
        read(LatentReward, distance, "distance")
        if centre is not None and distance != "chord":
            raise ValueError(f"only chords take a centre, not distance={distance!r}")
        self.object_index, self.distance, self.centre = object_index, distance, centre

    def forward(self, object_latent: Tensor, goal: Tensor) -> Tensor:
        """The reward ``[..., 1]`` for latents of all objects ``[..., O, L]`` and goals ``[..., L]``."""
        latent = object_latent[..., self.object_index, :]
        if self.distance == "cosine":
            return cosine_similarity(latent, goal, dim=-1).unsqueeze(-1)
        if self.distance == "chord":
            return self._chord(normalize(latent, dim=-1), normalize(goal, dim=-1))
        return -(latent - goal).square().mean(-1, keepdim=True)

    def _chord(self, latent: Tensor, goal: Tensor) -> Tensor:
        if self.centre is not None:
            latent = normalize(self.centre(latent), dim=-1)
            goal = normalize(goal - self.centre.mean, dim=-1)
        return position_distance(latent, goal)


class LatentSimilarityReward(TensorDictModule):
    """How similar the extracted latent of an object is to the goal latent.

    Reward of the latent-conditioned policy (paper, section LCP).

    Args:
        object_index: Which object is to be positioned; any of the scene.
        distance: Cosine similarity, or minus the mean squared error (``"mse"``) or the distance of the directions
            (``"chord"``).
        centre: Taken from directions before a chord (:class:`LatentSimilarity`).
        object_latent_key: Extracted latents, ``[..., O + 1, L]``.
        goal_key: Goal latent, ``[..., L]``.
        reward_key: Key written, ``[..., 1]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> latents = torch.tensor([[[3.0, 4.0], [1.0, 0.0]]])
        >>> data = TensorDict({"object_latent": latents, "latent": {"goal": torch.tensor([[0.0, 2.0]])}}, [1])
        >>> LatentSimilarityReward()(data)["reward"]
        tensor([[0.8000]])
    """

    def __init__(
        self,
        *,
        object_index: int = 0,
        distance: LatentReward = "cosine",
        centre: MovingCentre | None = None,
        object_latent_key: NestedKey = "object_latent",
        goal_key: NestedKey = ("latent", "goal"),
        reward_key: NestedKey = "reward",
    ) -> None:
        similarity = LatentSimilarity(object_index, distance, centre)
        super().__init__(similarity, in_keys=[object_latent_key, goal_key], out_keys=[reward_key])


class FullLatentReward(TensorDictModule):
    """Cosine similarity of the latent of the whole scene, state and belief, and a goal that is such a latent (LEXA).

    Args:
        state_key: Stochastic state, ``[..., S]``.
        belief_key: Deterministic state, ``[..., H]``.
        goal_key: Goal latent, ``[..., S + H]``.
        reward_key: Key written, ``[..., 1]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> latent = TensorDict({"state": torch.tensor([[3.0]]), "belief": torch.tensor([[4.0]])}, [1])
        >>> latent["goal"] = torch.tensor([[0.0, 2.0]])
        >>> FullLatentReward()(TensorDict({"latent": latent}, [1]))["reward"]
        tensor([[0.8000]])
    """

    def __init__(
        self,
        *,
        state_key: NestedKey = ("latent", "state"),
        belief_key: NestedKey = ("latent", "belief"),
        goal_key: NestedKey = ("latent", "goal"),
        reward_key: NestedKey = "reward",
    ) -> None:
        super().__init__(_FullLatentSimilarity(), in_keys=[state_key, belief_key, goal_key], out_keys=[reward_key])


class _FullLatentSimilarity(nn.Module):
    """State, belief and a goal ``[..., S + H]`` to ``[..., 1]``."""

    def __init__(self) -> None:
        super().__init__()
        self.latent = FullLatent()

    def forward(self, state: Tensor, belief: Tensor, goal: Tensor) -> Tensor:
        return cosine_similarity(self.latent(state, belief), goal, dim=-1).unsqueeze(-1)


class PositionDistanceReward(TensorDictModule):
    """The negative distance between the decoded position of an object and the goal position.

    Reward of the position-conditioned policy (paper, equation 3).

    Args:
        units: Workspace units of both positions.
        object_index: Which object is to be positioned.
        unit: Whether it is in metres, or in half-widths of the workspace.
        position_key: Decoded positions, ``[..., O * D]`` in workspace units.
        goal_key: Goal position, ``[..., D]`` in workspace units.
        reward_key: Key written, ``[..., 1]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> reward = PositionDistanceReward(WorkspaceUnits((-0.2, -0.2), (0.2, 0.2)))
        >>> data = TensorDict({"object_units": torch.tensor([[0.0, 0.5]]), "latent": {"goal": torch.zeros(1, 2)}}, [1])
        >>> reward(data)["reward"]
        tensor([[-0.1000]])
    """

    def __init__(
        self,
        units: WorkspaceUnits,
        *,
        object_index: int = 0,
        unit: DistanceUnit = "metre",
        position_key: NestedKey = "object_units",
        goal_key: NestedKey = ("latent", "goal"),
        reward_key: NestedKey = "reward",
    ) -> None:
        distance = PositionDistance(units, object_index, unit)
        super().__init__(distance, in_keys=[position_key, goal_key], out_keys=[reward_key])
