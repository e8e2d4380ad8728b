"""How much a dataset shows of its objects, on hand-made paths."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.data import Coverage, EpisodeDataset, coverage_curve, dataset_coverage, object_coverage
from torchrl_ocwm.envs import Workspace

SQUARE = Workspace(low=(0.0, 0.0), high=(1.0, 1.0))


def test_a_step_between_episodes_is_none():
    path = torch.tensor([[0.05, 0.05], [0.05, 0.05], [0.95, 0.95], [0.95, 0.95]])
    assert object_coverage(path, [2, 2], SQUARE) == Coverage(0.0, 0.02)
    assert object_coverage(path, [4], SQUARE).moves == pytest.approx(1 / 3)


def test_a_millimetre_counts():
    path = torch.tensor([[0.5, 0.5], [0.5009, 0.5], [0.502, 0.5], [0.502, 0.498]])
    assert object_coverage(path, [4], SQUARE).moves == pytest.approx(2 / 3)


def test_visited_share_against_a_histogram():
    path = torch.rand(150, 2, generator=torch.Generator().manual_seed(0))
    cells = {(int(10 * x), int(10 * y)) for x, y in path.tolist()}
    assert 0.5 < len(cells) / 100 < 1
    assert object_coverage(path, [150], SQUARE).visited == len(cells) / 100


def test_outside_of_the_workspace_does_not_count():
    path = torch.tensor([[1.2, 0.5], [-0.1, 0.5], [0.5, 2.0]])
    assert object_coverage(path, [3], SQUARE).visited == 0


def test_all_of_a_ring():
    ring = Workspace(low=(-1.0, -1.0), high=(1.0, 1.0), reach=(0.2, 1.0))
    assert object_coverage(ring.grid(10).flatten(0, 1), [100], ring).visited == 1


@pytest.mark.parametrize("truth", [True, False])
def test_each_object_of_a_dataset(tmp_path, truth):
    moving = torch.linspace(0.05, 0.95, 10).unsqueeze(-1).expand(10, 2)
    still = torch.full((10, 2), 0.5)
    positions = torch.stack([moving, still], 1)
    key = "object_position_true" if truth else "object_position"
    steps = {"object_position": torch.zeros(10, 2, 2), key: positions}
    starts = (torch.arange(10) == 0).unsqueeze(-1)
    records = TensorDict({"action": torch.zeros(10, 1), "is_init": starts, "next": steps}, [10])
    dataset = EpisodeDataset.create(tmp_path, example=records[0])
    dataset.append(records)
    assert dataset_coverage(dataset, ("a", "b"), SQUARE) == {"a": Coverage(1.0, 0.1), "b": Coverage(0.0, 0.01)}


def test_curve_is_that_of_the_first_episodes() -> None:
    """Episodes of other lengths: each point counts whole ones, the last all."""
    lengths = [3, 5, 2, 6, 4]
    path = torch.rand(sum(lengths), 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    curve = coverage_curve(path, lengths, SQUARE, points=5)
    assert list(curve) == [2, 6, 7, 12, 15]
    assert curve[6] == object_coverage(path[:8], [3, 5], SQUARE)
    assert curve[15] == object_coverage(path, lengths, SQUARE)
    assert list(coverage_curve(path, lengths, SQUARE, points=2)) == [6, 15]
    assert list(coverage_curve(path, lengths, SQUARE, points=50)) == list(curve)
