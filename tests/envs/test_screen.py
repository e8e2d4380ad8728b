"""What people see: pictures of any size."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pygame
import pytest

from torchrl_ocwm.envs import ENVIRONMENTS, Reacher


@pytest.fixture
def make() -> Iterator[Callable[..., Reacher]]:
    made: list[Reacher] = []

    def one(**options: Any) -> Reacher:
        made.append(Reacher(image_size=16, **options))
        made[-1].reset(seed=1)
        return made[-1]

    yield one
    for env in made:
        env.close()


@pytest.mark.parametrize("size", [40, 128])
def test_a_picture_of_any_size(make: Callable[..., Reacher], size: int) -> None:
    """It shows what the agent sees: scaled down it is nearly that."""
    env = make(render_mode="rgb_array", render_size=size)
    picture, small = env.render(), make(render_mode="rgb_array").render()
    assert picture is not None
    assert small is not None
    assert (picture.shape, picture.dtype) == ((size, size, 3), np.uint8)
    assert small.shape == (16, 16, 3)
    blocks = picture[: size // 16 * 16, : size // 16 * 16].reshape(16, size // 16, 16, size // 16, 3).mean((1, 3))
    if size % 16 == 0:
        assert np.abs(blocks - small).mean() < 12
    before = env.render()
    for _ in range(5):
        env.step(np.ones(2, np.float32))
    assert not np.array_equal(before, env.render())


def test_a_picture_that_is_not_square_shows_more_at_its_sides(make: Callable[..., Reacher]) -> None:
    wide, square = (make(render_mode="rgb_array", render_size=size).render() for size in ((48, 80), 48))
    assert wide is not None
    assert wide.shape == (48, 80, 3)
    assert np.abs(wide[:, 16:64].astype(float) - square).mean() < 1


def test_without_a_mode_there_is_nothing_to_see(make: Callable[..., Reacher]) -> None:
    assert make(render_size=40).render() is None


def test_a_size_that_there_is_not(make: Callable[..., Reacher]) -> None:
    for size in (0, (48, 0)):
        with pytest.raises(ValueError, match=rf"render_size must be at least 1, got {re.escape(str(size))}"):
            make(render_mode="rgb_array", render_size=size)


@pytest.mark.filterwarnings("ignore:.*natively support.*")
def test_a_window_shows_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gymnasium opens it."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    options = {"image_size": 16, "render_size": 40}
    env = gymnasium.make(ENVIRONMENTS["reacher"].id, render_mode="human", **options)
    try:
        env.reset(seed=1)
        for _ in range(2):
            env.step(env.action_space.high)
            shown = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
            np.testing.assert_array_equal(shown, env.unwrapped.render())
    finally:
        env.close()
