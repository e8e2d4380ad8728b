from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_ocwm.modules import TemporalDistance
from torchrl_ocwm.objectives import TemporalDistanceLoss, temporal_pairs

PLACES, LENGTH = 40, 12
FRAMES = TensorDictModule(nn.Identity(), ["place"], [("latent", "goal")])


def pairs_by_hand(sequences: int, starts: int, horizon: int) -> tuple[dict[Any, float], set[Any]]:
    """All pairs of points (sequence, start, steps) that can be drawn: positives with their labels, and negatives."""
    points = [(b, t, k) for b in range(sequences) for t in range(starts) for k in range(horizon + 1)]
    positives = {(a, b): (b[2] - a[2]) / horizon for a in points for b in points if a[:2] == b[:2] and a[2] <= b[2]}
    return positives, {(a, b) for a in points for b in points if a[0] != b[0]}


@pytest.mark.parametrize(("sequences", "starts", "horizon"), [(2, 2, 1), (3, 2, 2), (2, 1, 3)])
def test_pairs_are_those_drawn_by_hand(sequences: int, starts: int, horizon: int) -> None:
    """Each that there is, each as often, and each with its label."""
    positives, negatives = pairs_by_hand(sequences, starts, horizon)
    per_pair = 400
    numbers = {"positives": per_pair * len(positives), "negatives": per_pair * len(negatives)}
    pairs = temporal_pairs(sequences, starts, horizon, **numbers)
    seen: dict[Any, list[float]] = {}
    for (first, second), steps, label in zip(*(part.tolist() for part in pairs), strict=True):
        ends = ((*divmod(first, starts), steps[0]), (*divmod(second, starts), steps[1]))
        seen.setdefault(ends, []).append(label)
    for ends, labels in seen.items():
        assert labels == pytest.approx([positives.get(ends, 1.0)] * len(labels)), ends
    assert seen.keys() == positives.keys() | negatives
    counts = torch.tensor([len(labels) for labels in seen.values()])
    assert (counts - per_pair).abs().max() < 6 * per_pair**0.5  # six standard deviations


def test_pairs_have_fixed_shapes() -> None:
    pairs = temporal_pairs(2, 3, 4, positives=5, negatives=2)
    assert [part.shape for part in pairs] == [(7, 2), (7, 2), (7,)]
    assert temporal_pairs(1, 3, 4, positives=5, negatives=0).labels.shape == (5,)
    with pytest.raises(ValueError, match="batch of one sequence has no other sequences.*negatives=0"):
        temporal_pairs(1, 3, 4, positives=5, negatives=1)


def embedding(place: Tensor) -> Tensor:
    """Places ``[...]`` on a line as bumps ``[..., E]``, as an encoder of images of a dot would see them."""
    return torch.exp(-0.5 * (place.unsqueeze(-1) - torch.linspace(0, PLACES, 12)).square() / 9)


def walks(number: int = 64) -> TensorDict:
    """A world in which each step leads one place on: records of two sequences, and rollouts from each frame."""
    start = torch.rand(2, number // 2) * (PLACES - LENGTH)
    places = start.flatten().unsqueeze(-1) + torch.arange(LENGTH + 1.0)
    latent = TensorDict(
        {"state": embedding(places), "belief": torch.zeros(number, LENGTH + 1, 1)}, [number, LENGTH + 1]
    )
    imagined = {"latent": latent[:, :-1], "next": {"latent": latent[:, 1:]}}
    frames = {"state": embedding(start), "belief": torch.zeros(*start.shape, 1), "place": embedding(start)}
    return TensorDict(
        {"records": TensorDict({"next": frames}, start.shape), "imagined": TensorDict(imagined, [number, LENGTH])}
    )


class Head(nn.Module):
    """The state is the embedding already."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))

    def forward(self, state: Tensor, belief: Tensor) -> Tensor:
        return self.scale * state + 0 * belief


def ranks(values: Tensor) -> Tensor:
    """Ranks of values, the mean rank for equal ones."""
    values = values.unsqueeze(-1)
    return (values > values.T).double().sum(1) + 0.5 * (values == values.T).double().sum(1)


def rank_correlation(first: Tensor, second: Tensor) -> float:
    """Spearman's."""
    return float(torch.corrcoef(torch.stack([ranks(first), ranks(second)]))[0, 1])


def test_rank_correlation() -> None:
    assert rank_correlation(torch.tensor([1.0, 2.0, 9.0]), torch.tensor([0.1, 0.2, 0.3])) == pytest.approx(1)
    assert rank_correlation(torch.tensor([1.0, 2.0, 2.0, 3.0]), torch.tensor([4.0, 3.0, 2.0, 1.0])) == pytest.approx(
        -0.9486833
    )


@pytest.mark.parametrize("batch_norm", [False, True])
def test_distance_orders_pairs_by_their_true_steps(batch_norm: bool) -> None:
    distance = TemporalDistance(12, layers=2, units=64, batch_norm=batch_norm)
    loss = TemporalDistanceLoss(Head(), distance, FRAMES)
    optimizer = torch.optim.Adam(distance.parameters(), 2e-3)
    for _ in range(300):
        optimizer.zero_grad()
        loss(walks())["loss_temporal_distance"].backward()
        optimizer.step()
    start = torch.rand(400) * (PLACES - LENGTH)
    steps = torch.randint(LENGTH + 1, (400,))
    with torch.no_grad():
        learnt = distance(embedding(start), embedding(start + steps)).squeeze(-1)
    assert rank_correlation(learnt, steps) >= 0.9
    assert learnt[steps == 0].mean() < 0.3 < 0.6 < learnt[steps == LENGTH].mean()  # in units of the horizon
    backwards = distance(embedding(start + steps), embedding(start)).squeeze(-1)
    assert backwards[steps > 6].mean() > learnt[steps > 6].mean()  # there is no way back


class Recorded(nn.Module):
    """Keeps what it is asked, and answers with a parameter."""

    def __init__(self) -> None:
        super().__init__()
        self.answer = nn.Parameter(torch.full((1,), 0.25))
        self.asked: list[tuple[Tensor, Tensor]] = []

    def forward(self, here: Tensor, there: Tensor, *, learning: bool) -> Tensor:
        assert learning
        self.asked.append((here, there))
        return self.answer.expand(*here.shape[:-1], 1)


def test_losses_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """The squared errors of the pairs that were drawn, one by one."""
    data, distance, head = walks(6), Recorded(), Head()
    drawn = temporal_pairs(2, 3, LENGTH, positives=20, negatives=4)
    asked: list[dict[str, int]] = []

    def draw(*sizes: int, positives: int, negatives: int, **_: Any) -> Any:
        asked.append({"positives": positives, "negatives": negatives})
        assert sizes == (2, 3, LENGTH)
        return drawn

    monkeypatch.setattr("torchrl_ocwm.objectives.temporal_distance.temporal_pairs", draw)
    with torch.no_grad():
        head.scale.fill_(2)
    losses = TemporalDistanceLoss(head, distance, FRAMES, positives=20, negatives=0.22)(data)
    assert asked == [{"positives": 20, "negatives": 4}]
    expected = 0.0
    for index, (rollouts, points, label) in enumerate(zip(*(part.tolist() for part in drawn), strict=True)):
        expected += (0.25 - label) ** 2 / 24
        for end in (0, 1):
            rollout = data["imagined"][rollouts[end]]
            last = points[end] == LENGTH
            latent = rollout["next", "latent"][-1] if last else rollout["latent"][points[end]]
            torch.testing.assert_close(distance.asked[0][end][index], 2 * latent["state"])
    torch.testing.assert_close(losses["loss_temporal_distance"], torch.tensor(expected))
    place = data["records", "next", "place"]
    torch.testing.assert_close(losses["loss_embedding"], place.square().mean())  # twice the place instead of it


def trained(loss: Tensor, **parts: nn.Module) -> set[str]:
    loss.backward()
    return {name for name, part in parts.items() if any(p.grad is not None for p in part.parameters())}


@pytest.mark.parametrize(("name", "expected"), [("loss_embedding", {"head"}), ("loss_temporal_distance", {"distance"})])
def test_each_loss_trains_its_own_part(name: str, expected: set[str]) -> None:
    """And neither the latents nor what goals are made with."""
    head, distance, world = Head(), TemporalDistance(12, layers=1, units=8), nn.Linear(1, 1)
    frames = nn.Linear(12, 12)
    data = walks(6)
    for key in data.keys(True, True):
        data[key] = data[key] * world.weight.sum()
    goal = TensorDictModule(frames, ["place"], [("latent", "goal")])
    loss = TemporalDistanceLoss(head, distance, goal)(data)[name]
    assert trained(loss, head=head, distance=distance, world=world, frames=frames) == expected


def test_keys_can_be_set() -> None:
    frames = TensorDictModule(nn.Identity(), ["place"], [("my", "embedding")])
    data = walks(6)
    torch.manual_seed(1)
    expected = TemporalDistanceLoss(Head(), Recorded(), FRAMES)(data)
    for place in (("records", "next"), ("imagined", "latent"), ("imagined", "next", "latent")):
        data[place].rename_key_("state", "s")
        data[place].rename_key_("belief", "b")
    torch.manual_seed(1)
    loss = TemporalDistanceLoss(Head(), Recorded(), frames)
    loss.set_keys(state="s", belief="b", embedding=("my", "embedding"))
    got = loss(data.select(*loss.in_keys))
    assert set(got.keys()) == set(loss.out_keys)
    assert ("records", "next", "place") in loss.in_keys
    torch.testing.assert_close(got, expected)


def test_rollouts_of_other_records_are_refused() -> None:
    data = walks(6)
    data["imagined"] = data["imagined"][:5]
    with pytest.raises(ValueError, match=r"a rollout from each of the \(2, 3\) records, got 5 rollouts"):
        TemporalDistanceLoss(Head(), Recorded(), FRAMES)(data)


def test_compiles_into_one_graph() -> None:
    distance: Callable[..., Tensor] = TemporalDistance(12, layers=1, units=8, batch_norm=True)
    loss, data = TemporalDistanceLoss(Head(), distance, FRAMES), walks(6)  # type: ignore[arg-type]
    results = []
    for call in (loss, torch.compile(loss, fullgraph=True, backend="eager")):
        torch.manual_seed(1)
        results.append(call(data))
    torch.testing.assert_close(*results)
