"""What a world model is trained to minimise."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, cat
from torch.nn.functional import binary_cross_entropy_with_logits, cosine_similarity, mse_loss
from torchrl.objectives import DreamerV3ModelLoss, categorical_kl_terms, symlog, two_hot_cross_entropy

from torchrl_ocwm.modules.dtypes import flags, unit_image
from torchrl_ocwm.objectives.annealing import AnnealedWeight


def image_reconstruction(prediction: Tensor, target: Tensor) -> Tensor:
    """Squared error of an image in [0, 1], summed over its pixels and averaged over the batch.

    Args:
        prediction: ``[*batch, C, H, W]`` float.
        target: ``[*batch, C, H, W]`` uint8, or floating point in [0, 1].

    Examples:
        >>> import torch
        >>> image_reconstruction(torch.ones(2, 1, 2, 2), torch.zeros(2, 1, 2, 2, dtype=torch.uint8))
        tensor(4.)
    """
    images = prediction.shape[:-3].numel()
    return mse_loss(prediction.float(), unit_image(target), reduction="sum") / images


def symlog_reconstruction(prediction: Tensor, target: Tensor) -> Tensor:
    """Squared error of a vector in symlog space, summed over the vector and averaged over the batch.

    Args:
        prediction: ``[*batch, N]``.
        target: ``[*batch, N]``.

    Examples:
        >>> import torch
        >>> symlog_reconstruction(torch.zeros(2, 3), torch.full((2, 3), torch.e - 1))
        tensor(3.)
    """
    return (symlog(prediction.float()) - symlog(target.float())).square().sum(-1).mean()


def visible_position_reconstruction(prediction: Tensor, target: Tensor, visible: Tensor) -> Tensor:
    """Squared error of the positions of visible objects in symlog space, summed, and averaged over the batch.

    Args:
        prediction: ``[*batch, O * D]``.
        target: ``[*batch, O * D]``. That of a hidden object is old and counts nothing.
        visible: ``[*batch, O]`` bool.

    Examples:
        >>> import torch
        >>> error = visible_position_reconstruction(torch.zeros(1, 4), torch.full((1, 4), torch.e - 1),
        ...     torch.tensor([[True, False]]))
        >>> error
        tensor(2.)
    """
    error = (symlog(prediction.float()) - symlog(target.float())).square().unflatten(-1, (visible.shape[-1], -1))
    return (error.sum(-1) * flags(visible, "object_visible")).sum(-1).mean()


def latent_dissimilarity(prediction: Tensor, state: Tensor, belief: Tensor) -> Tensor:
    """Minus the cosine similarity of latents and those that they are to be like, averaged over the batch.

    Args:
        prediction: ``[*batch, S + H]``.
        state: ``[*batch, S]``. State and belief are not trained.
        belief: ``[*batch, H]``.

    Examples:
        >>> import torch
        >>> latent_dissimilarity(torch.tensor([[6.0, 8.0]]), torch.tensor([[3.0]]), torch.tensor([[4.0]]))
        tensor(-1.)
    """
    target = cat([state.float(), belief.float()], -1).detach()
    return -cosine_similarity(prediction.float(), target, dim=-1).mean()


def continuation_nll(logits: Tensor, terminated: Tensor) -> Tensor:
    """−log p that an episode goes on, or that it has ended by itself, averaged over the batch.

    Args:
        logits: ``[*batch, 1]`` that it goes on.
        terminated: ``[*batch, 1]`` bool.

    Examples:
        >>> import torch
        >>> continuation_nll(torch.tensor([[3.0]]), torch.tensor([[True]]))
        tensor(3.0486)
    """
    return binary_cross_entropy_with_logits(logits, (~flags(terminated, "terminated")).to(logits.dtype))


class Term(NamedTuple):
    """One thing that a world model learns to predict.

    Args:
        prediction: Name of its key in ``_AcceptedKeys``.
        targets: Names of the keys of what it is compared with.
        error: From prediction and targets to a scalar.
    """

    prediction: str
    targets: tuple[str, ...]
    error: Callable[..., Tensor]


class WeightedModelLoss(DreamerV3ModelLoss):
    """TorchRL's DreamerV3 model loss with a weight for each thing that is reconstructed.

    Dynamics and representation KL, image and vector reconstruction, reward and continuation, each a ``loss_model_*``
    entry times its weight ``lambda_*``. The weights are those of the paper's loss-rescaling experiment: a goal
    position is three numbers beside thousands of pixels, and only a large ``lambda_goal_position`` makes a model
    remember it. A term whose prediction the world model does not write is left out, and takes no weight.

    The KL of each step is clipped from below at ``free_nats`` before it is averaged
    (:func:`~torchrl.objectives.categorical_kl_terms`).

    Args:
        world_model: Reads records ``[B, T]``, writes posterior, prior and predictions under ``next``.
        lambda_dynamic: Weight of the KL that trains the prior. The default of all weights but the next is 1.
        lambda_representation: Weight of the KL that trains the posterior.
        lambda_pixels: Weight of the image, squared error in [0, 1] summed over pixels.
        lambda_proprio: Weight of proprioception, squared error in symlog space summed over the vector.
        lambda_object_position: Weight of the positions of visible objects, likewise, in workspace units.
        lambda_goal_position: Weight of the goal position, likewise.
        lambda_reward: Weight of the reward, two-hot cross-entropy.
        lambda_continue: Weight of the continuation, binary cross-entropy.
        lambda_image_latent: Weight of what makes an image alone a goal: the position in it, weighted like the object
            positions too, and minus the cosine similarity of its latent and that of the whole observation.
        free_nats: Smallest KL that is charged, nats per step.
        unimix: Share of the uniform distribution in prior and posterior.

    ``forward`` returns the losses and the records with the world model's outputs, gradients attached.

    Raises:
        ValueError: for the weight of a term that the world model does not predict, and in :meth:`set_keys` for a
            prediction that it does not write; both would do nothing.
        KeyError: if the batch lacks a key that the world model reads or that its predictions are compared with.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> agent = build_agent("dreamer_pcp", reacher_task(), size="debug")
        >>> losses, records = WeightedModelLoss(agent.model.records())(random_records(reacher_task(), 2, 5))
        >>> sorted(losses.keys())
        ['loss_model_continue', 'loss_model_dynamic', 'loss_model_object_position', 'loss_model_pixels', \
'loss_model_proprio', 'loss_model_representation']
    """

    @dataclass
    class _AcceptedKeys(DreamerV3ModelLoss._AcceptedKeys):
        """Keys, all under ``next``. :meth:`set_keys` refuses those that no term uses.

        Attributes:
            reward (NestedKey): Reward in the records, ``[B, T, 1]``. Defaults to ``"reward"``.
            reward_logits (NestedKey): Predicted two-hot logits. Defaults to ``"reward_logits"``.
            prior_logits (NestedKey): Defaults to ``"prior_logits"``.
            posterior_logits (NestedKey): Defaults to ``"posterior_logits"``.
            pixels (NestedKey): Image in the records. Defaults to ``"pixels"``.
            reco_pixels (NestedKey): Predicted image. Defaults to ``"reco_pixels"``.
            proprio (NestedKey): Proprioception in the records. Defaults to ``"proprio"``.
            reco_proprio (NestedKey): Its prediction. Defaults to ``"reco_proprio"``.
            object_position (NestedKey): Object positions, ``[B, T, O * D]`` in workspace units. Defaults to
                ``"object_units"``.
            reco_object_position (NestedKey): Their prediction. Defaults to ``"reco_object_units"``.
            object_visible (NestedKey): Which objects are seen, ``[B, T, O]`` bool. Defaults to ``"object_visible"``.
            goal_position (NestedKey): Goal position, ``[B, T, D]`` in workspace units. Defaults to ``"goal_units"``.
            reco_goal_position (NestedKey): Its prediction. Defaults to ``"reco_goal_units"``.
            continue_pred (NestedKey): Predicted continuation logit. Defaults to ``"continue_pred"``.
            terminated (NestedKey): Whether the episode ended by itself. Defaults to ``"terminated"``.
            state (NestedKey): Posterior state, ``[B, T, S]``. Defaults to ``"state"``.
            belief (NestedKey): Belief, ``[B, T, H]``. Defaults to ``"belief"``.
            image_latent (NestedKey): State and belief of each image alone, ``[B, T, S + H]``. Defaults to
                ``"image_latent"``.
            reco_image_position (NestedKey): Positions decoded from these, ``[B, T, O * D]``. Defaults to
                ``"reco_image_units"``.
            true_reward (NestedKey): Not used; TorchRL's loss has it.
            done (NestedKey): Not used; TorchRL's loss has it.
        """

        proprio: NestedKey = "proprio"
        reco_proprio: NestedKey = "reco_proprio"
        object_position: NestedKey = "object_units"
        reco_object_position: NestedKey = "reco_object_units"
        object_visible: NestedKey = "object_visible"
        goal_position: NestedKey = "goal_units"
        reco_goal_position: NestedKey = "reco_goal_units"
        state: NestedKey = "state"
        belief: NestedKey = "belief"
        image_latent: NestedKey = "image_latent"
        reco_image_position: NestedKey = "reco_image_units"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        world_model: TensorDictModuleBase,
        *,
        lambda_dynamic: float = 1.0,
        lambda_representation: float = 0.1,
        lambda_pixels: float | None = None,
        lambda_proprio: float | None = None,
        lambda_object_position: float | None = None,
        lambda_goal_position: float | None = None,
        lambda_reward: float | None = None,
        lambda_continue: float | None = None,
        lambda_image_latent: float | None = None,
        free_nats: float = 1.0,
        unimix: float = 0.01,
    ) -> None:
        super().__init__(
            world_model,
            kl_mode="separate",
            lambda_dynamic=lambda_dynamic,
            lambda_representation=lambda_representation,
            free_bits=free_nats,
            unimix=unimix,
            detach_output=False,
        )
        self._given: dict[str, str] = {}
        self._set_weights(
            pixels=lambda_pixels,
            proprio=lambda_proprio,
            object_position=lambda_object_position,
            goal_position=lambda_goal_position,
            reward=lambda_reward,
            image_latent=lambda_image_latent,
            **{"continue": lambda_continue},
        )

    def terms(self) -> dict[str, Term]:
        """All that a world model can learn to predict, beside the KL terms."""
        return {
            "pixels": Term("reco_pixels", ("pixels",), image_reconstruction),
            "proprio": Term("reco_proprio", ("proprio",), symlog_reconstruction),
            "object_position": Term(
                "reco_object_position", ("object_position", "object_visible"), visible_position_reconstruction
            ),
            "goal_position": Term("reco_goal_position", ("goal_position",), symlog_reconstruction),
            "reward": Term("reward_logits", ("reward",), self._reward_nll),
            "continue": Term("continue_pred", ("terminated",), continuation_nll),
            "image_latent": Term("image_latent", ("state", "belief"), latent_dissimilarity),
            "image_position": Term(
                "reco_image_position", ("object_position", "object_visible"), visible_position_reconstruction
            ),
        }

    def weight(self, term: str) -> float | Tensor:
        """The weight of a term now; the position in an image alone has both weights that it is about."""
        if term == "image_position":
            return self.weight("image_latent") * self.weight("object_position")
        weight = getattr(self, f"lambda_{term}")
        return weight() if isinstance(weight, AnnealedWeight) else weight

    @property
    def predicted(self) -> dict[str, Term]:
        """The terms that the world model writes a prediction for.

        Raises:
            ValueError: if a setting was given for another term.
        """
        written = self._written()
        predicted = {name: term for name, term in self.terms().items() if self._key(term.prediction) in written}
        for setting, name in self._given.items():
            if name not in predicted:
                key = _names([self._key(self.terms()[name].prediction)])
                raise ValueError(f"{setting} does nothing: the world model does not write {key}, which it is about")
        return predicted

    @property
    def targets(self) -> list[NestedKey]:
        """What the predictions are compared with, of the records."""
        names = dict.fromkeys(name for term in self.predicted.values() for name in term.targets)
        written = self._written()
        # The world model writes positions in units, which are targets, and a reward of its own, which is none.
        return [self._key(name) for name in names if name == "reward" or self._key(name) not in written]

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the world model reads, and the targets of its predictions."""
        return list(dict.fromkeys([*self.world_model.in_keys, *self.targets]))

    @property
    def out_keys(self) -> list[str]:
        """The losses."""
        return [f"loss_model_{name}" for name in ("dynamic", "representation", *self.predicted)]

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """Set the names of keys; ``None`` is the default.

        Raises:
            ValueError: for a key that no term uses, or a prediction that the world model does not write.
        """
        super().set_keys(**kwargs)
        terms = self.terms().values()
        predictions = {"prior_logits", "posterior_logits", *(term.prediction for term in terms)}
        for name in kwargs:
            if name not in predictions and not any(name in term.targets for term in terms):
                raise ValueError(f"{type(self).__name__} does not use the key {name!r}")
            if name in predictions and self._key(name) not in self._written():
                raise ValueError(
                    f"{name}={kwargs[name]!r}: the world model does not write {_names([self._key(name)])}; it writes "
                    f"{_names(self._written())}"
                )

    def forward(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Losses of records ``[B, T]``, scalars, and the records with the predictions."""
        missing = [key for key in self.in_keys if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(
                f"the batch lacks {_names(missing)}, which the world model reads or learns to predict; it has "
                f"{_names(tensordict.keys(True, True))}"
            )
        # A new container: the caller's batch stays as it is.
        records = self.world_model(tensordict.select(*tensordict.keys(True, True)))
        losses = self._kl_losses(records)
        # The world model overwrites the recorded reward with its prediction.
        known = {"reward": tensordict.get(self._key("reward"), None)}
        for name, term in self.predicted.items():
            targets = [known.get(target, records.get(self._key(target), None)) for target in term.targets]
            error = term.error(records[self._key(term.prediction)], *targets)
            losses[f"loss_model_{name}"] = self.weight(name) * error
        return TensorDict(losses), records

    def _set_weights(self, **weights: float | None) -> None:
        """Set ``lambda_*``, and remember which were given: those must do something."""
        terms = self.terms()
        for name, weight in weights.items():
            if name in terms:
                setattr(self, f"lambda_{name}", 1.0 if weight is None else weight)
            elif weight is not None:
                raise ValueError(f"lambda_{name} does nothing: {type(self).__name__} has the terms {', '.join(terms)}")
            if weight is not None:
                self._given[f"lambda_{name}"] = name

    def _key(self, name: str) -> NestedKey:
        return unravel_key(("next", getattr(self.tensor_keys, name)))

    def _written(self) -> list[NestedKey]:
        return [unravel_key(key) for key in self.world_model.out_keys]

    def _kl_losses(self, records: TensorDictBase) -> dict[str, Tensor]:
        dynamic, representation = categorical_kl_terms(
            records[self._key("posterior_logits")],
            records[self._key("prior_logits")],
            free_nats=self.free_bits,
            unimix=self.unimix,
        )
        return {
            "loss_model_dynamic": self.lambda_dynamic * dynamic,
            "loss_model_representation": self.lambda_representation * representation,
        }

    def _reward_nll(self, logits: Tensor, reward: Tensor) -> Tensor:
        return two_hot_cross_entropy(logits, reward.float(), self.reward_bins).mean()


def _names(keys: Iterable[NestedKey]) -> str:
    """Keys as the documentation writes them, ``next.pixels``."""
    return ", ".join(sorted(key if isinstance(key, str) else ".".join(key) for key in keys))
