"""Goals inside the workspace, grids of equal cells, and tasks that survive JSON."""

import json

import pytest
import torch

from torchrl_ocwm.envs import Task, Workspace
from torchrl_ocwm.settings import SettingsError

RING = Workspace(low=(-0.24, -0.24), high=(0.24, 0.24), reach=(0.04, 0.24))
BOX = Workspace(low=(-1.0, 0.0, 0.5), high=(1.0, 0.4, 2.5))


def cell_areas(corners: torch.Tensor) -> torch.Tensor:
    """Areas of the quadrilaterals between corners ``[N + 1, N + 1, 2]``, by the shoelace formula."""
    a, b, c, d = corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]
    area = torch.zeros(a.shape[:-1], dtype=corners.dtype)
    for p, q in ((a, b), (b, c), (c, d), (d, a)):
        area += p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    return area.abs() / 2


@pytest.mark.parametrize(
    ("point", "inside"),
    [((0.0, 0.0), True), ((0.24, -0.24), True), ((0.25, 0.0), False), ((0.0, -0.25), False), ((0.0, 0.241), False)],
)
def test_contains(point, inside):
    assert bool(RING.contains(torch.tensor(point))) is inside


def test_contains_a_batch():
    points = torch.tensor([[[0.0, 0.1, 1.0], [0.0, 0.1, 3.0]]])
    assert BOX.contains(points).tolist() == [[True, False]]


def test_check_returns_the_goal_as_float32():
    goal = RING.check((0.1, -0.2))
    assert goal.dtype == torch.float32
    assert torch.equal(goal, torch.tensor([0.1, -0.2]))


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ((0.1, 0.2, 0.3), r"has 2 coordinates, got shape \(3,\)"),
        (0.1, r"has 2 coordinates, got shape \(\)"),
        ((float("nan"), 0.0), "must be finite"),
        ((0.0, float("inf")), "must be finite"),
        ((0.3, 0.0), r"lies outside the workspace, low \(-0.24, -0.24\) to high \(0.24, 0.24\)"),
        (((0.0, 0.0), (0.0, -0.3)), "lies outside the workspace"),
    ],
)
def test_check_names_what_is_wrong(goal, message):
    with pytest.raises(ValueError, match=message):
        RING.check(goal)


@pytest.mark.parametrize(("low", "high"), [((0.0,), (0.0,)), ((0.0, 1.0), (1.0, 0.5)), ((0.0,), (1.0, 1.0))])
def test_corners_in_the_wrong_order(low, high):
    with pytest.raises(ValueError, match="low must be below high on every axis"):
        Workspace(low=low, high=high)


def test_samples_are_uniform_in_the_box():
    goals = BOX.sample((20_000,), torch.Generator().manual_seed(0))
    assert goals.shape == (20_000, 3)
    assert BOX.contains(goals, tolerance=0).all()
    # A uniform variable of width w has mean (low + high) / 2 and standard deviation w / sqrt(12); 5 standard errors.
    for axis in range(3):
        width = BOX.high[axis] - BOX.low[axis]
        middle = (BOX.high[axis] + BOX.low[axis]) / 2
        assert goals[:, axis].mean().item() == pytest.approx(middle, abs=5 * width / 12**0.5 / 20_000**0.5)
        assert goals[:, axis].std().item() == pytest.approx(width / 12**0.5, rel=0.02)


def test_samples_follow_the_generator():
    first, second = (RING.sample((4,), torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first, second)
    assert not torch.equal(first, RING.sample((4,), torch.Generator().manual_seed(4)))


def test_grid_of_a_ring_lies_within_reach_and_spans_it():
    radius = RING.grid(10).norm(dim=-1)
    assert radius.shape == (10, 10)
    assert radius.min() > 0.04
    assert radius.max() < 0.24
    edges = RING.grid_edges(10).norm(dim=-1)
    assert torch.allclose(edges[0], torch.full((11,), 0.24))
    assert edges[5, 5].item() == pytest.approx(0.04)


def test_grid_cells_of_a_ring_have_equal_areas():
    # Fine corners, summed up to 4 x 4 cells: the sides of the coarse cells are curves. The inner 2 x 2 cells touch
    # the hole, which no quadrilateral can follow; each of them must make up its quarter of what is left.
    corners = RING.grid_edges(800).double()
    areas = cell_areas(corners).unflatten(0, (8, 100)).unflatten(2, (8, 100)).sum((1, 3))
    expected = torch.pi * (0.24**2 - 0.04**2) / 64
    outer = torch.ones(8, 8, dtype=torch.bool)
    outer[3:5, 3:5] = False
    assert areas[outer] / expected == pytest.approx(1.0, rel=2e-3)


def test_grid_points_are_the_middles_of_their_cells():
    assert torch.allclose(RING.grid(5), RING.grid_edges(10)[1::2, 1::2])


@pytest.mark.parametrize("size", [1, 2, 5, 6, 10])
def test_grid_of_three_axes_is_a_square_grid_seen_along_each(size):
    goals = BOX.grid(size).flatten(0, 1)
    assert goals.shape == (size**2, 3)
    low, high = torch.tensor(BOX.low), torch.tensor(BOX.high)
    cells = (goals - low) / (high - low) * size
    torch.testing.assert_close(cells % 1, torch.full_like(cells, 0.5), atol=1e-4, rtol=0)  # middles
    assert torch.equal(cells.long(), BOX.grid_cells(size).flatten(0, 1))
    for view in ((0, 1), (0, 2), (1, 2)):
        assert len({tuple(cell) for cell in cells[:, view].long().tolist()}) == size**2


def test_grid_of_three_axes_leaves_no_large_hole():
    """No place of a cube is further from a goal than 0.3 of its side; goals in planes would leave 0.57."""
    cube = Workspace(low=(0.0,) * 3, high=(1.0,) * 3)
    places = cube.sample((20_000,), torch.Generator().manual_seed(0))
    assert torch.cdist(places, cube.grid(10).flatten(0, 1)).amin(1).max() < 0.3


def test_grid_of_two_axes_goes_along_the_first_then_the_second():
    grid = Workspace(low=(-1.0, 0.0), high=(1.0, 4.0)).grid(2)
    assert grid.tolist() == [[[-0.5, 1.0], [0.5, 1.0]], [[-0.5, 3.0], [0.5, 3.0]]]


def test_grid_of_one_axis_is_a_line():
    assert Workspace(low=(0.0,), high=(8.0,)).grid(2).flatten().tolist() == [1.0, 3.0, 5.0, 7.0]


def test_grid_of_four_axes_takes_each_value_equally_often():
    cells = Workspace(low=(0.0,) * 4, high=(1.0,) * 4).grid_cells(6).flatten(0, 1)
    for axis in cells.T:
        assert axis.bincount().tolist() == [6] * 6


def test_edges_seen_along_an_axis():
    edges = BOX.grid_edges(2, (0, 2))
    assert edges[0, 0].tolist() == [-1.0, 0.5]
    assert edges[0, 2].tolist() == [1.0, 0.5]
    assert edges[2, 2].tolist() == [1.0, 2.5]
    assert BOX.grid_edges(2, (1, 2))[2, 0].tolist() == pytest.approx([0.0, 2.5])


def test_a_ring_has_two_axes():
    with pytest.raises(SettingsError, match="reach is the ring of a planar arm: it needs two axes, low has 3"):
        Workspace(BOX.low, BOX.high, reach=(0.1, 0.2))


@pytest.mark.parametrize("workspace", [RING, BOX, Workspace((-1.0,), (1.0,), landmarks=((0.5,), (-0.5,)))])
def test_task_survives_json(workspace):
    task = Task("reacher", 64, ("finger", "cube"), 5, 2, workspace, options={"virtual_target": 7, "image_size": 64})
    again = Task.from_dict(json.loads(json.dumps(task.to_dict())))
    assert again == task
    assert again.options == {"virtual_target": 7, "image_size": 64}
    assert again.workspace.landmarks == workspace.landmarks
