from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf
from torchrl_ocwm.training.config import check_overrides, to_dataclass

from torchrl_ocwm.agents import AGENTS, SIZES, AgentConfig, Size
from torchrl_ocwm.training.settings import Training

CONFIG = Path(__file__).parents[2] / "examples" / "config"


@pytest.mark.parametrize(
    ("folder", "rows", "kind"), [("agent", AGENTS, AgentConfig), ("size", SIZES, Size)], ids=["agent", "size"]
)
def test_one_file_per_row_with_its_values(folder: str, rows: dict, kind: type) -> None:
    files = {file.stem: to_dataclass(kind, OmegaConf.load(file)) for file in (CONFIG / folder).glob("*.yaml")}
    assert files == rows


def test_training_defaults_are_the_recipes() -> None:
    config = OmegaConf.load(CONFIG / "train_offline.yaml")
    assert to_dataclass(Training, config.training) == Training()


def test_every_setting_has_a_comment() -> None:
    for file in CONFIG.rglob("*.yaml"):
        lines = file.read_text().splitlines()
        for before, line in zip(["", *lines], lines, strict=False):
            key = line.strip().split(":")[0]
            documented = before.lstrip().startswith("#") or key in ("defaults", "hydra", "run", "dir", "output_subdir")
            plain = line.strip().startswith(("#", "-")) or not line.strip()
            assert plain or documented or key in ("training", "envs"), f"{file.name}: {line}"


def test_whole_numbers_are_real_numbers_too() -> None:
    config = OmegaConf.create({**asdict(AGENTS["dreamer"]), "lambda_goal_position": 200})
    assert isinstance(to_dataclass(AgentConfig, config).lambda_goal_position, float)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("agent=foo", r"agent/foo[\s\S]*dreamer\s+dreamer_pcp\s+focus\s+focus_lcp\s+focus_pcp"),
        ("env=foo", r"env/foo[\s\S]*reacher"),
        ("size=foo", r"size/foo[\s\S]*cpu\s+debug\s+large\s+paper\s+small"),
        ("agnt=dreamer", "unknown key 'agnt'; valid here: agent, env, size, dataset, output, training"),
        ("training.update=3", r"unknown key 'training\.update'; valid here: training\.updates, training\.seed"),
        ("training.updates.x=3", r"unknown key 'training\.updates\.x'; valid here: training\.updates"),
        ("size.layers=3", r"unknown key 'size\.layers'; valid here: size\.style, size\.cnn_depth"),
    ],
)
def test_unknown_names_list_the_valid_ones(override: str, message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        check_overrides(CONFIG, "train_offline", [override])


def test_valid_names_pass() -> None:
    check_overrides(CONFIG, "train_offline", ["agent=dreamer", "size=debug", "training.updates=5", "size.gamma=0.9"])
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        config = hydra.compose("train_offline", ["agent=dreamer", "size=debug"])
    assert to_dataclass(AgentConfig, config.agent) == AGENTS["dreamer"]


def test_missing_setting() -> None:
    values = asdict(SIZES["debug"])
    del values["belief"]
    with pytest.raises(ValueError, match="Size: .*belief"):
        to_dataclass(Size, OmegaConf.create(values))
