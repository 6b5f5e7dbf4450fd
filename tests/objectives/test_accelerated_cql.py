"""The accelerated CQL loss draws the same random numbers as TorchRL's, and has the same losses and gradients."""

import pytest
import torch
from torchrl.data import Bounded
from torchrl.objectives import CQLLoss

from tests.objectives.conftest import ACTION_DIM, CELLS, OBSERVATION_DIM, make_batch
from torchrl_h2o.objectives import AcceleratedCQLLoss, accelerated_cql, make_actor, make_qvalue


def losses_and_gradients(loss_class, layer_norm=False, **kwargs):
    torch.manual_seed(0)
    actor = make_actor(OBSERVATION_DIM, Bounded(-1, 1, (ACTION_DIM,)), CELLS)
    qvalues = [make_qvalue(OBSERVATION_DIM, ACTION_DIM, CELLS, layer_norm=layer_norm) for _ in range(2)]
    loss = loss_class(actor, qvalues, loss_function="l2", **kwargs)
    loss.make_value_estimator(gamma=0.99)
    loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
    terms = loss(make_batch(5, 4, dtype=torch.float32))
    sum(terms[key].sum() for key in terms.keys() if key.startswith("loss_")).backward()
    found = {name: p.grad for name, p in loss.named_parameters() if p.grad is not None}
    return {**terms.detach(), "next random number": torch.rand(())}, found


@pytest.mark.parametrize("rows", [20, 1024])
@pytest.mark.parametrize(
    "kwargs",
    [{}, {"temperature": 2.0, "num_random": 3, "min_q_weight": 5.0}, {"layer_norm": True}, {"with_lagrange": True}],
    ids=str,
)
def test_losses_gradients_and_random_numbers_are_torchrl_s(kwargs, rows, monkeypatch):
    monkeypatch.setattr(accelerated_cql, "ROWS", rows)
    terms, gradients = losses_and_gradients(AcceleratedCQLLoss, **kwargs)
    expected_terms, expected_gradients = losses_and_gradients(CQLLoss, **kwargs)
    torch.testing.assert_close(terms, expected_terms, rtol=1e-5, atol=1e-6)
    assert gradients.keys() == expected_gradients.keys()
    torch.testing.assert_close(gradients, expected_gradients, rtol=1e-4, atol=1e-6)
