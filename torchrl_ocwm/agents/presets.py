"""The agents and sizes by name."""

from __future__ import annotations

from dataclasses import asdict

from torchrl_ocwm.agents.config import AgentConfig, Size

AGENTS = {
    "dreamer": AgentConfig(observed=("proprio", "object_position", "goal_position")),
    "dreamer_pcp": AgentConfig(goal="position", reward="position_distance", goal_source="uniform"),
    "focus": AgentConfig(world_model="object", observed=("proprio", "object_position", "goal_position")),
    "focus_pcp": AgentConfig(world_model="object", goal="position", reward="position_distance", goal_source="uniform"),
    "focus_lcp": AgentConfig(
        world_model="object",
        goal="object_latent",
        reward="latent_chord",
        goal_source="uniform",
        lambda_positional=100.0,
    ),
}

# fmt: off
SIZES = {
    "debug": Size(
        style="dreamer_v3", cnn_depth=2, cnn_mults=(1, 2, 2, 2), categoricals=4, classes=4,
        belief=16, hidden=16, gru_blocks=2,
        mlp_layers=1, mlp_units=16, batch_size=2, slice_len=8, imagination_horizon=3,
        model_lr=1e-3, actor_lr=1e-3, value_lr=1e-3, warmup=0,
        object_features=16, extractor_units=16,
    ),
    "cpu": Size(
        style="dreamer_v3", cnn_depth=8, cnn_mults=(1, 2, 4, 4), categoricals=16, classes=16,
        belief=128, hidden=128, gru_blocks=8,
        mlp_layers=2, mlp_units=128, batch_size=8, slice_len=16, imagination_horizon=10,
        model_lr=1e-3, actor_lr=1e-3, value_lr=1e-3, warmup=100, gamma=0.95,
        object_features=128, extractor_units=128,
    ),
    "small": Size(
        style="dreamer_v3", cnn_depth=24, cnn_mults=(1, 2, 4, 8), categoricals=32, classes=16,
        belief=512, hidden=256, gru_blocks=8,
        mlp_layers=3, mlp_units=256, batch_size=16, slice_len=32, imagination_horizon=15,
        model_lr=3e-4, actor_lr=1e-4, value_lr=1e-4, warmup=500,
        object_features=512, extractor_units=256,
    ),
    "paper": Size(
        style="dreamer_v2", cnn_depth=48, cnn_mults=(1, 2, 4, 8), categoricals=32, classes=32,
        belief=200, hidden=200, gru_blocks=8,
        mlp_layers=4, mlp_units=400, batch_size=32, slice_len=32, imagination_horizon=15,
        model_lr=3e-4, actor_lr=8e-5, value_lr=8e-5, warmup=0, entropy_bonus=0.0, lambda_dynamic=0.5,
        object_features=1536, extractor_units=512, optimizer="adam",
    ),
    "large": Size(
        style="dreamer_v3", cnn_depth=64, cnn_mults=(1, 2, 4, 8), categoricals=32, classes=64,
        belief=2048, hidden=512, gru_blocks=8,
        mlp_layers=3, mlp_units=512, batch_size=32, slice_len=64, imagination_horizon=15,
        model_lr=1e-4, actor_lr=4e-5, value_lr=4e-5, warmup=1000,
        object_features=2048, extractor_units=1024,
    ),
}
# fmt: on


def agent_name(config: AgentConfig) -> str:
    """Name of a row of choices: that of the nearest preset, and in what it differs.

    Examples:
        >>> from dataclasses import replace
        >>> agent_name(replace(AGENTS["dreamer"], lambda_goal_position=200.0))
        'dreamer (lambda_goal_position=200.0)'
    """
    here = asdict(config)
    differences = {
        name: {key: value for key, value in here.items() if value != asdict(preset)[key]}
        for name, preset in AGENTS.items()
    }
    nearest = min(differences, key=lambda name: len(differences[name]))
    changed = ", ".join(f"{key}={value}" for key, value in differences[nearest].items())
    return f"{nearest} ({changed})" if changed else nearest
