"""World models: encoder, RSSM, vector decoders and heads; the flat one with one latent state for the whole scene."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial
from typing import Any, Literal

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.modules import RSSMStateEstimatorV3, SymExpTwoHot

from torchrl_ocwm.images import ImageSize
from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.modules.latent import FullLatent, InitialLatent, LatentOfImages, LatentsInEmbedding, LatentsInImages
from torchrl_ocwm.modules.networks import make_image_decoder, make_mlp, make_rssm
from torchrl_ocwm.modules.observation import ObservationEncoder
from torchrl_ocwm.modules.recurrence import Rollout
from torchrl_ocwm.modules.units import WorkspaceUnits
from torchrl_ocwm.settings import SettingsError

VectorName = Literal["proprio", "object_position", "goal_position"]
_KEYS: dict[str, str] = {"proprio": "proprio", "object_position": "object_units", "goal_position": "goal_units"}


class RSSMWorldModel(nn.Module, ABC):
    """Encoder, discrete RSSM, decoders and heads, as TensorDictModules for training, imagination and acting.

    The networks exist once; each method gives a module that applies them to the keys of one place:
    :meth:`records` to sequences of records, :meth:`transition`, :meth:`object_position`, :meth:`reward` and
    :meth:`continuation` to imagined latents, :meth:`filter` to the observations that a policy acts on.

    A subclass says how the scene is decoded: :meth:`images`, :meth:`pixels` and :meth:`object_position`.

    Args:
        image_size: Height and width of the images, pixels; one number if they are the same.
        proprio: Number of proprioceptive values P.
        objects: Number of objects O.
        action: Number of actions A.
        units: Workspace units of the positions.
        observed: Vectors that the encoder sees.
        predicted: Vectors that are decoded beside these, though it does not see them.
        of_scene: Those of both that are decoded from the latent of the scene.
        reward_head: Whether to predict the reward.
        architecture: Shapes of the networks.
    """

    def __init__(
        self,
        *,
        image_size: ImageSize,
        proprio: int,
        objects: int,
        action: int,
        units: WorkspaceUnits,
        observed: tuple[VectorName, ...],
        predicted: tuple[VectorName, ...] = (),
        of_scene: tuple[VectorName, ...],
        reward_head: bool,
        architecture: Architecture,
    ) -> None:
        super().__init__()
        self.action, self.belief = action, architecture.belief
        self.state = architecture.categoricals * architecture.classes
        self.units, self.observed, self.decoded = units, tuple(observed), (*observed, *predicted)
        vectors = {"proprio": proprio, "object_position": objects * units.dim, "goal_position": units.dim}
        mlp = partial(make_mlp, in_features=self.latent_features, **architecture.mlp)
        self.encoder = ObservationEncoder(image_size, sum(vectors[name] for name in observed), architecture)
        self.prior, self.posterior = make_rssm(architecture, action=action, embedding=self.encoder.features)
        self.vector_decoders = nn.ModuleDict({name: mlp(out_features=vectors[name]) for name in of_scene})
        self.continue_head = mlp(out_features=1, layers=1)
        self.two_hot = SymExpTwoHot()
        self.reward_head = mlp(out_features=self.two_hot.num_bins, outscale=0.0) if reward_head else None

    @property
    def latent_features(self) -> int:
        """Features of state and belief together."""
        return self.state + self.belief

    # Modules for training on records.

    def records(self) -> TensorDictSequential:
        """Posterior, prior and predictions for records ``[B, T]``; all but actions is read and written under ``next``.

        Recorded actions beyond [−1, 1] count as clipped, as they do in imagination and in acting.
        """
        rollout = Rollout(
            TensorDictModule(
                self.prior,
                in_keys=["state", "belief", "action"],
                out_keys=[("next", "prior_logits"), ("next", "state"), ("next", "belief")],
            ),
            TensorDictModule(
                self.posterior,
                in_keys=[("next", "belief"), ("next", "encoded_latents")],
                out_keys=[("next", "posterior_logits"), ("next", "state")],
            ),
        )
        rollout.in_keys = [*rollout.in_keys, "is_init"]  # TorchRL's takes it as optional: then memory crosses episodes
        return TensorDictSequential(
            InitialLatent(self.state, self.belief),
            *self._encode("next", in_units=self.decoded),
            rollout,
            *self.decoders("next"),
        )

    def decoders(self, *at: str) -> list[TensorDictModuleBase]:
        """Predictions of all that was observed, and of reward and continuation, from the latent at a place."""
        latent = latent_at(at)
        modules = [*self.vectors(*at), *self.images(*at)]
        if self.reward_head is not None:
            modules.append(TensorDictModule(self.reward_head, latent, [key_at(at, "reward_logits")]))
            modules.append(TensorDictModule(self.two_hot, [key_at(at, "reward_logits")], [key_at(at, "reward")]))
        modules.append(TensorDictModule(self.continue_head, latent, [key_at(at, "continue_pred")]))
        return modules

    @abstractmethod
    def images(self, *at: str) -> list[TensorDictModuleBase]:
        """Predictions of what is seen, from what :meth:`vectors` has left at a place."""

    @abstractmethod
    def pixels(self, state: Tensor, belief: Tensor) -> Tensor:
        """Predicted images ``[..., 3, H, W]`` in [0, 1], unbounded."""

    @abstractmethod
    def object_position(self) -> TensorDictModuleBase:
        """Decoded object positions ``object_units`` ``[..., O * D]`` of imagined latents, in workspace units."""

    def vectors(self, *at: str) -> list[TensorDictModuleBase]:
        """Predictions of the observed vectors from the latent at a place: ``reco_proprio``, …, ``reco_goal_units``."""
        return [
            TensorDictModule(decoder, latent_at(at), [key_at(at, f"reco_{_KEYS[name]}")])
            for name, decoder in self.vector_decoders.items()
        ]

    def _encode(self, *at: str, in_units: tuple[VectorName, ...] = ()) -> list[TensorDictModuleBase]:
        """Positions to workspace units (``in_units``: others too), then what is observed to ``encoded_latents``."""
        modules, in_units = list[TensorDictModuleBase](), in_units or self.observed
        if "object_position" in in_units:
            flatten = _ObjectUnits(self.units)
            modules.append(TensorDictModule(flatten, [key_at(at, "object_position")], [key_at(at, "object_units")]))
        if "goal_position" in in_units:
            modules.append(TensorDictModule(self.units, [key_at(at, "goal_position")], [key_at(at, "goal_units")]))
        inputs = [key_at(at, "pixels"), *(key_at(at, _KEYS[name]) for name in self.observed)]
        return [*modules, TensorDictModule(self.encoder, inputs, [key_at(at, "encoded_latents")])]

    # Modules for imagination, on ``latent = {state, belief, goal}``.

    def transition(self) -> TensorDictSequential:
        """Next state and belief, sampled from the prior. Actions beyond [−1, 1] count as clipped."""
        latent = latent_at(("latent",))
        return TensorDictSequential(
            TensorDictModule(self.prior, [*latent, "action"], ["_", *latent]),
        )

    def reward(self) -> TensorDictSequential:
        """Predicted reward ``[..., 1]``.

        Raises:
            ValueError: if the model has no reward head.
        """
        if self.reward_head is None:
            raise ValueError("this world model has no reward head; build it with reward_head=True")
        return TensorDictSequential(
            TensorDictModule(self.reward_head, latent_at(("latent",)), ["reward_logits"]),
            TensorDictModule(self.two_hot, ["reward_logits"], ["reward"]),
        )

    def continuation(self) -> TensorDictSequential:
        """Predicted probability ``continuation`` ``[..., 1]`` that the episode goes on."""
        return TensorDictSequential(
            TensorDictModule(self.continue_head, latent_at(("latent",)), ["continue_pred"]),
            TensorDictModule(torch.sigmoid, ["continue_pred"], ["continuation"]),
        )

    # Modules for acting.

    def filter(self) -> TensorDictSequential:
        """Posterior of the current observation, from the latent and the action of the step before.

        Reads observations, ``is_init`` and ``latent = {state, belief, action}``; writes the new state and belief.
        """
        latent = latent_at(("latent",))
        estimator = RSSMStateEstimatorV3(
            self.prior,
            self.posterior,
            in_keys=[*latent, ("latent", "action"), "encoded_latents", "is_init"],
            out_keys=latent,
        )
        return TensorDictSequential(*self._encode(), estimator)

    def latent_of_images(self) -> LatentOfImages:
        """State and belief after images that are all there is: a goal, say."""
        return LatentOfImages(self.prior, self.posterior, state=self.state, belief=self.belief, action=self.action)


class FlatWorldModel(RSSMWorldModel):
    """One latent state for the whole scene, from which image and vectors are decoded (Dreamer).

    Args:
        image_size: Height and width of the images, pixels; one number if they are the same.
        observed: Vectors that the encoder sees and the decoder reconstructs.
        predicted: Vectors that the decoder reconstructs, and the encoder does not see.
        architecture: Shapes of the networks.
        image_latent: Whether the latents of images alone are learnt, which are goals then.
        kwargs: The other arguments of :class:`RSSMWorldModel`.

    Examples:
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> from torchrl_ocwm.agents import build_agent
        >>> model = build_agent("dreamer_pcp", reacher_task(), size="debug").model
        >>> records = model.records()(random_records(reacher_task(), 2, 5))
        >>> records["next", "reco_pixels"].shape
        torch.Size([2, 5, 3, 64, 64])
    """

    def __init__(
        self,
        *,
        image_size: ImageSize,
        observed: tuple[VectorName, ...],
        predicted: tuple[VectorName, ...] = (),
        architecture: Architecture,
        image_latent: bool = False,
        **kwargs: Any,
    ) -> None:
        scene: dict[str, Any] = {"image_size": image_size, "architecture": architecture}
        vectors: dict[str, Any] = {"observed": observed, "predicted": predicted, "of_scene": (*observed, *predicted)}
        super().__init__(**vectors, **scene, **kwargs)
        self.image_decoder = make_image_decoder(architecture, self.latent_features, image_size)
        self.image_latent = image_latent

    def records(self) -> TensorDictSequential:
        """Posterior, prior and predictions for records ``[B, T]``; everything is read and written under ``next``.

        With ``image_latent`` also the latent ``image_latent`` ``[B, T, S + H]`` of each image alone, as if it were the
        first frame of an episode, and the positions ``reco_image_units`` ``[B, T, O * D]`` in it.
        """
        records = super().records()
        if not self.image_latent:
            return records
        embedding, image = ("next", "encoded_latents"), ("next", "image_latent")
        modules = [TensorDictModule(LatentsInEmbedding(self.latent_in_images()), [embedding], [image])]
        if "object_position" in self.vector_decoders:
            decoder = self.vector_decoders["object_position"]
            modules.append(TensorDictModule(decoder, [image], [("next", "reco_image_units")]))
        return TensorDictSequential(records, *modules)

    def latent_in_images(self) -> LatentsInImages:
        """State and belief ``[..., S + H]`` after images ``[..., F, 3, H, W]`` uint8, one after the other."""
        return LatentsInImages(self.encoder, self.latent_of_images(), FullLatent())

    def images(self, *at: str) -> list[TensorDictModuleBase]:
        """``reco_pixels``."""
        return [TensorDictModule(self.image_decoder, latent_at(at), [key_at(at, "reco_pixels")])]

    def pixels(self, state: Tensor, belief: Tensor) -> Tensor:
        """Predicted images ``[..., 3, H, W]`` in [0, 1], unbounded."""
        return self.image_decoder(state, belief)

    def object_position(self) -> TensorDictModule:
        """Decoded object positions ``object_units`` ``[..., O * D]``, in workspace units.

        Raises:
            SettingsError: if the model does not decode them.
        """
        if "object_position" not in self.vector_decoders:
            raise SettingsError(
                "this world model does not decode object positions; add 'object_position' to `observed` or `predicted`"
            )
        return TensorDictModule(self.vector_decoders["object_position"], latent_at(("latent",)), ["object_units"])


class _ObjectUnits(nn.Module):
    """Object positions ``[..., O, D]`` in metres to ``[..., O * D]`` in workspace units."""

    def __init__(self, units: WorkspaceUnits) -> None:
        super().__init__()
        self.units = units

    def forward(self, metres: Tensor) -> Tensor:
        return self.units(metres).flatten(-2)


def key_at(at: tuple[str, ...], name: str) -> NestedKey:
    """The key of something that is kept under a path."""
    return unravel_key((*at, name))


def latent_at(at: tuple[str, ...]) -> list[NestedKey]:
    """The keys of state and belief that are kept under a path."""
    return [key_at(at, "state"), key_at(at, "belief")]
