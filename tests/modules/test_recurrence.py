"""Our recurrence, rollout and draws are TorchRL's, in fewer operations."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.modules import RSSMPosteriorV3, RSSMPriorV3, RSSMRolloutV3
from torchrl.modules.models.model_based import _straight_through_categorical

from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.modules.networks import make_rssm
from torchrl_ocwm.modules.recurrence import BlockGRU, Rollout, bounded, sample

STATE, BELIEF, ACTION, EMBEDDING = 12, 8, 2, 5
SHAPES = {"hidden_dim": 6, "rnn_hidden_dim": BELIEF, "num_categoricals": 4, "num_classes": 3, "unimix": 0.01}


def pairs(style: str) -> tuple[tuple[torch.nn.Module, torch.nn.Module], ...]:
    """Prior and posterior: TorchRL's, and ours with the same weights."""
    torch.manual_seed(1)
    v3 = style == "dreamer_v3"
    core = {"recurrent_model": "block_gru", "num_blocks": 2} if v3 else {}
    prior = RSSMPriorV3(action_shape=(ACTION,), action_dim=ACTION, **SHAPES, **core)
    posterior = RSSMPosteriorV3(obs_embed_dim=EMBEDDING, use_rms_norm=v3, **SHAPES)
    shapes = Architecture(style=style, categoricals=4, classes=3, belief=BELIEF, hidden=6, gru_blocks=2 if v3 else 8)
    ours = make_rssm(shapes, action=ACTION, embedding=EMBEDDING)
    for plain, own in zip((prior, posterior), ours, strict=True):
        with torch.no_grad():
            for parameter in plain.parameters():
                parameter.add_(0.3 * torch.randn_like(parameter))
        own.load_state_dict(plain.state_dict())
    return (prior, ours[0]), (posterior, ours[1])


def rollout(kind: type[RSSMRolloutV3], prior: torch.nn.Module, posterior: torch.nn.Module) -> RSSMRolloutV3:
    after = [("next", "prior_logits"), ("next", "state"), ("next", "belief")]
    seen = [("next", "belief"), ("next", "encoded_latents")]
    return kind(
        TensorDictModule(prior, ["state", "belief", "action"], after),
        TensorDictModule(posterior, seen, [("next", "posterior_logits"), ("next", "state")]),
    )


def sequences() -> TensorDict:
    torch.manual_seed(2)
    records = {"state": torch.zeros(3, 6, STATE), "belief": torch.rand(3, 6, BELIEF)}
    records["action"] = 3 * torch.randn(3, 6, ACTION)  # some beyond [−1, 1]
    records["is_init"] = torch.zeros(3, 6, 1, dtype=torch.bool)
    records["is_init"][1, 3] = True
    records["next"] = {"encoded_latents": torch.randn(3, 6, EMBEDDING, requires_grad=True)}
    return TensorDict(records, [3, 6])


@pytest.mark.parametrize("style", ["dreamer_v3", "dreamer_v2"])
def test_rollout_is_that_of_torchrl(style: str) -> None:
    """The same random numbers, latents, logits and gradients; an episode begins inside a sequence."""
    results = []
    for index, kind in enumerate((RSSMRolloutV3, Rollout)):
        prior, posterior = (pair[index] for pair in pairs(style))
        records = sequences()
        if style == "dreamer_v2":  # TorchRL clips actions in its block GRU alone
            records["action"] = bounded(records["action"])
        torch.manual_seed(3)
        out = rollout(kind, prior, posterior)(records)
        torch.manual_seed(4)
        keys = [
            "state",
            "belief",
            *(("next", name) for name in ("prior_logits", "posterior_logits", "state", "belief")),
        ]
        sum((torch.randn_like(out[key]) * out[key]).sum() for key in keys).backward()
        gradients = {name: p.grad for part in (prior, posterior) for name, p in part.named_parameters()}
        results.append((out, gradients, records["next", "encoded_latents"].grad))
    (expected, slow, of_input), (got, fast, of_own) = results
    for key in ("state", "belief", "action", "next"):
        torch.testing.assert_close(got[key], expected[key], rtol=1e-4, atol=1e-5)
    assert fast.keys() == slow.keys()
    for name, gradient in slow.items():
        torch.testing.assert_close(fast[name], gradient, rtol=1e-4, atol=1e-5, msg=name)
    torch.testing.assert_close(of_own, of_input, rtol=1e-4, atol=1e-5)


def test_a_step_that_torchrl_has_chosen_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """``compile_rollout`` keeps its effect."""
    prior, posterior = (ours for _, ours in pairs("dreamer_v3"))
    steps, step = [], Rollout._step
    monkeypatch.setattr(Rollout, "_step", lambda self, *inputs: steps.append(1) or step(self, *inputs))
    own = rollout(Rollout, prior, posterior)
    torch.manual_seed(3)
    expected = own(sequences())
    assert not steps
    own.compile_rollout("step", compile=False)
    torch.manual_seed(3)
    torch.testing.assert_close(own(sequences())["next"], expected["next"], rtol=1e-4, atol=1e-5)
    assert len(steps) == 6


@pytest.mark.parametrize("batch", [(7,), (2, 3)])
def test_block_gru_is_that_of_torchrl(batch: tuple[int, ...]) -> None:
    (prior, ours), _ = pairs("dreamer_v3")
    assert isinstance(ours.rnn, BlockGRU)
    inputs = [torch.randn(*batch, size) for size in (STATE, BELIEF, ACTION)]
    torch.testing.assert_close(ours.rnn(*inputs), prior.rnn(*inputs))


def test_prior_and_posterior_are_those_of_torchrl() -> None:
    (prior, ours), (posterior, own) = pairs("dreamer_v3")
    state, belief, action, seen = (torch.randn(5, size) for size in (STATE, BELIEF, ACTION, EMBEDDING))
    for plain, fast, inputs in ((prior, ours, (state, belief, action)), (posterior, own, (belief, seen))):
        for uniform in ({}, {"_uniform": torch.rand(5, 4)}):
            torch.manual_seed(5)
            expected = plain(*inputs, **uniform)
            torch.manual_seed(5)
            torch.testing.assert_close(fast(*inputs, **uniform), expected)


def test_draws_are_those_of_torchrl_and_their_gradient_that_of_the_probabilities() -> None:
    logits = torch.randn(1000, 4, 3, requires_grad=True)
    other, uniform = deepcopy(logits.detach()).requires_grad_(), torch.rand(1000, 4)
    drawn, expected = sample(logits, 0.3, uniform.unsqueeze(-1)), _straight_through_categorical(other, 0.3, uniform)
    torch.testing.assert_close(drawn, expected.flatten(-2))
    weight = torch.randn(1000, 12)
    (weight * drawn).sum().backward()
    (weight * expected.flatten(-2)).sum().backward()
    torch.testing.assert_close(logits.grad, other.grad)


def test_a_draw_at_the_very_end_is_the_last_class() -> None:
    """Rounding can leave the sum of the probabilities below a random number."""
    drawn = sample(torch.zeros(1, 1, 3), 0.0, torch.full((1, 1, 1), 1.0 + 1e-6))
    assert drawn.tolist() == [[0.0, 0.0, 1.0]]


def test_bounded_clips_and_keeps_a_gradient() -> None:
    action = torch.tensor([-4.0, 0.5, 2.0], requires_grad=True)
    clipped = bounded(action)
    assert clipped.tolist() == [-1.0, 0.5, 1.0]
    clipped.sum().backward()
    assert action.grad.tolist() == [0.25, 1.0, 0.5]
