"""TorchRL's conventions for losses: keys, dispatch, reductions, copies, dtypes and compilation."""

import copy
import pickle
import subprocess
import sys

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator

from tests.objectives.conftest import ACTION_DIM, CELLS, OBSERVATION_DIM, Parts, make_batch
from torchrl_h2o.objectives import (
    DynamicsModelLoss,
    DynamicsRatioLoss,
    ExpectileValueLoss,
    ExponentialValueLoss,
    H2OPlusLoss,
    MixedBellmanLoss,
    RepresentationLoss,
    make_actor,
)

LOSSES = {
    "expectile": lambda parts: ExpectileValueLoss(parts.value),
    "exponential": lambda parts: ExponentialValueLoss(parts.value),
    "ratio": lambda parts: DynamicsRatioLoss(parts.estimator, input_noise=None),
    "delayed_ratio": lambda parts: DynamicsRatioLoss(parts.estimator, input_noise=None, delay_estimator=True),
    "bellman": lambda parts: parts.bellman(),
    "h2o_plus": lambda parts: parts.h2o_plus(),
    "h2o_plus_delayed_ratio": lambda parts: parts.h2o_plus(delay_estimator=True),
    "without_value": lambda parts: parts.sac(),
    "cloning": lambda parts: parts.sac(cloning=5.0),
    "representation": lambda parts: RepresentationLoss(parts.representation),
    "dynamics": lambda parts: DynamicsModelLoss(parts.models),
}
losses = pytest.mark.parametrize("name", LOSSES)


def make(name, dtype=torch.float64):
    return LOSSES[name](Parts(dtype=dtype)).eval()


def full_batch(dtype=torch.float64, **kwargs):
    batch = make_batch(dtype=dtype, **kwargs)
    return batch.set("state_action_value", torch.linspace(-1, 1, batch.shape[0], dtype=dtype)[:, None])


def evaluate(loss, batch):
    torch.manual_seed(11)
    return loss(batch)


@losses
def test_dispatch_with_plain_tensors_gives_the_same(name):
    loss, batch = make(name), full_batch()
    expected = evaluate(loss, batch.copy())
    tensors = {"_".join(k) if isinstance(k, tuple) else k: batch[k] for k in loss.in_keys}
    torch.manual_seed(11)
    got = loss(**tensors)
    got = got if isinstance(got, tuple) else (got,)
    for key, value in zip(loss.out_keys, got, strict=True):
        torch.testing.assert_close(value, expected[key])


@losses
def test_selected_out_keys_alone_are_returned_by_dispatch(name):
    loss, batch = make(name), full_batch()
    key = loss.out_keys[0]
    loss.select_out_keys(key)
    tensors = {"_".join(k) if isinstance(k, tuple) else k: batch[k] for k in loss.in_keys}
    assert isinstance(loss(**tensors), torch.Tensor)


@losses
def test_written_keys_are_the_out_keys(name):
    loss = make(name)
    assert set(loss(full_batch()).keys()) == set(loss.out_keys)


@losses
@pytest.mark.parametrize("reduction", ["sum", "none"])
def test_reductions_agree(name, reduction):
    batch = full_batch()
    mean, other = make(name), make(name)
    for module in other.modules():
        if hasattr(module, "reduction"):
            module.reduction = reduction
    terms, expected = evaluate(other, batch.copy()), evaluate(mean, batch.copy())
    for key in (k for k in expected.keys() if k.startswith("loss_")):
        if reduction == "none":
            assert terms[key].shape == batch.shape
            real, sim = terms[key][batch["real"]], terms[key][~batch["real"]]
            total = real.mean() + sim.mean()
            both = total / 2 if key in ("loss_actor", "loss_alpha") else total
            torch.testing.assert_close(both, expected[key])
        else:
            for module in other.modules():
                if hasattr(module, "reduction"):
                    module.reduction = "none"
            torch.testing.assert_close(terms[key], evaluate(other, batch.copy())[key].sum())
            for module in other.modules():
                if hasattr(module, "reduction"):
                    module.reduction = "sum"


@losses
def test_state_dict_round_trip_gives_the_same_numbers(name):
    loss, batch = make(name), full_batch()
    other = LOSSES[name](Parts(seed=1)).eval()
    before = evaluate(other, batch.copy())
    other.load_state_dict(loss.state_dict())
    torch.testing.assert_close(evaluate(other, batch.copy()), evaluate(loss, batch.copy()))
    key = next(iter(loss.out_keys))
    assert before[key] != evaluate(loss, batch.copy())[key]


@losses
@pytest.mark.parametrize("clone", [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))])
def test_copies_are_equal_and_independent(name, clone):
    loss, batch = make(name), full_batch()
    other = clone(loss)
    expected = evaluate(loss, batch.copy())
    torch.testing.assert_close(evaluate(other, batch.copy()), expected)
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(1.0)
    torch.testing.assert_close(evaluate(other, batch.copy()), expected)
    assert len(list(other.parameters())) == len(list(loss.parameters()))


@losses
def test_conversion_to_float64_converts_everything(name):
    loss = make(name, dtype=torch.float32).double()
    assert all(value.dtype == torch.float64 for value in loss(full_batch()).values())


@pytest.mark.slow
@losses
def test_compiled_fullgraph_equals_eager(name):
    loss, batch = make(name), full_batch()
    torch._dynamo.reset()
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    expected, got = evaluate(loss, batch.copy()), evaluate(compiled, batch.copy())
    torch.testing.assert_close(got, expected)
    gradients = []
    for losses in (expected, got):
        loss.zero_grad()
        sum(losses[k] for k in loss.out_keys if k.startswith("loss_")).backward()
        gradients.append([p.grad.clone() for p in loss.parameters() if p.grad is not None])
    torch.testing.assert_close(*gradients)


RENAMED = {"real": ("marks", "real"), "state_action_value": ("critic", "q"), "value": ("critic", "v")}


def test_renamed_and_nested_keys_of_the_value_loss():
    batch = full_batch()
    plain = ExpectileValueLoss(Parts().value)
    network = ValueOperator(Parts().value.module, in_keys=[("agent", "obs")], out_keys=[("critic", "v")])
    loss = ExpectileValueLoss(network)
    loss.set_keys(**RENAMED)
    renamed = TensorDict(
        agent=TensorDict(obs=batch["observation"], batch_size=7),
        critic=TensorDict(q=batch["state_action_value"], batch_size=7),
        marks=TensorDict(real=batch["real"], batch_size=7),
        batch_size=7,
    )
    torch.testing.assert_close(loss(renamed), plain(batch))
    assert ("agent", "obs") in loss.in_keys
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(reward="r")


def test_renamed_and_nested_keys_of_h2o_plus_reach_its_parts():
    batch = full_batch()
    plain = Parts().h2o_plus().eval()
    loss = Parts().h2o_plus().eval()
    loss.set_keys(real=("marks", "real"), reward=("pay", "r"), terminated="over", priority=("p", "td"))
    renamed = batch.exclude("real", ("next", "reward"), ("next", "terminated"))
    renamed["marks", "real"] = batch["real"]
    renamed["next", "pay", "r"] = batch["next", "reward"]
    renamed["next", "over"] = batch["next", "terminated"]
    torch.testing.assert_close(evaluate(loss, renamed), evaluate(plain, batch))
    assert ("p", "td") in renamed.keys(True)
    assert loss.ratio_loss.tensor_keys.real == ("marks", "real")


def test_nested_action_and_observation_keys_are_taken_from_the_networks():
    parts, batch = Parts(), full_batch()
    agent = {"in_keys": [("agent", "obs")]}
    action_spec = Composite(agent=Composite(act=parts.actor.spec["action"]))
    actor = ProbabilisticActor(
        TensorDictModule(parts.actor[0].module, out_keys=["loc", "scale"], **agent),
        in_keys=["loc", "scale"],
        out_keys=[("agent", "act")],
        spec=action_spec,
        distribution_class=TanhNormal,
    )
    keys = {"in_keys": [("agent", "obs"), ("agent", "act")], "out_keys": ["state_action_value"]}
    qvalues = [ValueOperator(q.module, **keys) for q in parts.qvalues]
    value_loss = ExpectileValueLoss(ValueOperator(parts.value.module, **agent))
    bellman_loss = MixedBellmanLoss(actor, qvalues, value_loss.value_network)
    loss = H2OPlusLoss(bellman_loss, value_loss, fixed_alpha=True)
    assert loss.target_entropy == -ACTION_DIM
    parts = Parts()
    bellman_loss = MixedBellmanLoss(parts.actor, parts.qvalues, parts.value)
    plain = H2OPlusLoss(bellman_loss, ExpectileValueLoss(parts.value), fixed_alpha=True)
    renamed = batch.exclude("observation", "action", ("next", "observation"))
    renamed["agent", "obs"], renamed["agent", "act"] = batch["observation"], batch["action"]
    renamed["next", "agent", "obs"] = batch["next", "observation"]
    torch.testing.assert_close(evaluate(loss, renamed), evaluate(plain, batch))


def test_what_may_be_there_is_dispatched_too():
    loss, batch = make("bellman"), full_batch()
    batch["dynamics_ratio"] = torch.linspace(0.1, 1.0, 7, dtype=torch.float64)
    batch["priority_weight"] = torch.linspace(1.0, 0.2, 7, dtype=torch.float64)
    batch["steps_to_next_obs"] = torch.arange(1, 8)[:, None]
    tensors = {"_".join(k) if isinstance(k, tuple) else k: batch[k] for k in loss._dispatch_keys}
    torch.manual_seed(11)
    torch.testing.assert_close(loss(**tensors), evaluate(loss, batch)["loss_qvalue"])


def test_a_mask_of_the_whole_reaches_its_parts():
    loss, batch = make("h2o_plus"), full_batch()
    loss.loss_mask_key = "valid"
    kept = torch.arange(7) != 5
    masked = evaluate(loss, batch.copy().set("valid", kept))
    alone = evaluate(loss, batch[kept])
    for key in ("loss_value", "loss_ratio_sa", "loss_ratio_sas"):
        torch.testing.assert_close(masked[key], alone[key])


def test_parts_that_reduce_differently_are_refused():
    with pytest.raises(ValueError, match="build both alike"):
        Parts().h2o_plus(reduction="none")


def test_an_entry_that_is_missing_is_named():
    with pytest.raises(KeyError, match=r"reads \('next', 'reward'\).*set_keys"):
        make("bellman")(full_batch().exclude(("next", "reward")))


def test_more_batch_dimensions_give_the_same():
    batch = full_batch(num_real=4, num_sim=4)
    loss = ExponentialValueLoss(Parts().value)
    torch.testing.assert_close(loss(batch.reshape(4, 2))["loss_value"], loss(batch)["loss_value"])
    bellman = make("bellman")  # the policy's noise is drawn in the same order in both
    torch.testing.assert_close(evaluate(bellman, batch.reshape(4, 2)), evaluate(bellman, batch))


def test_one_q_network_is_expanded_to_an_ensemble():
    parts = Parts()
    loss = MixedBellmanLoss(parts.actor, parts.qvalues[0], parts.value, num_qvalue_nets=5)
    assert loss.qvalue_network_params.shape == (5,)


def test_mixing_can_be_scheduled_in_place():
    loss = make("h2o_plus")
    loss.mixing = 0.7
    assert loss.state_dict()["bellman_loss.mixing"] == pytest.approx(0.7)


def test_actions_fill_the_bounds_of_their_spec_and_no_more():
    actor = make_actor(OBSERVATION_DIM, Bounded(-3, 3, (ACTION_DIM,)), CELLS)
    with torch.no_grad():
        actor.module[0].module[0][-1].weight.mul_(1e6)
        _, _, action = actor(observation=torch.randn(1000, OBSERVATION_DIM))
    assert 2.99 < action.abs().max() <= 3


def test_the_policy_starts_as_the_authors_and_stays_finite():
    torch.manual_seed(0)
    actor = make_actor(OBSERVATION_DIM, Bounded(-1, 1, (ACTION_DIM,)))
    loc, scale, _ = actor(observation=torch.randn(100, OBSERVATION_DIM))
    assert loc.abs().max() < 0.1
    torch.testing.assert_close(scale, torch.full_like(scale, -1.0).exp(), rtol=0.1, atol=0.0)
    with torch.no_grad():
        actor.module[0].module[0][-1].bias.fill_(1e6)
    assert actor(observation=torch.randn(2, OBSERVATION_DIM))[1].max().item() == pytest.approx(2.718281828**2)
    with pytest.raises(ValueError, match="bounded"):
        make_actor(OBSERVATION_DIM, Unbounded((ACTION_DIM,)))


@pytest.mark.slow
def test_objectives_import_without_mujoco():
    code = (
        "import sys\n"
        "for name in ('mujoco', 'gymnasium', 'dm_control', 'minari', 'h5py', 'hydra'):\n"
        "    sys.modules[name] = None\n"
        "import torchrl_h2o, torchrl_h2o.objectives\n"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)
