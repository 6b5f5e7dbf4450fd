"""PAR's latent dynamics: they are learnt in reality alone, and a dynamics gap makes transitions deviate from them."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from tests.objectives.conftest import ACTION_DIM, CELLS, OBSERVATION_DIM
from tests.objectives.test_reward_correction import two_streams
from torchrl_h2o.objectives import (
    DynamicsRewardCorrection,
    RepresentationDeviation,
    RepresentationLoss,
    make_representation_deviation,
)


def test_the_deviation_is_the_mean_square_of_the_predicted_minus_the_next_representation(parts, batch):
    encode, predict = parts.representation.encoder.module, parts.representation.predictor.module
    predicted = predict(encode(batch["observation"]), batch["action"])
    expected = (predicted - encode(batch["next", "observation"])).square().mean(-1)
    deviation = parts.representation(batch)["representation_deviation"]
    torch.testing.assert_close(deviation, expected.detach())
    assert not deviation.requires_grad


def test_a_representation_cannot_shrink_to_zero(parts, batch):
    representation = parts.representation.encoder(batch)["representation"]
    torch.testing.assert_close(representation.abs().mean(-1), torch.ones(7, dtype=torch.float64))


def test_real_rows_alone_train_and_next_states_are_constants(parts, batch):
    loss = RepresentationLoss(parts.representation)
    terms = loss(batch)
    deviation = parts.representation(batch)["representation_deviation"]
    torch.testing.assert_close(terms["loss_representation"].detach(), deviation[batch["real"]].mean())
    torch.testing.assert_close(terms["deviation_real"], deviation[batch["real"]].mean())
    torch.testing.assert_close(terms["deviation_sim"], deviation[~batch["real"]].mean())
    for key, is_read in ((("next", "observation"), False), ("observation", True)):
        given = batch.clone()
        given[key].requires_grad_()
        loss(given)["loss_representation"].backward()
        assert (given[key].grad is not None) == is_read
        if is_read:
            assert given[key].grad[batch["real"]].any()
            assert not given[key].grad[~batch["real"]].any()


def test_nested_entries_and_several_of_them_are_read(parts, batch):
    encoder = TensorDictModule(
        parts.representation.encoder.module, in_keys=[("agent", "obs")], out_keys=[("latent", "z")]
    )
    predictor = TensorDictModule(
        parts.representation.predictor.module, in_keys=[("latent", "z"), ("agent", "act")], out_keys=["predicted"]
    )
    renamed = TensorDict(
        agent=TensorDict(obs=batch["observation"], act=batch["action"], batch_size=7),
        next=TensorDict(agent=TensorDict(obs=batch["next", "observation"], batch_size=7), batch_size=7),
        batch_size=7,
    )
    deviation = RepresentationDeviation(encoder, predictor, out_keys=[("gap", "d")])
    expected = parts.representation(batch)["representation_deviation"]
    torch.testing.assert_close(deviation(renamed)["gap", "d"], expected)
    with pytest.raises(ValueError, match="not 'representation'"):
        RepresentationDeviation(parts.representation.encoder, predictor)
    with pytest.raises(ValueError, match="one for each"):
        RepresentationDeviation(encoder, predictor, next_keys=["a", "b"])


def test_a_wrong_size_is_named(batch):
    deviation = make_representation_deviation(OBSERVATION_DIM + 1, ACTION_DIM, CELLS).double()
    with pytest.raises(ValueError, match=r"'observation' \[7, 3\]"):
        deviation(batch)


@pytest.mark.slow
def test_the_deviation_of_simulated_transitions_grows_with_the_gap_and_is_that_of_real_ones_without():
    """PAR's premise: the deviation is a signal of dynamics mismatch, and its penalty lowers simulated rewards."""
    torch.manual_seed(0)
    deviation = make_representation_deviation(1, 1, (16, 16))
    loss = RepresentationLoss(deviation)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for _ in range(500):
        optimiser.zero_grad()
        loss(two_streams(gap=0.0))["loss_representation"].backward()
        optimiser.step()
    ratios = []
    for gap in (0.0, 0.5, 1.0, 2.0):
        steps = two_streams(gap, size=2000)
        terms = loss(steps)
        ratios.append((terms["deviation_sim"] / terms["deviation_real"]).item())
        corrected = DynamicsRewardCorrection(deviation, scale=-1.0)(steps)["next", "reward"].squeeze(-1)
        assert not corrected[steps["real"]].any()
        assert corrected[~steps["real"]].mean() < 0
    assert ratios[0] == pytest.approx(1.0, abs=0.3)
    assert sorted(ratios) == ratios
    assert ratios[-1] > 3.0
