"""From a collector over the disk to the sampled sequences: every step follows the one before."""

import warnings

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, Transform, TransformedEnv

from torchrl_ocwm.data import DatasetError, EpisodeDataset, episode_to_records, make_replay_buffer

LENGTHS = (5, 9, 6, 13)
SLICE = 4


class Counter(EnvBase):
    """Counts its steps and its episodes, which have the lengths 5, 9, 6, 13, 5, ...; keeps the action it was given."""

    def __init__(self) -> None:
        super().__init__()
        self.episode, self.count = -1, 0
        self.observation_spec = Composite(
            count=Unbounded((1,)), episode=Unbounded((1,)), taken=Unbounded((1,)), object_position_true=Unbounded((1,))
        )
        self.action_spec = Unbounded((1,))
        self.reward_spec = Unbounded((1,))

    def _observation(self, taken: torch.Tensor) -> dict[str, torch.Tensor]:
        count, episode = torch.tensor([[float(self.count)], [float(self.episode)]])
        return {"count": count, "episode": episode, "taken": taken.clone(), "object_position_true": count.clone()}

    def _reset(self, tensordict=None, **kwargs):
        self.episode, self.count = self.episode + 1, 0
        return TensorDict(self._observation(torch.zeros(1)), [])

    def _step(self, tensordict):
        self.count += 1
        done = torch.tensor([self.count == LENGTHS[self.episode % len(LENGTHS)]])
        reward = torch.tensor([-float(self.count)])
        return TensorDict({**self._observation(tensordict["action"]), "reward": reward, "done": done}, [])

    def _set_seed(self, seed):
        pass


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Eight episodes from a TorchRL collector with the arguments of torchrl_ocwm.data.collect."""
    policy = TensorDictModule(lambda count: torch.rand_like(count), in_keys=["count"], out_keys=["action"])
    collector = Collector(
        TransformedEnv(Counter(), InitTracker()),
        policy,
        frames_per_batch=10,
        total_frames=-1,
        trajs_per_batch=1,
        traj_format="cat",
        use_buffers=False,
    )
    dataset = None
    for batch in collector:
        records = episode_to_records(batch.reshape(-1)).exclude("exploration")
        if dataset is None:
            path = tmp_path_factory.mktemp("counter") / "data"
            dataset = EpisodeDataset.create(path, example=records[0])
        dataset.append(records)
        if len(dataset.episode_lengths) == 8:
            break
    collector.shutdown()
    return dataset


def sample(dataset: EpisodeDataset, seed: int = 0, batches: int = 1, **options) -> TensorDictBase:
    torch.manual_seed(seed)
    buffer = make_replay_buffer(dataset, **{"batch_size": 50, "slice_len": SLICE, **options})
    return torch.cat([buffer.sample() for _ in range(batches)])


def test_collected_episodes_are_whole(dataset):
    assert dataset.episode_lengths == [length + 1 for length in LENGTHS * 2]
    records, start = dataset.records, 0
    for number, length in enumerate(LENGTHS * 2):
        episode = records[start : start + length + 1]
        assert episode["next", "count"].flatten().tolist() == list(range(length + 1))
        assert (episode["next", "episode"] == number).all()
        assert torch.equal(episode["action"], episode["next", "taken"])
        assert episode["next", "reward"].flatten().tolist() == [-float(count) for count in range(length + 1)]
        assert episode["next", "done"].flatten().tolist() == [False] * length + [True]
        start += length + 1


def test_every_step_of_a_slice_follows_the_one_before(dataset):
    batch = sample(dataset, batches=10)
    assert batch.batch_size == (500, SLICE)
    count, episode = batch["next", "count"].squeeze(-1), batch["next", "episode"].squeeze(-1)
    assert torch.equal(count, count[:, :1] + torch.arange(SLICE))
    assert torch.equal(episode, episode[:, :1].expand_as(episode))
    assert torch.equal(batch["action"], batch["next", "taken"])
    assert torch.equal(batch["next", "reward"], -batch["next", "count"])
    # The last frame of an episode may only be the last of a slice.
    assert not batch["next", "done"][:, :-1].any()


def test_first_record_of_a_slice_is_marked(dataset):
    batch = sample(dataset, batches=10)
    assert batch["is_init"].dtype == torch.bool
    assert batch["is_init"].squeeze(-1).tolist() == [[True] + [False] * (SLICE - 1)] * 500


def test_marks_do_not_reach_the_dataset(dataset):
    before = dataset.records["is_init"].clone()
    sample(dataset, batches=3)
    assert torch.equal(dataset.records["is_init"], before)


def test_every_place_is_sampled(dataset):
    batch = sample(dataset, batches=100)
    seen = {(int(e), int(c)) for e, c in zip(batch["next", "episode"][:, 0], batch["next", "count"][:, 0], strict=True)}
    assert seen == {(e, c) for e, length in enumerate(LENGTHS * 2) for c in range(length + 1 - SLICE + 1)}


def test_slices_may_be_as_long_as_the_shortest_episode(dataset):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        batch = sample(dataset, slice_len=6)
    assert torch.equal(
        batch["next", "count"].squeeze(-1) - batch["next", "count"][:, 0], torch.arange(6.0).expand(50, 6)
    )


def test_episodes_shorter_than_a_slice_are_skipped(dataset):
    with pytest.warns(UserWarning, match=f"{dataset.path}: 4 of 8 episodes are shorter than 8 frames and are skipped"):
        batch = sample(dataset, batches=20, slice_len=8)
    assert batch.batch_size == (1000, 8)
    assert set(batch["next", "episode"].flatten().tolist()) == {1, 3, 5, 7}


def test_slices_longer_than_all_episodes(dataset):
    message = f"{dataset.path}: cannot cut sequences of 15 frames, the longest episode has 14; .*collect longer"
    with pytest.raises(DatasetError, match=message):
        make_replay_buffer(dataset, batch_size=2, slice_len=15)


# The buffer is to be read.


def new_records() -> TensorDict:
    frames = {key: torch.full((4, 1), 99.0) for key in ("count", "episode", "taken", "object_position_true", "reward")}
    ends = {key: torch.zeros(4, 1, dtype=torch.bool) for key in ("done", "terminated")}
    is_init = torch.arange(4).unsqueeze(-1) == 0
    return TensorDict({"action": torch.full((4, 1), 99.0), "is_init": is_init, "next": {**frames, **ends}}, [4])


WRITES = {
    "extend": lambda buffer: buffer.extend(new_records()),
    "add": lambda buffer: buffer.add(new_records()[0]),
    "set": lambda buffer: buffer.__setitem__(0, new_records()[0]),
    "set many": lambda buffer: buffer.__setitem__(slice(0, 4), new_records()),
    "empty": lambda buffer: buffer.empty(),
    "load": lambda buffer: buffer.load_state_dict(buffer.state_dict()),
}


@pytest.mark.parametrize("write", WRITES.values(), ids=WRITES.keys())
def test_buffer_refuses_to_be_written_and_says_how_to_add_episodes(dataset, write):
    buffer = make_replay_buffer(dataset, batch_size=2, slice_len=SLICE, exclude=())
    before = {file: file.read_bytes() for file in dataset.path.rglob("*.memmap")}
    message = rf"{dataset.path}: this buffer only samples; add episodes with EpisodeDataset\.open\(path, write=True\)"
    with pytest.raises(RuntimeError, match=message):
        write(buffer)
    assert {file: file.read_bytes() for file in dataset.path.rglob("*.memmap")} == before
    assert len(buffer) == len(dataset.records)
    assert buffer.sample()["next", "count"].max() < 99


def test_seed_repeats_the_samples(dataset):
    first, second, other = sample(dataset, 3), sample(dataset, 3), sample(dataset, 4)
    assert (first == second).all()
    assert not torch.equal(first["next", "count"], other["next", "count"])


def test_samples_differ_from_one_another(dataset):
    batch = sample(dataset, batches=2)
    assert not torch.equal(batch["next", "count"][:50], batch["next", "count"][50:])


def test_true_positions_are_left_out_unless_wanted(dataset):
    assert ("next", "object_position_true") not in sample(dataset).keys(True)
    assert ("next", "object_position_true") in sample(dataset, exclude=()).keys(True)
    assert "action" not in set(sample(dataset, exclude=("action",)).keys())


def test_transform_sees_sequences(dataset):
    class Half(Transform):
        def forward(self, tensordict):
            assert tensordict.batch_size == (50, SLICE)
            return tensordict.set(("next", "count"), tensordict["next", "count"] / 2)

    plain, halved = sample(dataset), sample(dataset, transform=Half())
    assert torch.equal(halved["next", "count"], plain["next", "count"] / 2)
