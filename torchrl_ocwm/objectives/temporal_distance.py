"""What teaches a network how many steps apart two states are (LEXA temporal)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_ocwm.settings import SettingsError


class TemporalPairs(NamedTuple):
    """Pairs of points of imagined rollouts, and how far apart they are.

    Args:
        rollouts: ``[P, 2]`` int64, in which rollout each of the two is.
        points: ``[P, 2]`` int64, how many steps after its start.
        labels: ``[P]`` float32, the steps from the first to the second as a share of the horizon; 1 for points of
            different sequences.
    """

    rollouts: Tensor
    points: Tensor
    labels: Tensor


def temporal_pairs(
    sequences: int,
    starts: int,
    horizon: int,
    *,
    positives: int,
    negatives: int,
    device: torch.device | None = None,
) -> TemporalPairs:
    """Draw pairs of points of rollouts that start from each frame of recorded sequences.

    Positives are two points of one rollout, the earlier first; of all such pairs, that of a point with itself too, each
    is as likely. Negatives are points of rollouts from different sequences: rollouts from one sequence may pass through
    the same states.

    Args:
        sequences: Recorded sequences B.
        starts: Rollouts from each of them T; rollout ``b * T + t`` is from frame ``t`` of sequence ``b``.
        horizon: Steps of a rollout H, which has H + 1 points.
        positives: Pairs of points of one rollout.
        negatives: Pairs of points of different sequences.
        device: Where to draw them.

    Returns:
        The pairs, positives first.

    Raises:
        SettingsError: if there are to be negatives, and there is one sequence only.

    Examples:
        >>> pairs = temporal_pairs(2, 3, 10, positives=4, negatives=1)
        >>> pairs.rollouts.shape, pairs.labels[-1]
        (torch.Size([5, 2]), tensor(1.))
    """
    if negatives and sequences < 2:
        raise SettingsError(
            "a batch of one sequence has no other sequences, which negatives come from; use learning.batch_size of at "
            "least 2, or negatives=0"
        )
    earlier_later = torch.triu_indices(horizon + 1, horizon + 1, device=device).T

    def draw(below: int, *shape: int) -> Tensor:
        return torch.randint(below, shape, device=device)

    same = draw(sequences * starts, positives, 1).expand(-1, 2)
    points = earlier_later[draw(len(earlier_later), positives)]
    first = draw(sequences, negatives)
    second = (first + 1 + draw(max(sequences - 1, 1), negatives)) % sequences
    apart = torch.stack([first, second], -1) * starts + draw(starts, negatives, 2)
    labels = (points[:, 1] - points[:, 0]) / horizon
    return TemporalPairs(
        torch.cat([same, apart]),
        torch.cat([points, draw(horizon + 1, negatives, 2)]),
        torch.cat([labels, torch.ones(negatives, device=device)]),
    )


class TemporalDistanceLoss(LossModule):
    """Learn the embedding of a state, and how many steps apart two embeddings are (LEXA temporal).

    A head learns to predict, from the latent of a recorded frame, the embedding that a goal made of this frame has. The
    distance learns, from the head's embeddings of imagined states, the steps between two points of a rollout divided by
    the horizon, and that points of different sequences are as far apart as the horizon or farther. Both are squared
    errors. No gradient reaches the world model, nor the head from the distance.

    Args:
        head: Called with state ``[..., S]`` and belief ``[..., H]``; gives the embedding ``[..., E]``.
        distance: Called with two embeddings ``[..., E]`` and ``learning=True``; gives ``[..., 1]``
            (:class:`~torchrl_ocwm.modules.TemporalDistance`).
        frames: Writes the embedding of frames, from what is under ``next`` of the records. Not trained.
        positives: Pairs from one rollout, per update.
        negatives: Pairs from different sequences, as a share of the positives.

    Called with ``records`` ``[B, T]`` and the rollouts ``imagined`` ``[B * T, H]`` from all of their frames in order.

    Raises:
        ValueError: when called, for rollouts that do not belong to the records, and if there are to be negatives but
            the records are of one sequence.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> agent = build_agent("lexa_temporal", reacher_task(), size="debug")
        >>> losses = agent.loss(random_records(reacher_task(), 2, 5))
        >>> sorted(key for key in losses.keys() if key in agent.behaviour().loss.reward_loss.out_keys)
        ['loss_embedding', 'loss_temporal_distance']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of states, and of what ``frames`` writes.

        Attributes:
            state (NestedKey): Stochastic state, ``[..., S]``: under ``next`` of the records, and under ``latent`` of
                the rollouts. Defaults to ``"state"``.
            belief (NestedKey): Deterministic state, ``[..., H]``, likewise. Defaults to ``"belief"``.
            embedding (NestedKey): Embedding of a frame, ``[B, T, E]``, which ``frames`` writes. Defaults to
                ``("latent", "goal")``.
        """

        state: NestedKey = "state"
        belief: NestedKey = "belief"
        embedding: NestedKey = ("latent", "goal")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        head: nn.Module,
        distance: nn.Module,
        frames: TensorDictModuleBase,
        *,
        positives: int = 256,
        negatives: float = 0.1,
    ) -> None:
        super().__init__()
        self.head, self.distance, self.frames = head, distance, frames
        self.positives, self.negatives = positives, round(negatives * positives)

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        pass

    @property
    def in_keys(self) -> list[NestedKey]:
        """States of records and rollouts, and what ``frames`` reads."""
        state = [self.tensor_keys.state, self.tensor_keys.belief]
        places = {
            ("records", "next"): [*state, *self.frames.in_keys],
            ("imagined", "latent"): state,
            ("imagined", "next", "latent"): state,
        }
        return list(dict.fromkeys(unravel_key((*at, key)) for at, keys in places.items() for key in keys))

    @property
    def out_keys(self) -> list[str]:
        """The losses."""
        return ["loss_embedding", "loss_temporal_distance"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses, scalars."""
        records, imagined = tensordict["records"], tensordict["imagined"]
        if imagined.batch_size[0] != records.batch_size.numel():
            raise ValueError(
                f"there must be a rollout from each of the {tuple(records.batch_size)} records, got "
                f"{imagined.batch_size[0]} rollouts"
            )
        return TensorDict(
            {
                "loss_embedding": self._embedding_error(records["next"].detach()),
                "loss_temporal_distance": self._distance_error(imagined, *records.batch_size),
            }
        )

    def _embedding_error(self, frames: TensorDictBase) -> Tensor:
        target = self.frames(frames.select(*self.frames.in_keys)).get(self.tensor_keys.embedding).detach()
        predicted = self.head(*self._state(frames))
        return (predicted.float() - target.float()).square().mean()

    def _distance_error(self, imagined: TensorDictBase, sequences: int, starts: int) -> Tensor:
        horizon, before, last = imagined.batch_size[1], imagined["latent"], imagined["next", "latent"][:, -1:]
        pairs = temporal_pairs(
            sequences,
            starts,
            horizon,
            positives=self.positives,
            negatives=self.negatives,
            device=self._state(before)[0].device,
        )
        chosen = [
            torch.cat(both, 1)[pairs.rollouts, pairs.points]
            for both in zip(self._state(before), self._state(last), strict=True)
        ]
        with torch.no_grad():
            here, there = self.head(*chosen).unbind(1)
        predicted = self.distance(here, there, learning=True).squeeze(-1)
        return (predicted - pairs.labels).square().mean()

    def _state(self, latent: TensorDictBase) -> list[Tensor]:
        return [latent.get(self.tensor_keys.state), latent.get(self.tensor_keys.belief)]
