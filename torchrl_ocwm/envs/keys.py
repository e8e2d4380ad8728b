"""What a transform reads, or a message that names what is missing."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor


def read(reader: object, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """The value of a key.

    Raises:
        KeyError: naming who wanted it, and what there is.
    """
    value = tensordict.get(key, None)
    if value is None:
        there = sorted(map(str, tensordict.keys(True, True)))
        raise KeyError(f"{type(reader).__name__} found no {key!r} among {there}")
    return value
