"""Fresh goals for stored sequences, and the rewards that belong to them."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose

from torchrl_ocwm.data import DatasetError, EpisodeDataset, RelabelGoals, make_replay_buffer
from torchrl_ocwm.envs import Workspace
from torchrl_ocwm.testing import random_dataset, random_records, reacher_task
from torchrl_ocwm.training.settings import Training

WORKSPACE = Workspace(low=(-0.2, 0.1), high=(0.2, 0.5))


def sequences() -> TensorDict:
    """Two sequences of three steps with two objects; stored goals (0.1, 0.2) and (0.0, 0.4)."""
    position = torch.tensor(
        [
            [[[0.1, 0.2], [9.0, 9.0]], [[0.1, 0.5], [9.0, 9.0]], [[0.5, 0.5], [9.0, 9.0]]],
            [[[0.0, 0.0], [0.3, 0.0]], [[0.0, 0.4], [0.3, 0.4]], [[0.06, 0.32], [0.3, 0.8]]],
        ]
    )
    goal = torch.tensor([[0.1, 0.2], [0.0, 0.4]])[:, None].expand(2, 3, 2).clone()
    return TensorDict(
        {"next": {"object_position": position, "goal_position": goal, "reward": torch.full((2, 3, 1), 7.0)}}, [2, 3]
    )


def test_stored_goals_are_kept_and_rewarded():
    batch = RelabelGoals(WORKSPACE, goals="stored")(sequences())
    assert torch.equal(batch["next", "goal_position"], sequences()["next", "goal_position"])
    # By hand: 0, 0.3, a 3-4-5 triangle; 0.4, 0, and (0.06, -0.08).
    expected = torch.tensor([[0.0, -0.3, -0.5], [-0.4, 0.0, -0.1]])
    assert torch.allclose(batch["next", "reward"].squeeze(-1), expected, atol=1e-6)


def test_rewards_of_another_object():
    batch = RelabelGoals(WORKSPACE, goals="stored", object_index=1)(sequences())
    expected = torch.tensor([-0.5, -0.3, -0.5])
    assert torch.allclose(batch["next", "reward"][1].squeeze(-1), expected, atol=1e-6)


def test_uniform_goals_are_one_per_sequence():
    torch.manual_seed(0)
    batch = RelabelGoals(WORKSPACE)(sequences())
    goal = batch["next", "goal_position"]
    assert goal.shape == (2, 3, 2)
    assert torch.equal(goal, goal[:, :1].expand_as(goal))
    assert not torch.equal(goal[0], goal[1])
    assert not torch.equal(goal, sequences()["next", "goal_position"])


def test_rewards_belong_to_the_drawn_goals():
    batch = RelabelGoals(WORKSPACE)(sequences())
    for b in range(2):
        for t in range(3):
            x, y = (batch["next", "object_position"][b, t, 0] - batch["next", "goal_position"][b, t]).tolist()
            assert batch["next", "reward"][b, t].tolist() == pytest.approx([-((x**2 + y**2) ** 0.5)], abs=1e-6)


def test_uniform_goals_fill_the_workspace():
    torch.manual_seed(0)
    many = TensorDict({"next": {"object_position": torch.zeros(4000, 2, 1, 2)}}, [4000, 2])
    goals = RelabelGoals(WORKSPACE)(many)["next", "goal_position"][:, 0]
    assert WORKSPACE.contains(goals).all()
    # Mean and standard deviation of a uniform variable of width 0.4; five standard errors of 4,000 draws.
    spread = 0.4 / 12**0.5
    assert goals.mean(0).tolist() == pytest.approx([0.0, 0.3], abs=5 * spread / 4000**0.5)
    assert goals.std(0).tolist() == pytest.approx([spread, spread], rel=0.03)


def test_unknown_kind_of_goals():
    with pytest.raises(ValueError, match="goals must be 'auto', 'uniform' or 'stored', got 'hindsight'"):
        RelabelGoals(WORKSPACE, goals="hindsight")


# Data whose images show the goal.


def sampled(dataset: EpisodeDataset, relabel: RelabelGoals, *, inside: bool = False) -> TensorDict:
    transform = Compose(relabel) if inside else relabel
    return make_replay_buffer(dataset, batch_size=8, slice_len=4, transform=transform).sample()


def holds_stored_goals(dataset: EpisodeDataset, batch: TensorDict) -> bool:
    stored = {tuple(goal) for goal in dataset.records["next", "goal_position"].tolist()}
    return {tuple(goal) for goal in batch["next", "goal_position"].flatten(0, 1).tolist()} <= stored


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return random_dataset(tmp_path_factory.mktemp("plain") / "data", reacher_task(16))


@pytest.fixture(scope="module")
def with_targets(tmp_path_factory):
    task = replace(reacher_task(16), options={"virtual_target": 7})
    return random_dataset(tmp_path_factory.mktemp("targets") / "data", task)


@pytest.mark.parametrize("inside", [False, True])
def test_goals_are_drawn_unless_the_images_show_them(plain, with_targets, inside):
    assert Training().goals == "auto"
    batch = sampled(plain, RelabelGoals(reacher_task().workspace), inside=inside)
    assert not holds_stored_goals(plain, batch)
    batch = sampled(with_targets, RelabelGoals(reacher_task().workspace, goals=Training().goals), inside=inside)
    assert holds_stored_goals(with_targets, batch)
    distance = (batch["next", "object_position"][..., 0, :] - batch["next", "goal_position"]).norm(dim=-1)
    assert torch.allclose(batch["next", "reward"].squeeze(-1), -distance)


def test_drawn_goals_are_refused_where_the_images_show_others(with_targets):
    message = f"{with_targets.path}: its images show the goals of its episodes .*use goals='stored'"
    with pytest.raises(DatasetError, match=message):
        sampled(with_targets, RelabelGoals(reacher_task().workspace, goals="uniform"))
    batch = sampled(with_targets, RelabelGoals(reacher_task().workspace, goals="stored"))
    assert holds_stored_goals(with_targets, batch)


@pytest.mark.parametrize(
    ("options", "shown"), [({}, False), ({"virtual_target": 0}, False), ({"virtual_target": 5}, True)]
)
def test_which_images_show_the_goal(tmp_path, options, shown):
    dataset = random_dataset(tmp_path / "data", replace(reacher_task(16), options=options))
    assert dataset.images_show_goal is shown


def test_stored_goals_where_there_are_none(tmp_path):
    task = reacher_task(16)
    records = random_records(task, 1, 6)[0].exclude(("next", "goal_position"))
    records["next", "done"][-1] = True
    metadata = {"environment": task.name, "options": {}, "task": task.to_dict()}
    with EpisodeDataset.create(tmp_path / "data", example=records[0], metadata=metadata) as dataset:
        dataset.append(records)
    with pytest.raises(DatasetError, match="holds no goals .*to keep; use goals='uniform'"):
        sampled(dataset, RelabelGoals(task.workspace, goals="stored"))
    assert sampled(dataset, RelabelGoals(task.workspace))["next", "goal_position"].shape == (8, 4, 2)
