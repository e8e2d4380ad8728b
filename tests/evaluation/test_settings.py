"""What collecting, evaluating and diagnosing refuse, by name."""

from __future__ import annotations

from typing import Any

import pytest

from torchrl_ocwm.data.settings import Collection
from torchrl_ocwm.evaluation.settings import Diagnosis, Evaluation


@pytest.mark.parametrize(
    ("kind", "setting", "message"),
    [
        (Collection, {"steps": 0}, "steps must be at least 1, got 0"),
        (Collection, {"workers": -1}, "workers must be at least 0, got -1"),
        (Collection, {"seed": -1}, "seed must be at least 0"),
        (Collection, {"timeout": 0}, "timeout must be above 0, got 0"),
        (Collection, {"timeout": float("nan")}, "timeout must be a number, got nan"),
        (Evaluation, {"goals": 0}, "goals must be at least 1"),
        (Evaluation, {"goals": 30}, "goals=30 is not a square grid; try 25 or 36"),
        (Evaluation, {"episode_steps": 0}, "episode_steps must be at least 1"),
        (Evaluation, {"envs": 0}, "envs must be at least 1"),
        (Evaluation, {"workers": -1}, "workers must be at least 0"),
        (Evaluation, {"video_goals": -1}, "video_goals must be at least 0"),
        (Evaluation, {"seed": -1}, "seed must be at least 0"),
        (Evaluation, {"timeout": -1}, "timeout must be above 0"),
        (Diagnosis, {"sequences": 0}, "sequences must be at least 1"),
        (Diagnosis, {"context": 0}, "context must be at least 1"),
        (Diagnosis, {"context": 50}, "context=50 of length=50 frames: some have to be seen and some to be imagined"),
        (Diagnosis, {"frames": 1}, "frames must be at least 2"),
        (Diagnosis, {"video_sequences": -1}, "video_sequences must be at least 0"),
        (Diagnosis, {"seed": -1}, "seed must be at least 0"),
    ],
)
def test_refused(kind: Any, setting: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind(**setting)
