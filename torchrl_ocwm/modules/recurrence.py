"""The recurrence of the RSSM: what can be done for all steps at once is not done step by step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear
from torchrl.modules import RSSMPosteriorV3, RSSMPriorV3, RSSMRolloutV3
from torchrl.modules.models.model_based import _DreamerV3BlockGRU

UPDATE_BIAS = -1.0


def bounded(action: Tensor) -> Tensor:
    """Clip to [−1, 1] and keep a gradient beyond, as TorchRL's block GRU does by itself."""
    action = action.float()
    with torch.no_grad():
        size = action.abs().clamp_min_(1)
    return action / size


def sample(logits: Tensor, unimix: float, uniform: Tensor | None = None) -> Tensor:
    """Draw one-hot states; the gradient is that of the probabilities ("straight through").

    Args:
        logits: ``[..., N, C]``.
        unimix: Share of a uniform distribution that is mixed in.
        uniform: Random numbers ``[..., N, 1]`` in [0, 1) to draw with; drawn here by default.

    Returns:
        ``[..., N * C]``.

    Examples:
        >>> sample(torch.tensor([[0.0, 0.0], [0.0, 9.0]]), 0.01, torch.tensor([[0.7], [0.7]]))
        tensor([0., 1., 0., 1.])
    """
    if uniform is None:
        uniform = torch.rand(*logits.shape[:-1], 1, device=logits.device)
    return _Sample.apply(logits, unimix, uniform).flatten(-2)


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logits: Tensor, unimix: float, uniform: Tensor) -> Tensor:
        probabilities = logits.softmax(-1)
        ctx.save_for_backward(probabilities)
        ctx.unimix = unimix
        classes = logits.shape[-1]
        below = (probabilities * (1 - unimix) + unimix / classes).cumsum(-1)
        index = torch.searchsorted(below, uniform.to(below.dtype)).clamp_max_(classes - 1)
        return torch.zeros_like(probabilities).scatter_(-1, index, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (probabilities,) = ctx.saved_tensors
        weighted = gradient * (1 - ctx.unimix)
        return torch._softmax_backward_data(weighted, probabilities, -1, probabilities.dtype), None, None


def _columns(uniform: Tensor | None) -> Tensor | None:
    return None if uniform is None else uniform.unsqueeze(-1)


class Prior(RSSMPriorV3):
    """TorchRL's prior of the RSSM. Actions beyond [−1, 1] count as clipped."""

    def forward(
        self, state: Tensor, belief: Tensor, action: Tensor, *, _uniform: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Logits ``[..., N, C]``, state ``[..., N * C]`` and belief ``[..., H]`` of the next step."""
        belief = self._update_belief(state, belief, action)
        logits = self.logits(belief)
        return logits, sample(logits, self.unimix, _columns(_uniform)), belief

    def logits(self, belief: Tensor) -> Tensor:
        """What is expected after beliefs ``[..., H]``, ``[..., N, C]``."""
        return self.rnn_to_prior_projector(belief).unflatten(-1, (self.num_categoricals, self.num_classes))

    def _update_belief(self, state: Tensor, belief: Tensor, action: Tensor) -> Tensor:
        if isinstance(self.rnn, BlockGRU):
            return self.rnn(state, belief, action)
        return super()._update_belief(state, belief, bounded(action))

    def prepare(self, action: Tensor) -> tuple[Callable[[Tensor, Tensor, Tensor], Tensor], Tensor]:
        """How a belief follows from state, belief and what is prepared of an action; that for actions ``[..., A]``."""
        if not isinstance(self.rnn, BlockGRU):
            return self._update_belief, action
        weights, done = self.rnn.prepare(action)
        return lambda state, belief, act: self.rnn.advance(state, belief, weights, act), done


class Posterior(RSSMPosteriorV3):
    """TorchRL's posterior of the RSSM."""

    def forward(
        self, belief: Tensor, obs_embedding: Tensor, *, _uniform: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Logits ``[..., N, C]`` and state ``[..., N * C]`` after an observation."""
        of_belief, seen = self.prepare(obs_embedding)
        logits = self.logits(belief, of_belief, seen)
        return logits, sample(logits, self.unimix, _columns(_uniform))

    def prepare(self, embedding: Tensor) -> tuple[Tensor, Tensor]:
        """The first layer's weights of the belief, and what it makes of embeddings ``[..., E]``: once for all steps."""
        first, seen = self.obs_rnn_to_post_projector[0], embedding.shape[-1]
        of_belief, of_embedding = first.weight.split([first.in_features - seen, seen], 1)
        return of_belief, linear(embedding, of_embedding, first.bias)

    def logits(self, belief: Tensor, of_belief: Tensor, seen: Tensor) -> Tensor:
        """Logits ``[..., N, C]`` of a step, from its belief ``[..., H]`` and what is prepared."""
        hidden = linear(belief, of_belief) + seen
        for layer in self.obs_rnn_to_post_projector[1:]:
            hidden = layer(hidden)
        return hidden.unflatten(-1, (self.num_categoricals, self.num_classes))


class BlockGRU(nn.Module):
    """TorchRL's block GRU with the same parameters, which does not copy its input for each block.

    Args:
        core: The block GRU whose parameters it has.

    Called with state ``[..., S]``, belief ``[..., H]`` and action ``[..., A]``; returns the next belief ``[..., H]``.
    Actions beyond [−1, 1] count as clipped.
    """

    gate_bias: Tensor

    def __init__(self, core: _DreamerV3BlockGRU) -> None:
        super().__init__()
        self.num_blocks = core.num_blocks
        self.belief_projection = core.belief_projection
        self.state_projection = core.state_projection
        self.action_projection = core.action_projection
        self.hidden_layers = core.hidden_layers
        self.gates = core.gates
        bias = torch.tensor([0.0, 0.0, UPDATE_BIAS], device=core.gates.bias.device)
        self.register_buffer("gate_bias", bias.repeat_interleave(core.belief_dim // core.num_blocks), persistent=False)

    def forward(self, state: Tensor, belief: Tensor, action: Tensor) -> Tensor:
        """The next belief."""
        weights, done = self.prepare(action)
        return self.advance(state, belief, weights, done)

    def prepare(self, action: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        """What does not depend on the step: weights in the shape that they need, features of actions ``[..., A]``."""
        first, gates = self.hidden_layers[0], self.gates
        units = first.weight.shape[-1]
        of_own, of_shared = first.weight.split([units, first.weight.shape[1] - units], 1)
        bias = gates.bias.view(self.num_blocks, 1, -1) + self.gate_bias
        return (of_own, of_shared.transpose(1, 2).flatten(0, 1), bias), self.action_projection(bounded(action))

    def advance(self, state: Tensor, belief: Tensor, weights: tuple[Tensor, ...], done: Tensor) -> Tensor:
        """The next belief, from what is prepared."""
        first, *others = self.hidden_layers
        blocks, (of_own, of_shared, bias) = self._blocks(belief), weights
        seen = torch.cat([self.belief_projection(belief), self.state_projection(state), done], -1)
        # A block sees its own part of the belief, and all see the same of everything: one product for all of them.
        hidden = torch.bmm(blocks, of_own).transpose(0, 1).reshape(belief.shape) + linear(seen, of_shared, first.bias)
        for layer in others:
            hidden = layer(hidden)
        reset, candidate, update = torch.baddbmm(bias, self._blocks(hidden), self.gates.weight).chunk(3, -1)
        candidate = (reset.sigmoid() * candidate).tanh()
        after = torch.lerp(blocks, candidate.to(blocks.dtype), update.sigmoid().to(blocks.dtype))
        return after.transpose(0, 1).reshape(belief.shape)

    def _blocks(self, features: Tensor) -> Tensor:
        """``[..., H]`` to ``[K, any, H / K]``."""
        return features.reshape(-1, self.num_blocks, features.shape[-1] // self.num_blocks).transpose(0, 1)


class Rollout(RSSMRolloutV3):
    """TorchRL's rollout of the RSSM with the head of the prior called once, for all steps."""

    rssm_prior: TensorDictModule
    rssm_posterior: TensorDictModule

    def _check_fast_path(self) -> bool:
        return True

    def _loop(
        self, state: Tensor, belief: Tensor, action: Tensor, embedding: Tensor, reset: Tensor
    ) -> tuple[Tensor, ...]:
        if self._step_fn is not None:  # compile_rollout("step")
            return super()._loop(state, belief, action, embedding, reset)
        prior, posterior = self.rssm_prior.module, self.rssm_posterior.module
        # Two draws for each step, as TorchRL does it, so that random numbers are those of its compiled rollouts.
        shape = (action.shape[-2], 2, *action.shape[:-2], prior.num_categoricals, 1)
        uniforms = torch.rand(shape, device=action.device)[:, 1].unbind(0)
        action = action.masked_fill(reset, 0)
        advance, done = prior.prepare(action)
        of_belief, seen = posterior.prepare(embedding)
        states, beliefs, logits, next_states, next_beliefs = [], [], [], [], []
        for act, embedded, first, uniform in zip(
            done.unbind(-2), seen.unbind(-2), reset.unbind(-2), uniforms, strict=True
        ):
            states.append(state.masked_fill(first, 0))
            beliefs.append(belief.masked_fill(first, 0))
            belief = advance(states[-1], beliefs[-1], act)
            logits.append(posterior.logits(belief, of_belief, embedded))
            state = sample(logits[-1], posterior.unimix, uniform)
            next_states.append(state)
            next_beliefs.append(belief)
        after = torch.stack(next_beliefs, -2)
        return (
            torch.stack(states, -2),
            torch.stack(beliefs, -2),
            action,
            prior.logits(after),
            torch.stack(logits, -3),
            torch.stack(next_states, -2),
            after,
        )
