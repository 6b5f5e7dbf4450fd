"""Losses in bfloat16: near those in float32 and faster, or refused with one line."""

import pytest
import torch

from tests.objectives.conftest import Parts, make_batch
from torchrl_h2o.objectives import total_loss
from torchrl_h2o.training import precision
from torchrl_h2o.training.precision import at_precision


@pytest.fixture
def bf16(monkeypatch):
    monkeypatch.setattr(precision, "has_bf16", lambda: True)  # slow processors compute the same


def losses(chosen, **kwargs):
    loss = Parts(dtype=torch.float32).h2o_plus(**kwargs)
    torch.manual_seed(0)
    terms = at_precision(loss, chosen)(make_batch(dtype=torch.float32))
    total_loss(terms).backward()
    return terms.detach(), [p.grad for p in loss.parameters() if p.grad is not None]


@pytest.mark.usefixtures("bf16")
def test_losses_in_bf16_are_near_those_in_float32_and_the_gradients_are_float32():
    terms, gradients = losses("bf16")
    expected, _ = losses("float32")
    assert all(gradient.dtype == torch.float32 for gradient in gradients)
    for name in ("loss_qvalue", "loss_value", "loss_actor", "loss_ratio_sa", "loss_ratio_sas"):
        assert terms[name].dtype == torch.float32
        assert terms[name] != expected[name]
        torch.testing.assert_close(terms[name], expected[name], rtol=0.03, atol=0.03)


def test_float32_changes_nothing():
    loss = Parts().h2o_plus()
    assert at_precision(loss, "float32") is loss


@pytest.mark.parametrize(
    ("chosen", "what", "available", "said"),
    [
        ("float16", Parts().h2o_plus(), True, "choose float32 or bf16"),
        ("bf16", lambda batch: {}, True, "method=rlpd"),
        ("bf16", Parts().h2o_plus(), False, "no bfloat16 instructions"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(chosen, what, available, said, monkeypatch):
    monkeypatch.setattr(precision, "has_bf16", lambda: available)
    with pytest.raises(ValueError, match=said) as refused:
        at_precision(what, chosen)
    assert "\n" not in str(refused.value)
