"""The latent state at the start of a sequence, and of images without one."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import RSSMPosteriorV3, RSSMPriorV3

from torchrl_ocwm.modules.observation import ObservationEncoder


class InitialLatent(TensorDictModuleBase):
    """Write the zero state and belief that a sequence starts from, unless they are there already.

    Args:
        state: Features of the stochastic state S.
        belief: Features of the deterministic state H.
        like: Key of an entry whose batch shape and device are taken.
        state_key: Key written, ``[*batch, S]`` float32.
        belief_key: Key written, ``[*batch, H]`` float32.

    Examples:
        >>> from tensordict import TensorDict
        >>> InitialLatent(4, 3)(TensorDict({"action": torch.ones(2, 5, 1)}, [2, 5]))["state"].shape
        torch.Size([2, 5, 4])
    """

    def __init__(
        self,
        state: int,
        belief: int,
        *,
        like: NestedKey = "action",
        state_key: NestedKey = "state",
        belief_key: NestedKey = "belief",
    ) -> None:
        super().__init__()
        self.sizes = {state_key: state, belief_key: belief}
        self.in_keys, self.out_keys = [like], [state_key, belief_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write zeros where there is no latent yet."""
        device = tensordict.get(self.in_keys[0]).device
        for key, size in self.sizes.items():
            if tensordict.get(key, None) is None:
                tensordict.set(key, torch.zeros(1, device=device).expand(*tensordict.batch_size, size))
        return tensordict


class LatentOfImages(nn.Module):
    """The latent state after images that are all there is: no vectors, no actions (paper, "Visual targets").

    It starts from zero and takes in one image after the other, each after an action of zero, so that a single image is
    seen as the first frame of an episode.

    Args:
        prior: Advances the belief.
        posterior: Samples the state.
        state: Features of the stochastic state S.
        belief: Features of the deterministic state H.
        action: Number of actions A.

    Called with embeddings ``[..., F, E]`` of F images; returns state ``[..., S]`` and belief ``[..., H]``.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import reacher_task
        >>> model = build_agent("focus_lcp", reacher_task(), size="debug").model
        >>> state, belief = model.latent_of_images()(torch.zeros(3, 2, model.encoder.features))
        >>> state.shape, belief.shape
        (torch.Size([3, 16]), torch.Size([3, 16]))
    """

    def __init__(self, prior: RSSMPriorV3, posterior: RSSMPosteriorV3, *, state: int, belief: int, action: int) -> None:
        super().__init__()
        self.prior, self.posterior = prior, posterior
        self.sizes = (state, belief, action)

    def forward(self, embeddings: Tensor) -> tuple[Tensor, Tensor]:
        """State and belief after the last image."""
        shape = embeddings.shape[:-2]
        embeddings = embeddings.reshape(-1, *embeddings.shape[-2:])  # a GRU takes one batch dimension
        state, belief, action = (embeddings.new_zeros(len(embeddings), size) for size in self.sizes)
        for embedding in embeddings.unbind(-2):
            belief = self.prior._update_belief(state, belief, action)
            _, state = self.posterior(belief, embedding)
        return state.float().reshape(*shape, -1), belief.float().reshape(*shape, -1)


class LatentsInImages(nn.Module):
    """Latents of images that are all there is: encoder and posterior, then extractor (paper, "Visual targets").

    Args:
        encoder: Embeds the images, without vectors.
        latent: Takes the embeddings in, one after the other.
        extractor: Makes of state and belief what is asked for: object latents, or both as one (:class:`FullLatent`).

    Called with images ``[..., F, 3, H, W]`` uint8; returns what the extractor does, such as ``[..., O + 1, L]``.
    """

    def __init__(self, encoder: ObservationEncoder, latent: LatentOfImages, extractor: nn.Module) -> None:
        super().__init__()
        self.encoder, self.latent, self.extractor = encoder, latent, extractor

    def forward(self, pixels: Tensor) -> Tensor:
        """What the extractor makes of state and belief after the last image."""
        return self.extractor(*self.latent(self.encoder(pixels)))


class LatentsInEmbedding(nn.Module):
    """Latents of single images, from the embeddings of images and vectors.

    Args:
        images: What makes latents of images.

    Called with embeddings ``[..., E]``; returns what ``images`` does.
    """

    def __init__(self, images: LatentsInImages) -> None:
        super().__init__()
        self.images = images

    def forward(self, embedding: Tensor) -> Tensor:
        """What the extractor makes of each image alone."""
        alone = self.images.encoder.image_alone(embedding)
        return self.images.extractor(*self.images.latent(alone.unsqueeze(-2)))


class FullLatent(nn.Module):
    """State ``[..., S]`` and belief ``[..., H]`` as one vector ``[..., S + H]`` float32."""

    def forward(self, state: Tensor, belief: Tensor) -> Tensor:
        """Concatenate the two."""
        return torch.cat([state.float(), belief.float()], -1)
