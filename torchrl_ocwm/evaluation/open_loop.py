"""Open-loop prediction: a world model sees the first frames of sequences, and imagines the rest from the actions."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_ocwm.data.dataset import EpisodeDataset
from torchrl_ocwm.modules import RSSMWorldModel

_SEQUENCES = 10  # at a time: what is decoded on the way takes memory


def random_sequences(dataset: EpisodeDataset, sequences: int, length: int, *, seed: int = 0) -> TensorDictBase:
    """Sequences from random places in episodes that are spread over a dataset.

    Args:
        dataset: Where they are from.
        sequences: How many N.
        length: Records of each T.
        seed: Of the places.

    Returns:
        ``[N, T]`` records, the first of each sequence with ``is_init`` set.

    Raises:
        DatasetError: if all episodes are shorter than that.

    Examples:
        >>> import tempfile
        >>> from torchrl_ocwm.testing import random_dataset, reacher_task
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dataset = random_dataset(folder + "/data", reacher_task(), length=20)
        ...     random_sequences(dataset, 6, 15)["is_init"].squeeze(-1).nonzero()[:, 1]
        tensor([0, 0, 0, 0, 0, 0])
    """
    lengths, fitting = torch.tensor(dataset.episode_lengths), torch.tensor(dataset.long_enough(length))
    episodes = fitting[torch.linspace(0, len(fitting) - 1, sequences).long()]
    room = lengths[episodes] - length + 1
    starts = (lengths.cumsum(0) - lengths)[episodes]
    starts += (torch.rand(sequences, generator=torch.Generator().manual_seed(seed)) * room).long()
    records = dataset.records[starts[:, None] + torch.arange(length)].contiguous()
    records["is_init"][:, 0] = True
    return records


@torch.no_grad()
def posterior(model: RSSMWorldModel, records: TensorDictBase, *names: str) -> TensorDictBase:
    """What a world model makes of records when it sees them all.

    Args:
        model: The world model.
        records: ``[N, T]`` records, the first of each sequence with ``is_init`` set.
        names: What to compute of what :meth:`~torchrl_ocwm.modules.RSSMWorldModel.records` writes under ``next``.

    Returns:
        ``[N, T]`` with these names.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> model = build_agent("focus_lcp", reacher_task(), size="debug").model
        >>> posterior(model, random_records(reacher_task(), 2, 5), "state", "object_latent")["object_latent"].shape
        torch.Size([2, 5, 2, 16])
    """
    module = model.records().select_subsequence(out_keys=[("next", name) for name in names])
    parts = [module(part.clone())["next"].select(*names) for part in records.split(_SEQUENCES)]
    return torch.cat(parts)


@torch.no_grad()
def open_loop_latents(model: RSSMWorldModel, records: TensorDictBase, context: int) -> TensorDictBase:
    """Latents of a world model that sees the first frames, and afterwards only the actions.

    Args:
        model: The world model.
        records: ``[N, T]`` records, the first of each sequence with ``is_init`` set.
        context: Frames that it sees; the others are imagined.

    Returns:
        ``[N, T]`` with ``state`` and ``belief``: filtered in the context, then imagined.
    """
    seen = posterior(model, records[:, :context], "state", "belief")
    transition = model.transition()
    latents = list(seen.unbind(1))
    for actions in records["action"][:, context:].unbind(1):
        step = TensorDict({"latent": latents[-1].copy(), "action": actions}, [len(records)])
        latents.append(transition(step)["latent"])
    return torch.stack(latents, 1)
