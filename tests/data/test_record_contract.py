"""Recordings as people have them: converted exactly to what docs/data.md says, or refused by name."""

import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm import build_agent
from torchrl_ocwm.data import DatasetError, EpisodeDataset
from torchrl_ocwm.data.contract import OPTIONAL, record_keys
from torchrl_ocwm.testing import random_records, reacher_task
from torchrl_ocwm.training import run
from torchrl_ocwm.training.offline import train_offline
from torchrl_ocwm.training.settings import Training

TASK = reacher_task(16)


def episode() -> TensorDict:
    records = random_records(TASK, 1, 6)[0]
    records["next", "done"][-1] = True
    return records


def stored(path: Path, records: TensorDict) -> EpisodeDataset:
    metadata = {"environment": TASK.name, "options": {}, "task": TASK.to_dict()}
    with EpisodeDataset.create(path, example=records[0], metadata=metadata) as dataset:
        dataset.append(records)
    return EpisodeDataset.open(path)


CONVERTED = {
    "masks 0 and 255": ("masks", lambda masks: masks.to(torch.uint8) * 255),
    "masks 0 and 1": ("masks", lambda masks: masks.to(torch.uint8)),
    "masks int64": ("masks", lambda masks: masks.long()),
    "masks float": ("masks", lambda masks: masks.float()),
    "images float32": ("pixels", lambda pixels: pixels / 255),
    "images float64": ("pixels", lambda pixels: pixels.double() / 255),
    "images float16": ("pixels", lambda pixels: (pixels / 255).half()),
    "proprio float64": ("proprio", lambda values: values.double()),
    "positions float64": ("object_position", lambda values: values.double()),
    "done uint8": ("done", lambda done: done.to(torch.uint8)),
    "visible uint8": ("object_visible", lambda seen: seen.to(torch.uint8)),
}


@pytest.mark.parametrize(("key", "given"), CONVERTED.values(), ids=CONVERTED.keys())
def test_converted_exactly(tmp_path, key, given):
    records, expected = episode(), episode()
    records["next", key] = given(records["next", key])
    kind = records["next", key].dtype
    dataset = stored(tmp_path / "data", records)
    for name in expected.keys(True, True):
        assert dataset.records[name].dtype == expected[name].dtype
        assert torch.equal(dataset.records[name], expected[name]), name
    assert records["next", key].dtype == kind  # what was given is left as it was


def test_actions_of_float64(tmp_path):
    records = episode()
    records["action"] = records["action"].double()
    assert torch.equal(stored(tmp_path / "data", records).records["action"], episode()["action"])


def test_shapes_and_types_are_those_of_what_is_collected():
    found = {name: [[*value.shape[1:]], str(value.dtype)[6:]] for name, value in episode().flatten_keys("/").items()}
    expected = record_keys(TASK)
    assert found == {name: expected[name] for name in found}
    assert set(expected) - set(found) <= set(OPTIONAL)


REFUSED = {
    "masks of three values":
        ("masks", lambda x: x.to(torch.uint8).index_fill_(0, torch.tensor(2), 7),
         "next/masks: torch.uint8"),
    "masks 0 and 2":
        ("masks", lambda x: 2 * x.to(torch.uint8),
         "next/masks: .* with values up to 2; expected bool"),
    "masks of probabilities":
        ("masks", lambda x: 0.3 * x,
         "next/masks: torch.float32 with values up to 0.3"),
    "masks negative":
        ("masks", lambda x: -x.float(),
         "next/masks"),
    "masks not a number":
        ("masks", lambda x: x / 0.0,
         "next/masks"),
    "images any float":
        ("pixels", lambda x: (x / 255 + 0.001).clamp(0, 1),
         "next/pixels: .*not multiples of 1/255"),
    "images float 255":
        ("pixels", lambda x: x.float(),
         r"next/pixels: .*floating images lie in \[0, 1\]"),
    "images negative":
        ("pixels", lambda x: x / 255 - 0.5,
         r"next/pixels: .*floating images lie in \[0, 1\]"),
    "images bfloat16":
        ("pixels", lambda x: (x / 255).bfloat16(),
         "next/pixels: expected uint8 images"),
    "images int64":
        ("pixels", lambda x: x.long(),
         "next/pixels: expected uint8 images of 0 to 255, got torch.int64"),
    "images H x W x 3":
        ("pixels", lambda x: x.permute(0, 2, 3, 1),
         r"next/pixels: has shape \(16, 16, 3\), channels last"),
    "images of 20":
        ("pixels", lambda x: x.new_ones(6, 3, 20, 20),
         r"shape \(3, 20, 20\) per record, the task says \(3, 16, 16\)"),
    "images black":
        ("pixels", lambda x: x * 0,
         "next/pixels: the images of episode 0 are black"),
    "no object axis":
        ("object_position", lambda x: x[:, 0],
         r"next/object_position: has shape \(2,\) per record, .* \(1, 2\)"),
    "millimetres":
        ("object_position", lambda x: 1000 * x,
         "next/object_position: .*far outside the workspace.*metres"),
    "far goal":
        ("goal_position", lambda x: 1000 * x,
         "next/goal_position: .*far outside the workspace.*metres"),
    "positions of integers":
        ("object_position", lambda x: x.long(),
         "next/object_position: expected float32, got torch.int64"),
    "position lost":
        ("object_position", lambda x: x / 0 * 0,
         "NaN or infinity in 'next/object_position'"),
    "proprio too large":
        ("proprio", lambda x: x.double() * 1e60,
         "NaN or infinity in 'next/proprio'"),
    "proprio of another arm":
        ("proprio", lambda x: x[:, :3],
         r"next/proprio: has shape \(3,\) per record"),
    "done at the start":
        ("done", lambda x: x | (torch.arange(6) == 0).unsqueeze(-1),
         "next/done: must be set at the last"),
    "never done":
        ("done", lambda x: x & False,
         "next/done: must be set at the last record"),
    "terminated before":
        ("terminated", lambda x: x | True,
         "next/terminated: is set where next/done is not"),
}  # fmt: skip


@pytest.mark.parametrize(("key", "spoil", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_refused_by_name(tmp_path, key, spoil, message):
    records = episode()
    records["next", key] = spoil(records["next", key])
    with pytest.raises(DatasetError, match=message):
        stored(tmp_path / "data", records)


@pytest.mark.parametrize("largest", [1.01, -20.0])
def test_actions_beyond_one(tmp_path, largest):
    records = episode()
    records["action"][3, 1] = largest
    with pytest.raises(DatasetError, match=f"action: {abs(largest):g} is beyond ±1"):
        stored(tmp_path / "data", records)


def test_an_object_may_leave_the_workspace(tmp_path):
    records = episode()
    records["next", "object_position"][3:] += 1.0  # it fell from the table
    kept = stored(tmp_path / "data", records).records
    assert torch.equal(kept["next", "object_position"][:], records["next", "object_position"])


@pytest.mark.parametrize("key", [name for name in record_keys(TASK) if name not in OPTIONAL and name != "is_init"])
def test_missing_keys_are_named(tmp_path, key):
    records = episode().exclude(tuple(key.split("/")))
    with pytest.raises(DatasetError, match=f"records lack {re.escape(key)}; docs/data.md"):
        stored(tmp_path / "data", records)


@pytest.mark.parametrize("key", ["masks", "goal_position"])
def test_what_only_some_agents_need_may_be_missing(tmp_path, key):
    assert ("next", key) not in stored(tmp_path / "data", episode().exclude(("next", key))).records.keys(True)


def test_later_episodes_are_converted_alike(tmp_path):
    dataset = stored(tmp_path / "data", episode())
    other = episode()
    other["next", "masks"] = other["next", "masks"].float()
    with EpisodeDataset.open(dataset.path, write=True) as dataset:
        dataset.append(other)
        other["next", "masks"] *= 3
        with pytest.raises(DatasetError, match=f"{dataset.path}: next/masks"):
            dataset.append(other)
    assert dataset.episode_lengths == [6, 6]
    assert torch.equal(dataset[0]["next", "masks"], dataset[1]["next", "masks"])


def test_without_a_task_there_is_no_contract(tmp_path):
    records = episode()
    records["action"] *= 20
    records["next", "masks"] = records["next", "masks"].float()
    with EpisodeDataset.create(tmp_path / "data", example=records[0]) as dataset:
        dataset.append(records)
    assert dataset.records["action"].abs().max() > 1
    with pytest.raises(DatasetError, match=r"dataset\.json: holds no task"):
        dataset.task  # noqa: B018


def test_an_agent_that_needs_what_is_missing(tmp_path):
    """Named before anything is trained or written; an agent that does not need it is none the worse."""
    dataset = stored(tmp_path / "data", episode().exclude(("next", "masks")))
    agent = build_agent("focus_pcp", TASK, "debug")
    with pytest.raises(DatasetError, match=r"holds no next/masks, which this agent learns from"):
        train_offline(agent, dataset, tmp_path / "run", Training(updates=50))
    assert not (tmp_path / "run").exists()
    run.check_task(build_agent("dreamer_pcp", TASK, "debug"), dataset)
