"""The streaming normaliser of rewards, against moments that are computed otherwise."""

from __future__ import annotations

import pytest
import torch

from torchrl_ocwm.modules import MovingCentre, StreamingNorm

BATCHES = [torch.randn(7, 5, generator=torch.Generator().manual_seed(i)) * (i + 1) + 3 * i for i in range(6)]


@pytest.mark.parametrize("mode", ["standard", "scale"])
def test_moments_of_all_that_was_seen(mode: str) -> None:
    """Until there is more than the rate covers, they are those of all batches together."""
    norm = StreamingNorm(mode)
    for batch in BATCHES:
        got = norm(batch)
    seen = torch.cat(BATCHES)
    centre = seen.mean() if mode == "standard" else torch.tensor(0.0)
    spread = (seen - centre).square().mean().sqrt()
    torch.testing.assert_close(got, (BATCHES[-1] - centre) / spread)


def test_old_values_are_forgotten_at_the_rate() -> None:
    norm, mean = StreamingNorm("standard", rate=0.5), 0.0
    for number, batch in enumerate(BATCHES):
        norm(batch)
        mean = float(batch.mean()) if number == 0 else 0.5 * mean + 0.5 * float(batch.mean())
    torch.testing.assert_close(norm.mean, torch.tensor(mean))


def test_in_evaluation_mode_nothing_moves() -> None:
    norm = StreamingNorm("standard")
    norm(BATCHES[0])
    before = {name: value.clone() for name, value in norm.state_dict().items()}
    assert set(before) == {"mean", "square", "calls"}
    norm.eval()(BATCHES[5])
    torch.testing.assert_close(norm.state_dict(), before)


def test_saved_with_its_state() -> None:
    norm, again = StreamingNorm("standard"), StreamingNorm("standard").eval()
    norm(BATCHES[3])
    again.load_state_dict(norm.state_dict())
    torch.testing.assert_close(again(BATCHES[1]), norm.eval()(BATCHES[1]))


@pytest.mark.parametrize("mode", ["standard", "scale", "none"])
def test_nothing_seen_or_nothing_asked_changes_nothing(mode: str) -> None:
    torch.testing.assert_close(StreamingNorm(mode).eval()(BATCHES[0]), BATCHES[0])
    torch.testing.assert_close(StreamingNorm("none")(BATCHES[1]), BATCHES[1])


def test_a_reward_that_is_always_the_same_is_finite() -> None:
    assert torch.equal(StreamingNorm("standard")(torch.full((3,), 2.0)), torch.zeros(3))
    assert StreamingNorm("scale")(torch.zeros(3)).isfinite().all()


def test_gradients_go_through_values_alone() -> None:
    norm, values = StreamingNorm("scale"), torch.tensor([3.0, 4.0], requires_grad=True)
    norm(values).sum().backward()
    torch.testing.assert_close(values.grad, torch.full((2,), 1 / 12.5**0.5))
    assert not norm.mean.requires_grad


def test_an_unknown_mode() -> None:
    with pytest.raises(ValueError, match="mode must be one of 'none', 'scale', 'standard', got 'rms'"):
        StreamingNorm("rms")


def test_compiled_it_is_the_same() -> None:
    """In one graph, as the update is compiled, its state included."""
    plain, other = StreamingNorm("standard"), StreamingNorm("standard")
    compiled = torch.compile(other, backend="eager", fullgraph=True)
    for batch in BATCHES[:3]:
        torch.testing.assert_close(compiled(batch), plain(batch))
    torch.testing.assert_close(other.state_dict(), plain.state_dict())


class TestMovingCentre:
    FIRST = torch.tensor([[1.0, 0.0], [3.0, 2.0]])
    SECOND = torch.tensor([[[6.0, 1.0]], [[8.0, 9.0]]])

    def test_the_mean_of_all_that_was_seen_and_then_a_moving_one(self) -> None:
        centre = MovingCentre(2, rate=0.4)
        centre(self.FIRST)
        torch.testing.assert_close(centre.mean, torch.tensor([2.0, 1.0]))
        torch.testing.assert_close(centre(self.SECOND), self.SECOND - torch.tensor([4.5, 3.0]))  # half of both
        centre(self.FIRST)
        torch.testing.assert_close(centre.mean, torch.tensor([0.6 * 4.5 + 0.4 * 2, 0.6 * 3 + 0.4 * 1]))

    def test_in_evaluation_mode_it_stays(self) -> None:
        centre = MovingCentre(2)
        centre(self.FIRST)
        torch.testing.assert_close(centre.eval()(self.SECOND), self.SECOND - torch.tensor([2.0, 1.0]))

    def test_saved_with_its_state(self) -> None:
        centre, again = MovingCentre(2), MovingCentre(2)
        centre(self.FIRST)
        again.load_state_dict(centre.state_dict())
        torch.testing.assert_close(again(self.SECOND), centre(self.SECOND))

    def test_gradients_go_through_vectors_alone(self) -> None:
        vectors = self.FIRST.clone().requires_grad_()
        MovingCentre(2)(vectors).sum().backward()
        torch.testing.assert_close(vectors.grad, torch.ones(2, 2))

    def test_compiled_it_is_the_same(self) -> None:
        plain, other = MovingCentre(2), MovingCentre(2)
        compiled = torch.compile(other, backend="eager", fullgraph=True)
        for batch in (self.FIRST, self.SECOND):
            torch.testing.assert_close(compiled(batch), plain(batch))
        torch.testing.assert_close(other.state_dict(), plain.state_dict())
