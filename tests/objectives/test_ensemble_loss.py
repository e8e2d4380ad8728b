"""The loss that trains an ensemble, record by record."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.modules import OneStepEnsemble
from torchrl_ocwm.objectives import EnsembleLoss


@pytest.fixture
def seen() -> TensorDict:
    """``[2, 4]`` records; an episode starts inside the first sequence."""
    is_init = torch.tensor([[1, 0, 1, 0], [1, 0, 0, 0]], dtype=torch.bool).unsqueeze(-1)
    after = {"state": torch.randn(2, 4, 2), "belief": torch.randn(2, 4, 3), "encoded_latents": torch.randn(2, 4, 5)}
    records = TensorDict({"action": torch.rand(2, 4, 1), "is_init": is_init, "next": after}, [2, 4])
    return TensorDict({"records": records})


def make_loss(out: int = 5) -> EnsembleLoss:
    return EnsembleLoss(OneStepEnsemble(6, out, members=3, layers=1, units=4))


@pytest.mark.parametrize(("target", "out"), [("encoded_latents", 5), ("state", 2)])
def test_what_follows_the_step_before(seen: TensorDict, target: str, out: int) -> None:
    loss, errors = make_loss(out), []
    loss.set_keys(target=target)
    records = seen["records"]
    for sequence, time in [(0, 1), (0, 3), (1, 1), (1, 2), (1, 3)]:  # not the first of an episode
        before = records["next"][sequence, time - 1]
        predicted = loss.ensemble(before["state"], before["belief"], records["action"][sequence, time])
        errors += [(one - records["next", target][sequence, time]).square().mean() for one in predicted]
    torch.testing.assert_close(loss(seen)["loss_ensemble"], torch.stack(errors).mean())


def test_it_trains_the_ensemble_alone(seen: TensorDict) -> None:
    loss = make_loss()
    for key in ("state", "belief", "encoded_latents"):
        seen["records", "next", key].requires_grad_()
    loss(seen)["loss_ensemble"].backward()
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in loss.parameters())
    assert all(seen["records", "next", key].grad is None for key in ("state", "belief", "encoded_latents"))


def test_keys(seen: TensorDict) -> None:
    """What it says that it reads is enough, and each has a name that can be set."""
    loss = make_loss()
    expected = loss(seen)
    torch.testing.assert_close(loss(seen.select(*loss.in_keys))["loss_ensemble"], expected["loss_ensemble"])
    assert list(expected.keys()) == loss.out_keys
    moved: dict[str, Any] = {"action": ("my", "action"), "is_init": "first"}
    records = seen["records"].rename_key_("action", ("my", "action")).rename_key_("is_init", "first")
    for name in ("state", "belief", "encoded_latents"):
        records.rename_key_(("next", name), ("next", "my", name))
        moved[{"encoded_latents": "target"}.get(name, name)] = ("my", name)
    loss.set_keys(**moved)
    torch.testing.assert_close(loss(seen)["loss_ensemble"], expected["loss_ensemble"])


def test_only_first_records_give_nothing(seen: TensorDict) -> None:
    seen["records", "is_init"] = torch.ones(2, 4, 1, dtype=torch.bool)
    assert make_loss()(seen)["loss_ensemble"] == 0
