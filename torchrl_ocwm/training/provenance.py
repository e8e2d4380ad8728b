"""What a checkpoint was trained with, and whether a run may go on from it."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, CheckpointError

from torchrl_ocwm.data.dataset import EpisodeDataset
from torchrl_ocwm.training.settings import Training


def trained_with(training: Training, dataset: EpisodeDataset) -> dict[str, Any]:
    """What decides the outcome of a run, beside its agent; fits in JSON."""
    return {"training": training.deciding(), "dataset": _fingerprint(dataset, len(dataset.episode_lengths))}


def trained_on(file: Path) -> str:
    """What tells the episodes that a checkpoint was trained on: their digest, or ``""`` if it does not say.

    Raises:
        CheckpointError: if it is none, or damaged.
    """
    there = _read(file)
    return "" if there is None else there["dataset"]["digest"]


def digest(dataset: EpisodeDataset) -> str:
    """What tells the episodes of a dataset: :func:`trained_on` of what is trained on all of them."""
    return _fingerprint(dataset, len(dataset.episode_lengths))["digest"]


def check_may_go_on(file: Path, training: Training, dataset: EpisodeDataset, *, grows: bool = False) -> None:
    """Raise unless a run may go on from a checkpoint with these settings and this dataset.

    Args:
        file: The checkpoint, which has been checked for damage.
        training: The settings; what ``changed`` names may differ.
        dataset: The dataset, wherever it is now.
        grows: It may have grown.

    Raises:
        CheckpointError: with what differs, and what may be said to go on.
    """
    there = _read(file)
    if there is None:
        warnings.warn(
            f"{file}: of a release that did not keep dataset and settings of a run; they are not compared",
            RuntimeWarning,
            stacklevel=2,
        )
        return
    differences = {**_other_settings(there["training"], training), **_other_dataset(there["dataset"], dataset, grows)}
    refused = [name for name in differences if name not in training.changed]
    if refused:
        what = "; ".join(differences[name] for name in refused)
        meant = sorted({*training.changed, *refused})
        may = set(refused) <= set(training.changeable())
        way = f"say training.changed=[{','.join(meant)}] if that is meant, or " if may else ""
        raise CheckpointError(f"{file}: was trained with something else ({what}); {way}choose another output folder")


def _read(file: Path) -> dict[str, Any] | None:
    metadata = Checkpoint.manifest(file).get("metadata")
    there = metadata.get("trained_with") if isinstance(metadata, dict) else None
    if there is None:
        return None
    kinds = {"episodes": int, "records": int, "digest": str}
    settings, data = (there.get(name) if isinstance(there, dict) else None for name in ("training", "dataset"))
    if (
        not isinstance(settings, dict)
        or not isinstance(data, dict)
        or {name: type(value) for name, value in data.items()} != kinds
    ):
        raise CheckpointError(f"{file}: damaged (what it was trained with is {there!r})")
    return there


def _other_settings(there: dict[str, Any], training: Training) -> dict[str, str]:
    # A setting that a later release adds has the default that was the rule before.
    before = {**Training().deciding(), **there}
    return {
        name: f"training.{name}: {before[name]} there, {value} here"
        for name, value in training.deciding().items()
        if before[name] != value
    }


def _other_dataset(there: dict[str, Any], dataset: EpisodeDataset, grows: bool) -> dict[str, str]:
    episodes = len(dataset.episode_lengths)
    if _fingerprint(dataset, there["episodes"]) != there:  # also if there are fewer: they have fewer records
        return {"dataset": f"dataset: {there['episodes']} other episodes there than in {dataset.path}"}
    more = episodes - there["episodes"]
    return {"dataset": f"dataset: {dataset.path} has grown by {more} episodes"} if more and not grows else {}


def _fingerprint(dataset: EpisodeDataset, episodes: int) -> dict[str, Any]:
    """Tells the first episodes of a dataset by their lengths and actions, wherever it is kept."""
    lengths = dataset.episode_lengths[:episodes]
    told = hashlib.sha256(repr(lengths).encode())
    told.update(dataset.records["action"][: sum(lengths)].contiguous().numpy().tobytes())
    return {"episodes": episodes, "records": sum(lengths), "digest": told.hexdigest()}
