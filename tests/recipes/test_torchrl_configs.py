"""Our loss, environment and optimisers among TorchRL's trainer configurations."""

from __future__ import annotations

import hydra
import pytest
import torch
from hydra.core.config_store import ConfigStore
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig
from torchrl.collectors import Collector
from torchrl.trainers.algorithms import DreamerV3Optimizer

from torchrl_ocwm.agents import AGENTS, EXPLORERS
from torchrl_ocwm.agents.optimizers import ClippedAdam
from torchrl_ocwm.recipes import torchrl_configs  # noqa: F401  (fills the store)
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_records

DEFAULTS = [{"env": "ocwm"}, {"loss": "ocwm"}, {"optimizer": "ocwm_adam"}, {"collector": "sync"}, "_self_"]
OURS = {
    "env": {"options": {"image_size": 16, "horizon": 5}},
    "loss": {"size": "debug"},
    "collector": {"create_env_fn": "${env}", "frames_per_batch": 4, "total_frames": 4},
}


def compose(*overrides: str) -> DictConfig:
    ConfigStore.instance().store("with_torchrl", {"defaults": DEFAULTS, **OURS})
    with hydra.initialize(version_base="1.3", config_path=None):
        return hydra.compose("with_torchrl", list(overrides))


@pytest.fixture(scope="module")
def config() -> DictConfig:
    return compose("loss.agent=focus_lcp", "optimizer.max_norm=1.0", "optimizer.lr=0.01")


def test_a_loss_by_the_name_of_its_row_learns_with_the_optimizer(config: DictConfig) -> None:
    loss = instantiate(config.loss)
    assert loss.agent.task.image_size == 16
    assert loss.agent.config.world_model.name_and_kind() == ("object", "world_model")
    optimizer = instantiate(config.optimizer)(params=loss.parameters())
    assert isinstance(optimizer, ClippedAdam)
    assert (optimizer.max_norm, optimizer.param_groups[0]["lr"]) == (1.0, 0.01)
    before = [parameter.clone() for parameter in loss.agent.actor.parameters()]
    losses = loss(random_records(loss.agent.task, 2, 3))
    sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
    optimizer.step()
    assert any(not torch.equal(*pair) for pair in zip(before, loss.agent.actor.parameters(), strict=True))


def test_an_agent_with_settings_of_its_own_and_an_explorer() -> None:
    row = ["+agent=focus_lcp", "loss.agent=${agent}", "agent.behaviours.reach.goal.weight=7", "+explore=apt"]
    made = instantiate(compose(*row).loss).agent.config
    expected = change(AGENTS["focus_lcp"], {"behaviours.reach.goal.weight": 7.0})
    assert made == expected.and_behaviours(explore=EXPLORERS["apt"])


def test_torchrls_collector_runs_the_policy_in_the_environment(config: DictConfig) -> None:
    policy = instantiate(config.loss).agent.policy()
    collector = instantiate(config.collector, policy=policy)
    assert isinstance(collector, Collector)
    (batch,) = collector
    collector.shutdown()
    assert batch["next", "pixels"].shape == (4, 3, 16, 16)
    assert batch["latent", "goal"].shape[0] == 4


def test_every_optimizer_has_its_settings() -> None:
    config = compose("optimizer=ocwm_dreamer_v3", "optimizer.warmup=7")
    made = instantiate(config.optimizer)(params=[torch.nn.Parameter(torch.ones(1))])
    assert isinstance(made, DreamerV3Optimizer)
    assert made.defaults["warmup_steps"] == 7


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("loss.agent=focus_lpc", "unknown agent 'focus_lpc'; there are dreamer"),
        ("+loss.agent.behaviours.reach.object=cube", "loss.agent must be a whole row, with world_model and behaviours"),
        ("env.name=reach", "name must be one of reacher"),
        ("env.options.horizon=0", "options.horizon must be at least 1, got 0"),
    ],
)
def test_wrong_values_are_named(override: str, message: str) -> None:
    with pytest.raises(InstantiationException, match=message):
        instantiate(compose(override).loss)
