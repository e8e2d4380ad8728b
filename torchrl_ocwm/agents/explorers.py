"""Exploration rewards: what is new is worth a visit, whatever the task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential

from torchrl_ocwm.agents.goals import GoalEncoding, SelectObject, object_centric
from torchrl_ocwm.agents.rewards import ImaginedReward, Reward
from torchrl_ocwm.agents.scene import Scene
from torchrl_ocwm.modules import DisagreementReward, EntropyReward, OneStepEnsemble, StreamingNorm
from torchrl_ocwm.modules.normalization import Normalization
from torchrl_ocwm.objectives import EnsembleLoss
from torchrl_ocwm.parts import register
from torchrl_ocwm.settings import setting


@dataclass(frozen=True)
class ExplorationReward(Reward):
    """A reward on a scale of its own, which nobody knows in advance.

    Args:
        normalize: How rewards are brought to one scale, by moments that move along with them
            (:class:`~torchrl_ocwm.modules.StreamingNorm`): ``"standard"`` subtracts their mean and divides by their
            standard deviation; ``"scale"`` divides by their root mean square; ``"none"`` leaves them as they are.
    """

    normalize: Normalization = "standard"

    def normalized(self, *reward: TensorDictModuleBase) -> TensorDictSequential:
        """Modules that write ``reward``, and then its normalisation."""
        norm = [] if self.normalize == "none" else [TensorDictModule(StreamingNorm(self.normalize), *2 * [["reward"]])]
        return TensorDictSequential(*reward, *norm)


@register("disagreement")
@dataclass(frozen=True)
class Disagreement(ExplorationReward):
    """How little an ensemble agrees on what an action leads to (Plan2Explore).

    The defaults are those of the paper's release; LEXA has 10 members of 4 layers, ``target="state"`` and ``log``.

    Args:
        members: Networks in the ensemble.
        layers: Hidden layers of each.
        units: Units of each layer; ``None``: those of the size's MLPs.
        target: What they predict of the next frame: its embedding, or the stochastic state that it is seen as.
        log: The logarithm of the standard deviation of the predictions instead of their variance.
        lr: Learning rate of the ensemble; ``None``: that of the world model.
    """

    members: int = setting(5, at_least=2)
    layers: int = setting(1, at_least=0)
    units: int | None = setting(None, at_least=1)
    target: Literal["embedding", "state"] = "embedding"
    log: bool = False
    lr: float | None = setting(None, at_least=0)

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The disagreement, and the loss that trains the ensemble."""
        model, size = scene.model, scene.architecture
        key, features = {
            "embedding": ("encoded_latents", model.encoder.features),
            "state": ("state", model.state),
        }[self.target]
        ensemble = OneStepEnsemble(
            model.latent_features + model.action,
            features,
            members=self.members,
            layers=self.layers,
            units=self.units or size.mlp_units,
            style=size.style,
        )
        loss = EnsembleLoss(ensemble)
        loss.set_keys(target=key)
        return ImaginedReward(self.normalized(DisagreementReward(ensemble, log=self.log)), loss, self.lr)


@register("object_entropy")
@dataclass(frozen=True)
class ObjectEntropy(ExplorationReward):
    """How far the latents of the objects lie from those of all other imagined states (FOCUS).

    Args:
        k: Nearest neighbours whose distances are averaged.
        clip: Distance that counts as none.
        objects: Sum over all objects of the scene, or only that which the behaviour is about.
    """

    k: int = setting(30, at_least=1)
    clip: float = setting(1e-4, at_least=0)
    objects: Literal["all", "one"] = "all"

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The entropy, from the extracted latents."""
        model, one = object_centric(scene.model), self.objects == "one"
        latents = [model.object_latent(scene.object_index + 1 if one else model.objects)]
        if one:
            latents.append(TensorDictModule(SelectObject(scene.object_index), *2 * [["object_latent"]]))
        return ImaginedReward(self.normalized(*latents, EntropyReward(k=self.k, clip=self.clip, flat=one)))


@register("state_entropy")
@dataclass(frozen=True)
class StateEntropy(ExplorationReward):
    """How far the deterministic state lies from those of all other imagined states (APT).

    Args:
        k: Nearest neighbours whose distances are averaged.
        clip: Distance that counts as none.
    """

    k: int = setting(12, at_least=1)
    clip: float = setting(0.0, at_least=0)

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The entropy of the belief."""
        entropy = EntropyReward(k=self.k, clip=self.clip, latent_key=("latent", "belief"), flat=True)
        return ImaginedReward(self.normalized(entropy))
