"""What a world model believes, for people to look at: images, masks and positions of one latent."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_ocwm.evaluation import decode_video
from torchrl_ocwm.evaluation.objects import decode_objects
from torchrl_ocwm.modules import ObjectWorldModel, RSSMWorldModel


def decoded_pixels(model: RSSMWorldModel | None, latent: TensorDictBase | None) -> np.ndarray | None:
    """The image ``[H, W, 3]`` uint8 of a latent ``[1]``; ``None`` without one."""
    if model is None or latent is None:
        return None
    return decode_video(model, latent.unsqueeze(1))[0, 0].permute(1, 2, 0).numpy()


@torch.no_grad()
def decoded_masks(model: RSSMWorldModel | None, latent: TensorDictBase | None) -> np.ndarray | None:
    """The masks ``[O, H, W]`` of the objects in a latent ``[1]``; ``None`` from a model that has none."""
    if not isinstance(model, ObjectWorldModel) or latent is None:
        return None
    return decode_objects(model, latent)[1][0, :-1].numpy()


@torch.no_grad()
def decoded_position(model: RSSMWorldModel, latent: TensorDictBase | None, object_index: int) -> np.ndarray | None:
    """Where an object is in a latent ``[1]``, (D,) metres from the start; ``None`` from a model that does not say."""
    if latent is None or "object_position" not in model.observed:
        return None
    decoded = model.object_position()(TensorDict({"latent": latent.select("state", "belief")}, [1]))["object_units"]
    return model.units.to_metres(decoded.unflatten(-1, (-1, model.units.dim)))[0, object_index].numpy()
