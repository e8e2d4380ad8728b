"""The group ``explore`` of recipes: a behaviour beside those of the row."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import hydra
import pytest
from hydra.core.config_store import ConfigStore
from hydra.errors import MissingConfigException
from omegaconf import OmegaConf

from torchrl_ocwm.agents import AGENTS, EXPLORERS, AgentConfig, Behaviour, StateEntropy
from torchrl_ocwm.recipes.config import _schema, store_options
from torchrl_ocwm.settings import Settings, change, from_dict


@dataclass(frozen=True)
class Recipe(Settings):
    """One with an agent only."""

    agent: AgentConfig


@pytest.fixture(autouse=True)
def _store() -> Iterator[None]:
    with hydra.initialize(version_base="1.3", config_path=None):
        yield


def compose(*overrides: str) -> AgentConfig:
    store_options()
    ConfigStore.instance().store(
        "explore_test", _schema(Recipe, {"agent": "focus_lcp", "explore": "none"}, {}, "A recipe.")
    )
    config = hydra.compose("explore_test", list(overrides))
    return from_dict(Recipe, OmegaConf.to_container(config)).agent


@pytest.mark.parametrize("overrides", [(), ("explore=none",)])
def test_none_is_the_row_itself(overrides: tuple[str, ...]) -> None:
    assert compose(*overrides) == AGENTS["focus_lcp"]


@pytest.mark.parametrize("name", EXPLORERS)
def test_beside_the_behaviours_of_the_row(name: str) -> None:
    assert compose(f"explore={name}") == AGENTS["focus_lcp"].and_behaviours(explore=EXPLORERS[name])
    row = AGENTS["dreamer_pcp"].and_behaviours(explore=EXPLORERS[name])
    assert compose(f"explore={name}", "agent=dreamer_pcp") == row


def test_its_settings_are_settings_of_the_agent() -> None:
    row = AGENTS["focus_lcp"].and_behaviours(explore=EXPLORERS["apt"])
    assert compose("explore=apt", "agent.behaviours.explore.reward.k=5") == change(
        row, {"behaviours.explore.reward.k": 5}
    )


def test_an_explorer_of_ones_own(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = Behaviour(reward=StateEntropy(k=3, normalize="scale"))
    monkeypatch.setitem(EXPLORERS, "mine", mine)
    assert compose("explore=mine").behaviours["explore"] == mine


def test_an_unknown_one() -> None:
    with pytest.raises(MissingConfigException, match=r"explore/nothing[\s\S]*plan2explore"):
        compose("explore=nothing")
