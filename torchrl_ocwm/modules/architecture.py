"""How large the networks of an agent are, as one object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from torchrl_ocwm.settings import Settings, SettingsError, setting

Style = Literal["dreamer_v3", "dreamer_v2"]


@dataclass(frozen=True, kw_only=True)
class Architecture(Settings):
    """Shapes of the networks of world model, actor and critic.

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
        object_features: Features of an object latent, for object-centric world models.
        extractor_units: Units of the two layers that extract it.

    Raises:
        SettingsError: for numbers that do not fit together.

    Examples:
        >>> Architecture(belief=12)
        Traceback (most recent call last):
        torchrl_ocwm.settings.SettingsError: belief must be a multiple of gru_blocks, got 12 and 8
    """

    style: Style = "dreamer_v3"
    cnn_depth: int = setting(8, at_least=1, at_most=10**4)
    cnn_mults: tuple[int, ...] = setting((1, 2, 4, 8), at_least=1, at_most=1000)
    categoricals: int = setting(16, at_least=1, at_most=10**4)
    classes: int = setting(16, at_least=1, at_most=10**4)
    belief: int = setting(128, at_least=1, at_most=10**6)
    hidden: int = setting(128, at_least=1, at_most=10**6)
    gru_blocks: int = setting(8, at_least=1, at_most=10**4)
    mlp_layers: int = setting(2, at_least=1, at_most=1000)
    mlp_units: int = setting(128, at_least=1, at_most=10**6)
    object_features: int = setting(128, at_least=1, at_most=10**6)
    extractor_units: int = setting(128, at_least=1, at_most=10**6)

    @property
    def mlp(self) -> dict[str, Any]:
        """Arguments of :func:`~torchrl_ocwm.modules.networks.make_mlp` for networks of vectors."""
        return {"style": self.style, "layers": self.mlp_layers, "units": self.mlp_units}

    def validate(self) -> None:
        """Numbers that do not fit together, and those that a style does not use."""
        if not self.cnn_mults:
            raise SettingsError("cnn_mults must have a multiplier for at least one stage, got ()")
        if self.belief % self.gru_blocks:
            raise SettingsError(f"belief must be a multiple of gru_blocks, got {self.belief} and {self.gru_blocks}")
        for name, fixed in (("cnn_mults", (1, 2, 4, 8)), ("gru_blocks", 8)):
            if self.style == "dreamer_v2" and getattr(self, name) != fixed:
                raise SettingsError(f"{name} does nothing in style='dreamer_v2'; leave it at {fixed}")
