"""Damaged datasets: whatever is wrong in the index or between index and files is named, before anything is built."""

import json
import sys
from dataclasses import fields
from pathlib import Path

import pytest
import torch

from torchrl_ocwm.data import DatasetError, EpisodeDataset
from torchrl_ocwm.data import index as index_module
from torchrl_ocwm.data.frames import FrameFiles
from torchrl_ocwm.envs import Task, Workspace
from torchrl_ocwm.testing import random_dataset, random_records, reacher_task

SIZE = 16
LACKING = object()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A dataset as those of ``collect`` are."""
    path = tmp_path_factory.mktemp("whole") / "data"
    random_dataset(path, reacher_task(SIZE), episodes=3, length=6)
    with EpisodeDataset.open(path, write=True) as dataset:
        dataset.annotate(policies={"random": 3}, failures=0, coverage={"finger": {"moves": 0.5, "visited": 0.1}})
    return path


@pytest.fixture
def damaged(whole, monkeypatch):
    """Open a dataset with another text in its index; nothing may be mapped by then."""

    def open_with(text: str) -> EpisodeDataset:
        file, kept = whole / "dataset.json", (whole / "dataset.json").read_bytes()
        file.write_text(text)
        try:
            with monkeypatch.context() as patch:
                patch.setattr(FrameFiles, "map", None)
                patch.setattr(torch, "frombuffer", None)
                return EpisodeDataset.open(whole)
        finally:
            file.write_bytes(kept)

    return open_with


def changed(path: Path, place: str | list[str], value: object) -> str:
    """The index with another value at a place such as ``task.workspace.low``."""
    index = node = json.loads((path / "dataset.json").read_text())
    *parents, last = place.split(".") if isinstance(place, str) else place
    for parent in parents:
        node = node[parent]
    node.pop(last) if value is LACKING else node.__setitem__(last, value)
    return json.dumps(index)


def test_the_whole_one_opens(whole):
    dataset = EpisodeDataset.open(whole, verify=True)
    assert dataset.task == reacher_task(SIZE)


KEYS = ("action", "is_init", "next/pixels", "next/masks", "next/proprio", "next/object_position", "next/object_visible",
        "next/goal_position", "next/reward", "next/done", "next/terminated")  # fmt: skip
DAMAGE = {
    **{f"lacks {name}": (name, LACKING, rf"lacks \['{name}'\]")
       for name in ("records", "episode_lengths", "keys", "environment", "options", "task")},
    **{f"lacks key {name}": (f"keys.{name}", LACKING, name) for name in KEYS},
    **{f"task lacks {name}": (f"task.{name}", LACKING, rf"task: lacks \['{name}'\]")
       for name in ("name", "image_size", "objects", "proprio", "action", "workspace")},
    "version true": ("version", True, "version True, this release"),
    "version float": ("version", 1.0, "version 1.0, this release"),
    "records float": ("records", 18.0, "records: expected a whole number of at least 0, got 18.0"),
    "records list": ("records", [18], "records: expected a whole number"),
    "records null": ("records", None, "records: expected a whole number"),
    "records negative": ("records", -18, "records: expected a whole number"),
    "records too many": ("records", 10**30, "episode lengths do not add up"),
    "lengths float": ("episode_lengths", [6.0, 6, 6], r"episode_lengths\[0\]: expected a whole number"),
    "lengths null": ("episode_lengths", None, "episode_lengths: expected a list"),
    "lengths text": ("episode_lengths", "666", "episode_lengths: expected a list"),
    "length text": ("episode_lengths", ["6", 6, 6], r"episode_lengths\[0\]: expected a whole number"),
    "length true": ("episode_lengths", [6, 6, 5, True], r"episode_lengths\[3\]: expected a whole number"),
    "length zero": ("episode_lengths", [6, 0, 12], r"episode_lengths\[1\]: expected a whole number of at least 1"),
    "lengths of other files": ("episode_lengths", [6, 6, 7], "episode lengths do not add up"),
    "keys null": ("keys", None, "keys: expected a mapping"),
    "keys list": ("keys", [], "keys: expected a mapping"),
    "keys empty": ("keys", {}, "is_init"),
    "key null": ("keys.action", None, r"keys\.action: expected \[shape, dtype\]"),
    "key without dtype": ("keys.action", [[2]], r"keys\.action: expected \[shape, dtype\]"),
    "shape text": ("keys.action", ["2", "float32"], r"keys\.action shape: expected a list"),
    "shape zero": ("keys.next/pixels", [[0, SIZE, SIZE], "uint8"], r"keys\.next/pixels shape\[0\]: expected"),
    "shape negative": ("keys.action", [[-2], "float32"], r"keys\.action shape\[0\]: expected"),
    "shape of another task": ("keys.action", [[1], "float32"], r"keys\.action: \[\[1\], 'float32'\], the task says"),
    "shape enormous": ("keys.extra", [[10**30], "uint8"], r"extra\.memmap: cannot be read"),
    "dtype 3": ("keys.action", [[2], 3], r"keys\.action dtype: expected one of bool, .*, got 3"),
    "dtype load": ("keys.action", [[2], "load"], r"keys\.action dtype: expected one of bool, .*, got 'load'"),
    "dtype unknown": ("keys.action", [[2], "float99"], r"keys\.action dtype: expected one of"),
    "dtype list": ("keys.action", [[2], ["float32"]], r"keys\.action dtype: expected one of"),
    "dtype of another task": ("keys.action", [[2], "int32"], "the task says"),
    "is_init of two": ("keys.is_init", [[2], "bool"], r"keys\.is_init: expected one bool"),
    "is_init of bytes": ("keys.is_init", [[1], "uint8"], r"keys\.is_init: expected one bool"),
    "key outside": (["keys", "../../elsewhere"], [[1], "bool"], "names of letters"),
    "key absolute": ("keys./tmp/elsewhere", [[1], "bool"], "names of letters"),
    "key without a name": ("keys.", [[1], "bool"], "names of letters"),
    "key inside a key": ("keys.action/x", [[1], "bool"], "'action' is a tensor and 'action/x' is inside it"),
    "key without a file": ("keys.extra", [[1], "bool"], r"extra\.memmap: cannot be read"),
    "task text": ("task", "reacher", "task: expected a mapping"),
    "task null": ("task", None, "task: expected a mapping"),
    "task name null": ("task.name", None, r"task\.name: expected a name"),
    "task of another environment": ("task.name", "cube_move", "'reacher' is not that of the task, 'cube_move'"),
    "task with more": ("task.horizon", 3, r"task: knows no \['horizon'\]"),
    "image_size text": ("task.image_size", str(SIZE), r"task\.image_size: expected a whole number"),
    "image_size of other images": ("task.image_size", 32, r"keys\.next/pixels: .*, the task says"),
    "objects text": ("task.objects", "finger", r"task\.objects: expected a list"),
    "objects none": ("task.objects", [], r"task\.objects: expected a list of at least 1"),
    "objects too many": ("task.objects", ["finger", "cube"], r"keys\.next/masks: .*, the task says"),
    "proprio float": ("task.proprio", 5.0, r"task\.proprio: expected a whole number"),
    "action zero": ("task.action", 0, r"task\.action: expected a whole number of at least 1"),
    "workspace null": ("task.workspace", None, r"task\.workspace: expected a mapping"),
    "workspace without low": ("task.workspace.low", LACKING, r"task\.workspace: lacks \['low'\]"),
    "workspace upside down": ("task.workspace.low", [1.0, 1.0], r"task\.workspace\.low must be below high"),
    "workspace of text": ("task.workspace.low", ["-0.2", "-0.2"], r"task\.workspace\.low\[0\]: expected a number"),
    "workspace of one": ("task.workspace.low", [-0.2], r"task\.workspace\.low must be below high"),
    "workspace enormous": ("task.workspace.high", [1e30, 1e30], r"task\.workspace\.high\[0\]: expected a number"),
    "reach of one": ("task.workspace.reach", [0.2], r"task\.workspace\.reach: expected a list of 2"),
    "landmarks of three": ("task.workspace.landmarks", [[0.1, 0.1, 0.1]], "landmarks must have 2 coordinates"),
    "landmarks number": ("task.workspace.landmarks", 3, r"task\.workspace\.landmarks: expected a list"),
    "task options foo": ("task.options", "foo", r"task\.options: expected a mapping"),
    "task options other": ("task.options", {"foo": 1}, r"the options \{\} are not those of the task, \{'foo': 1\}"),
    "options text": ("options", "none", "options: expected a mapping"),
    "options interpolated": ("options", {"name": "${oc.env:HOME}"}, r"options\.name: expected a text without '\$\{'"),
    "options interpolated inside": ("options", {"a": [{"b": "x${c}"}]}, r"options\.a\[0\]\.b: expected a text without"),
    "options interpolated key": ("options", {"${oc.env:HOME}": 1}, "options.*expected a name"),
    "environment interpolated": ("environment", "${oc.env:HOME}", "environment: expected a name"),
    "environment number": ("environment", 3, "environment: expected a name"),
    "policies list": ("policies", ["random"], "policies: expected a mapping"),
    "policies text": ("policies", {"random": "3"}, r"policies\.random: expected a whole number"),
    "failures text": ("failures", "none", "failures: expected a whole number"),
    "coverage number": ("coverage", 0.3, "coverage: expected a mapping"),
    "coverage without visits": ("coverage", {"finger": {"moves": 0.5}}, r"coverage\.finger: lacks \['visited'\]"),
    "checksums text": ("checksums", "123", "checksums: expected a list"),
    "checksums too few": ("checksums", [1, 2], "2 checksums are not those of 3 episodes"),
}  # fmt: skip


def test_there_are_enough_kinds_of_damage():
    assert len(DAMAGE) > 80


@pytest.mark.parametrize(("place", "value", "message"), DAMAGE.values(), ids=DAMAGE.keys())
def test_damage_is_named(whole, damaged, place, value, message):
    with pytest.raises(DatasetError, match=message) as caught:
        damaged(changed(whole, place, value))
    assert str(caught.value).startswith(str(whole))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "3",
        '{"format": "torchrl_ocwm dataset"',
        '{"format": "torchrl_ocwm dataset", "version": 1, "records": NaN}',
        '{"format": "torchrl_ocwm dataset", "version": 1, "records": ' + "9" * 5000 + "}",
        "[" * 100_000,
        "\x00" * 400,
    ],
    ids=["empty", "null", "number", "cut", "NaN", "long number", "deep", "zeros"],
)
def test_text_that_is_no_index(damaged, text):
    with pytest.raises(DatasetError, match=r"dataset\.json: not (JSON|an index)"):
        damaged(text)


def test_every_field_of_a_task_is_checked():
    """A field that is added to a task or a workspace needs a rule here."""
    rules = ((Task, index_module.TASK, index_module.TASK_OPTIONAL),)
    rules += ((Workspace, index_module.WORKSPACE, index_module.WORKSPACE_OPTIONAL),)
    for kind, required, optional in rules:
        assert {field.name for field in fields(kind)} == {*required, *optional}


def test_older_tasks_may_be_without_later_fields(whole, tmp_path):
    without = json.loads(changed(whole, "task.workspace.landmarks", LACKING))
    del without["task"]["options"], without["task"]["workspace"]["reach"]
    index_module.check_index(without)


# Damage to the frames.

FRAMES = {
    "action 1e30": ("action", 3, 1e30, "frames/action: 1e.30 is beyond ±1"),
    "action -1.5": ("action", 3, -1.5, "frames/action: 1.5 is beyond ±1"),
    "position 1e30": (("next", "object_position"), 4, 1e30, "frames/next/object_position: 1e.30 is far outside"),
    "position in millimetres": (("next", "object_position"), 4, 150.0, "positions are metres"),
    "goal in millimetres": (("next", "goal_position"), 4, -150.0, "frames/next/goal_position: 150 is far outside"),
    "done flipped off": (("next", "done"), 11, False, "frames/next/done: must be set at the last record"),
    "done flipped on": (("next", "done"), 8, True, "frames/next/done: must be set at the last record"),
    "terminated flipped on": (("next", "terminated"), 8, True, "frames/next/terminated: is set where next/done is not"),
    "pixels zero": (("next", "pixels"), slice(6, 12), 0, "frames/next/pixels: the images of episode 1 are black"),
    "proprio infinite": (("next", "proprio"), 2, float("inf"), r"next/proprio\.memmap: holds NaN or infinity"),
    "is_init flipped off": ("is_init", 6, False, r"is_init\.memmap: episodes do not start where"),
}


@pytest.mark.parametrize(("key", "place", "value", "message"), FRAMES.values(), ids=FRAMES.keys())
def test_damaged_frames_are_named(tmp_path, key, place, value, message):
    dataset = random_dataset(tmp_path / "data", reacher_task(SIZE), episodes=3, length=6)
    frames = dataset.records[key].clone()
    frames[place] = value
    name = key if isinstance(key, str) else "/".join(key)
    (dataset.path / f"frames/{name}.memmap").write_bytes(frames.view(torch.uint8).numpy().tobytes())
    with pytest.raises(DatasetError, match=message):
        EpisodeDataset.open(dataset.path)


def test_file_that_the_index_does_not_know(tmp_path):
    dataset = random_dataset(tmp_path / "data", reacher_task(SIZE))
    (dataset.path / "frames/next/depth.memmap").write_bytes(b"123")
    with pytest.raises(DatasetError, match=r"next/depth\.memmap: dataset\.json does not know this file"):
        EpisodeDataset.open(dataset.path)


# What is given at creation is checked alike.


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"environment": 3}, "environment: expected a name"),
        ({"options": {"name": "${oc.env:HOME}"}}, r"options\.name: expected a text without"),
        ({"task": {**reacher_task(SIZE).to_dict(), "image_size": "64"}}, r"task\.image_size: expected a whole number"),
        ({"note": {1, 2}}, "the metadata of a dataset must fit in JSON"),
        ({"note": float("nan")}, "the metadata of a dataset must fit in JSON"),
    ],
)
def test_metadata_is_checked_when_a_dataset_is_made(tmp_path, change, message):
    task = reacher_task(SIZE)
    metadata = {"environment": "reacher", "options": {}, "task": task.to_dict(), **change}
    with pytest.raises(DatasetError, match=message):
        EpisodeDataset.create(tmp_path / "data", example=random_records(task, 1, 1)[0, 0], metadata=metadata)
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("change", [{"coverage": 3}, {"note": {1, 2}}, {"task": None}])
def test_annotations_are_checked(tmp_path, change):
    path = random_dataset(tmp_path / "data", reacher_task(SIZE)).path
    with EpisodeDataset.open(path, write=True) as dataset:
        before = (path / "dataset.json").read_bytes()
        with pytest.raises(DatasetError):
            dataset.annotate(**change)
    assert (path / "dataset.json").read_bytes() == before
    EpisodeDataset.open(path)


def test_nothing_of_an_index_is_looked_up_by_name():
    """Types come from a table, so that no text of a file reaches ``getattr``, an import or an interpolation."""
    sources = [Path(sys.modules[f"torchrl_ocwm.data.{name}"].__file__).read_text() for name in ("index", "dataset")]
    assert not any(word in source for source in sources for word in ("getattr", "import_module", "OmegaConf"))
