"""What there is to choose: agents as rows, and sizes."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal, get_args, get_type_hints


def check_choices(config: Any) -> None:
    """Check the fields of a dataclass that are typed as choices.

    Raises:
        ValueError: for a value that is not one of its field's ``Literal``, with those that are.

    Examples:
        >>> AgentConfig(goal="latent")
        Traceback (most recent call last):
        ValueError: goal must be one of 'none', 'position', 'object_latent', got 'latent'
    """
    for name, hint in get_type_hints(type(config)).items():
        value = getattr(config, name)
        many = getattr(hint, "__origin__", None) is tuple
        choices = get_args(get_args(hint)[0] if many else hint)
        if not choices or not all(isinstance(choice, str) for choice in choices):
            continue
        for one in value if many else (value,):
            if one not in choices:
                raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {one!r}")


@dataclass(frozen=True)
class AgentConfig:
    """One row of the table of agents (docs/agents.md).

    Args:
        world_model: Which world model: one latent for the whole scene, or one for each object too.
        goal: How a goal position becomes what policy and critic see beside the latent: not at all, as it is,
            or as the latent that the object would have there.
        reward: The reward in imagination: the learned head, the distance of the decoded position to the goal, the
            similarity of the object's latent and the goal latent, or the distance between the directions of these.
        goal_source: Where goals in imagination come from: ``"environment"`` (in the observations), ``"uniform"`` in the
            workspace for each imagined start, ``"frames"`` of the dataset, or ``"mixed"``, half of each.
        latent_distance: How far apart two object latents are, in the reward ``"latent_similarity"`` and in training
            what encodes goals: minus the cosine similarity, or the mean squared error.
        positional_gradient: What the loss of the latent positional encoder trains: the encoder, the object latents that
            it aims at, or both.
        observed: Vectors that the world model sees and reconstructs, beside the image.
        lambda_proprio: Weight of the reconstruction of proprioception.
        lambda_object_position: Weight of the reconstruction of the object positions.
        lambda_goal_position: Weight of the reconstruction of the goal position.
        lambda_positional: Weight of the loss of the latent positional encoder.
    """

    world_model: Literal["flat", "object"] = "flat"
    goal: Literal["none", "position", "object_latent"] = "none"
    reward: Literal["head", "position_distance", "latent_similarity", "latent_chord"] = "head"
    goal_source: Literal["environment", "uniform", "frames", "mixed"] = "environment"
    latent_distance: Literal["cosine", "mse"] = "cosine"
    positional_gradient: Literal["encoder", "latent", "both"] = "both"
    observed: tuple[Literal["proprio", "object_position", "goal_position"], ...] = ("proprio", "object_position")
    lambda_proprio: float = 1.0
    lambda_object_position: float = 200.0
    lambda_goal_position: float = 1.0
    lambda_positional: float = 1.0

    def __post_init__(self) -> None:
        check_choices(self)


@dataclass(frozen=True)
class Size:
    """How large a model is, how much it sees per update and how fast it learns.

    Args:
        style: Which layers: ``"dreamer_v3"`` or ``"dreamer_v2"`` (:mod:`torchrl_ocwm.modules.networks`).
        cnn_depth: Channels of the CNN's first stage before its multiplier.
        cnn_mults: Channel multiplier of each stage; each halves the image.
        categoricals: Categorical variables of the stochastic state.
        classes: Classes of each.
        belief: Features of the deterministic state, a multiple of ``gru_blocks``.
        hidden: Units in the layers of the RSSM.
        gru_blocks: Blocks of the recurrent layer.
        mlp_layers: Hidden layers of encoder, decoders and heads for vectors, of actor and critic.
        mlp_units: Units of each.
        batch_size: Sequences per update.
        slice_len: Frames per sequence.
        imagination_horizon: Imagined steps from each frame.
        model_lr: Learning rate of the world model.
        actor_lr: Learning rate of the actor.
        value_lr: Learning rate of the critic.
        warmup: Updates until the learning rates are reached; 0 with ``optimizer="adam"``, which has none.
        gamma: Discount of a step in imagination.
        entropy_bonus: Weight of the actor's entropy.
        object_features: Features of an object latent, for object-centric world models.
        extractor_units: Units of the two layers that extract it.
        lambda_dynamic: Weight of the KL that trains the prior; that which trains the posterior has 0.1.
        optimizer: ``"dreamer_v3"``, TorchRL's, or ``"adam"`` (:mod:`torchrl_ocwm.training.optimizer`).
    """

    style: Literal["dreamer_v3", "dreamer_v2"]
    cnn_depth: int
    cnn_mults: tuple[int, ...]
    categoricals: int
    classes: int
    belief: int
    hidden: int
    gru_blocks: int
    mlp_layers: int
    mlp_units: int
    batch_size: int
    slice_len: int
    imagination_horizon: int
    model_lr: float
    actor_lr: float
    value_lr: float
    warmup: int
    gamma: float = 0.99
    entropy_bonus: float = 3e-4
    object_features: int = 256
    extractor_units: int = 512
    lambda_dynamic: float = 1.0
    optimizer: Literal["dreamer_v3", "adam"] = "dreamer_v3"

    def __post_init__(self) -> None:
        check_choices(self)
        if self.optimizer == "adam" and self.warmup:
            raise ValueError(f"optimizer='adam' has no warm-up; set warmup=0, got {self.warmup}")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type == "int" and field.name != "warmup" and value < 1:
                raise ValueError(f"{field.name} must be at least 1, got {value}")
        if self.belief % self.gru_blocks:
            raise ValueError(f"belief must be a multiple of gru_blocks, got {self.belief} and {self.gru_blocks}")

    def architecture(self) -> dict[str, Any]:
        """The part that shapes the world model's networks."""
        names = [field.name for field in fields(self)]
        return {name: getattr(self, name) for name in names[: names.index("mlp_units") + 1]}
