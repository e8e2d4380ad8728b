"""Sequences to train on, sampled from a dataset with TorchRL's replay buffer."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer, SliceSampler, TensorStorage
from torchrl.envs import Compose, Transform

from torchrl_ocwm.data.dataset import EpisodeDataset
from torchrl_ocwm.data.memory import release_pages
from torchrl_ocwm.data.relabel import RelabelGoals


class MemoryMappedStorage(TensorStorage):
    """A storage to read memory-mapped data from; pages are handed back after each read, so that memory stays flat.

    Args:
        storage: Memory-mapped tensordict ``[N]``.
        refusal: What to say to those who want to write.
    """

    def __init__(self, storage: TensorDictBase, refusal: str) -> None:
        super().__init__(storage)
        self.refusal = refusal

    def get(self, index: Any) -> TensorDictBase:
        """Read records, and give back the memory of the files' pages."""
        data = super().get(index)
        release_pages(self._storage)
        return data

    def set(self, *arguments: Any, **options: Any) -> None:  # noqa: ARG002
        """Refuse to write.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError(self.refusal)

    load_state_dict = set  # noqa: A003


class StackSlices(Transform):
    """Give the time dimension back to sampled slices, ``[B * T]`` → ``[B, T]``, and mark their first records.

    Args:
        slice_len: T.
    """

    def __init__(self, slice_len: int) -> None:
        super().__init__()
        self.slice_len = slice_len

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Records ``[B * T]`` to sequences ``[B, T]``, each of which starts anew."""
        sequences = tensordict.reshape(-1, self.slice_len)
        sequences["is_init"][:, 0] = True
        return sequences


def make_replay_buffer(
    dataset: EpisodeDataset,
    *,
    batch_size: int,
    slice_len: int,
    transform: Transform | None = None,
    exclude: tuple[tuple[str, ...] | str, ...] = (("next", "object_position_true"),),
) -> ReplayBuffer:
    """A replay buffer whose samples are sequences ``[B, T]`` of records that never cross an episode.

    The first record of a sequence has ``is_init`` set, also in the middle of an episode: there the model starts from
    the zero state without a previous action, as the policy does at the first frame of an episode.

    The buffer is to be read: it refuses ``extend``, ``add`` and the like, and the dataset stays as it is. Episodes that
    are shorter than a sequence are skipped, with a warning.

    Args:
        dataset: Where to sample from.
        batch_size: Sequences per batch B.
        slice_len: Records per sequence T.
        transform: Applied to each batch ``[B, T]``, for instance :class:`~torchrl_ocwm.data.RelabelGoals`.
        exclude: Keys that are not read.

    Raises:
        DatasetError: if all episodes are shorter than ``slice_len``, or the transform wants other goals than the
            dataset can give.

    Examples:
        >>> import tempfile, torch
        >>> from tensordict import TensorDict
        >>> records = TensorDict({"action": torch.zeros(9, 2), "is_init": (torch.arange(9) == 0).unsqueeze(-1),
        ...     "next": {"observation": torch.rand(9, 4)}}, [9])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dataset = EpisodeDataset.create(folder + "/data", example=records[0])
        ...     dataset.append(records)
        ...     make_replay_buffer(dataset, batch_size=2, slice_len=4, exclude=()).sample().batch_size
        torch.Size([2, 4])
    """
    dataset.long_enough(slice_len)
    transforms = Compose(StackSlices(slice_len), *([] if transform is None else [transform]))
    for part in transforms.modules():
        if isinstance(part, RelabelGoals):
            part.sample_from(dataset)
    refusal = (
        f"{dataset.path}: this buffer only samples; add episodes with EpisodeDataset.open(path, write=True).append"
        "(episode_to_records(rollout)), and make a new buffer"
    )
    writer = ImmutableDatasetWriter()
    writer.WRITING_ERR = refusal
    return ReplayBuffer(
        storage=MemoryMappedStorage(dataset.records.exclude(*exclude), refusal),
        # Skips episodes that are too short.
        sampler=SliceSampler(slice_len=slice_len, trajectories=dataset.trajectories, cache_values=True),
        writer=writer,
        transform=transforms,
        batch_size=batch_size * slice_len,
    )
