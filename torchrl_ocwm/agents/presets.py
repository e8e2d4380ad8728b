"""The agents and sizes by name."""

from __future__ import annotations

from typing import Any

from torchrl_ocwm.agents.config import EXPLORE, REACH, AgentConfig, Behaviour, Learning, Size
from torchrl_ocwm.agents.explorers import Disagreement, ObjectEntropy, StateEntropy
from torchrl_ocwm.agents.goal_sources import FrameGoalSource, UniformGoalSource
from torchrl_ocwm.agents.goals import FullLatent, ImageEmbedding, ObjectLatent, Position
from torchrl_ocwm.agents.optimizers import Adam, DreamerV3
from torchrl_ocwm.agents.rewards import FullLatentCosine, LatentChord, PositionDistance, TemporalDistance
from torchrl_ocwm.agents.world_models import Flat, ObjectCentric
from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.modules.world_model import VectorName
from torchrl_ocwm.settings import flat, to_dict

_WITH_GOAL: tuple[VectorName, ...] = ("proprio", "object_position", "goal_position")
_PCP = Behaviour(goal=Position(), reward=PositionDistance(), goals=UniformGoalSource())
_LCP = Behaviour(goal=ObjectLatent(weight=100.0), reward=LatentChord(), goals=UniformGoalSource())

#: Behaviours that explore, for any row (``explore=`` on the command line). Add one of your own under a new name.
EXPLORERS = {
    "plan2explore": Behaviour(reward=Disagreement()),
    "focus_explore": Behaviour(reward=ObjectEntropy()),
    "apt": Behaviour(reward=StateEntropy()),
}

#: The rows. Add one of your own under a new name, and it can be built, trained and loaded by it.
AGENTS = {
    "dreamer": AgentConfig(Flat(observed=_WITH_GOAL)),
    "dreamer_pcp": AgentConfig(Flat(), {REACH: _PCP}),
    "focus": AgentConfig(ObjectCentric(observed=_WITH_GOAL)),
    "focus_pcp": AgentConfig(ObjectCentric(), {REACH: _PCP}),
    "focus_lcp": AgentConfig(ObjectCentric(), {REACH: _LCP}),
    "lexa_cosine": AgentConfig(Flat(), {REACH: Behaviour(FullLatent(), FullLatentCosine(), FrameGoalSource())}),
    "lexa_temporal": AgentConfig(Flat(), {REACH: Behaviour(ImageEmbedding(), TemporalDistance(), FrameGoalSource())}),
    "plan2explore": AgentConfig(Flat(), {EXPLORE: EXPLORERS["plan2explore"]}),
    "focus_explore": AgentConfig(ObjectCentric(), {EXPLORE: EXPLORERS["focus_explore"]}),
}

# fmt: off
SIZES = {
    "debug": Size(
        Architecture(
            cnn_depth=2, cnn_mults=(1, 2, 2, 2), categoricals=4, classes=4, belief=16, hidden=16, gru_blocks=2,
            mlp_layers=1, mlp_units=16, object_features=16, extractor_units=16,
        ),
        Learning(
            batch_size=2, slice_len=8, imagination_horizon=3, model_lr=1e-3, actor_lr=1e-3, value_lr=1e-3,
        ),
    ),
    "cpu": Size(
        Architecture(
            cnn_depth=8, cnn_mults=(1, 2, 4, 4), categoricals=16, classes=16, belief=128, hidden=128,
            mlp_layers=2, mlp_units=128, object_features=128, extractor_units=128,
        ),
        Learning(
            batch_size=8, slice_len=16, imagination_horizon=10, model_lr=1e-3, actor_lr=1e-3, value_lr=1e-3,
            gamma=0.95, optimizer=DreamerV3(warmup=100),
        ),
    ),
    "small": Size(
        Architecture(
            cnn_depth=24, categoricals=32, classes=16, belief=512, hidden=256,
            mlp_layers=3, mlp_units=256, object_features=512, extractor_units=256,
        ),
        Learning(
            batch_size=16, slice_len=32, imagination_horizon=15, model_lr=3e-4, actor_lr=1e-4, value_lr=1e-4,
            optimizer=DreamerV3(warmup=500),
        ),
    ),
    "paper": Size(
        Architecture(
            style="dreamer_v2", cnn_depth=48, categoricals=32, classes=32, belief=200, hidden=200,
            mlp_layers=4, mlp_units=400, object_features=1536, extractor_units=512,
        ),
        Learning(
            batch_size=32, slice_len=32, imagination_horizon=15, model_lr=3e-4, actor_lr=8e-5, value_lr=8e-5,
            entropy_bonus=0.0, lambda_dynamic=0.5, optimizer=Adam(),
        ),
    ),
    "large": Size(
        Architecture(
            cnn_depth=64, categoricals=32, classes=64, belief=2048, hidden=512,
            mlp_layers=3, mlp_units=512, object_features=2048, extractor_units=1024,
        ),
        Learning(
            batch_size=32, slice_len=64, imagination_horizon=15, model_lr=1e-4, actor_lr=4e-5, value_lr=4e-5,
            optimizer=DreamerV3(warmup=1000),
        ),
    ),
}
# fmt: on


def agent_name(config: AgentConfig) -> str:
    """Name of a row of choices: that of the nearest preset and of an explorer beside it, and in what it differs.

    Examples:
        >>> agent_name(AgentConfig(Flat(observed=("proprio", "object_position", "goal_position"), lambda_proprio=2.0)))
        'dreamer (world_model.lambda_proprio=2.0)'
        >>> agent_name(AGENTS["focus_lcp"].and_behaviours(explore=EXPLORERS["apt"]))
        'focus_lcp + apt'
    """
    names = dict(AGENTS)
    for agent, preset in AGENTS.items():
        if EXPLORE not in preset.behaviours:
            names.update({f"{agent} + {name}": preset.and_behaviours(explore=one) for name, one in EXPLORERS.items()})
    here = flat(to_dict(config))
    differences = {name: _difference(here, flat(to_dict(preset))) for name, preset in names.items()}
    nearest = min(differences, key=lambda name: len(differences[name]))
    changed = ", ".join(f"{key}={value}" for key, value in differences[nearest].items())
    return f"{nearest} ({changed})" if changed else nearest


def _difference(here: dict[str, Any], there: dict[str, Any]) -> dict[str, Any]:
    """What is here but not there or otherwise, and as ``None`` what is only there."""
    names = dict.fromkeys([*here, *there])
    return {
        name: here.get(name) for name in names if here.get(name) != there.get(name) or (name in here) != (name in there)
    }
