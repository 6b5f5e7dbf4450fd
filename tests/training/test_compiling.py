"""Compiled losses: same values, used where they are faster and available."""

import shutil
import signal

import pytest
import torch
from torch._dynamo.exc import TorchDynamoException
from torch._inductor.utils import fresh_cache
from torchrl.data import Bounded

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import total_loss
from torchrl_h2o.training.compiling import PAYS_FROM, OneGraph, compiled, maybe_compiled
from torchrl_h2o.training.methods import h2o, h2o_plus, par, vgdf, weighted_td3


def learner_of(cfg, real, make_learner=h2o_plus.make_learner):
    replay = HybridReplayBuffer(real, sim_capacity=len(real), batch_size=cfg.batch_size)
    replay.extend(real)
    return make_learner(cfg, 4, Bounded(-1.0, 1.0, (1,)), replay)


def updated(learner, updates=4):
    """Returns the parameters after some updates."""
    torch.manual_seed(0)
    for _ in range(updates):
        learner.update()
    return {
        f"{part}.{name}": parameter.detach().clone()
        for part, loss in learner.losses.items()
        for name, parameter in loss.named_parameters()
    }


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="compiling needs a C++ compiler")
def test_compiled_updates_are_the_updates_of_losses_as_they_are(compose):
    cfg, real = compose("compiled=true")
    expected = updated(learner_of(cfg, real))
    learner = learner_of(cfg, real)
    torch._dynamo.reset()
    counters = torch._dynamo.utils.counters
    counters.clear()
    learner.terms_of = maybe_compiled(learner.terms_of, cfg.compiled, cfg.updates, parameters=learner.parameters)
    torch.testing.assert_close(updated(learner), expected, rtol=1e-4, atol=1e-6)
    assert counters["stats"]["unique_graphs"] == 1  # no graph break and no recompilation
    assert not counters["graph_break"]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="compiling needs a C++ compiler")
@pytest.mark.parametrize("method", [h2o, weighted_td3, par, vgdf], ids=["h2o", "weighted_td3", "par", "vgdf"])
def test_terms_of_several_losses_are_compiled_with_their_gradients(compose, method):
    cfg, real = compose("compiled=true", config="train")
    expected = updated(learner_of(cfg, real, method.make_learner))
    learner = learner_of(cfg, real, method.make_learner)
    torch._dynamo.reset()
    counters = torch._dynamo.utils.counters
    counters.clear()
    learner.terms_of = maybe_compiled(learner.terms_of, cfg.compiled, cfg.updates, parameters=learner.parameters)
    torch.testing.assert_close(updated(learner), expected, rtol=1e-4, atol=1e-5)
    assert not counters["graph_break"]


@torch.compiler.set_stance("force_eager")  # without a compiler
def test_known_gradients_are_those_of_the_sum():
    weight, bias = torch.nn.Parameter(torch.tensor([2.0, 1.0])), torch.nn.Parameter(torch.tensor(0.5))
    unused = torch.nn.Parameter(torch.tensor(1.0))

    def losses_of(batch):
        return {"loss_1": (weight * batch).sum(), "mean": batch.mean() * bias, "loss_2": bias**3}

    known = OneGraph(losses_of, [weight, bias, unused])
    batch = torch.tensor([3.0, 4.0])
    terms = known(batch)
    assert terms["mean"] == 1.75
    assert not terms["mean"].requires_grad
    (0.5 * total_loss(terms)).backward()
    torch.testing.assert_close(weight.grad, 0.5 * batch)
    torch.testing.assert_close(bias.grad, torch.tensor(0.5 * 3 * 0.25))
    assert unused.grad is None
    terms = known(batch)
    with pytest.raises(ValueError, match="differentiated as their sum"):
        (terms["loss_1"] + 2.0 * terms["loss_2"]).backward()


@torch.compiler.set_stance("force_eager")
def test_known_gradients_are_added_once():
    weight = torch.nn.Parameter(torch.tensor(2.0))
    loss = total_loss(OneGraph(lambda batch: {"loss_1": weight * batch}, [weight])(torch.tensor(3.0)))
    loss.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match=r"differentiated a second time.*compute the losses again"):
        loss.backward()
    assert weight.grad == 3.0


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="compiling needs a C++ compiler")
def test_what_one_start_compiles_the_next_one_finds():
    counters = torch._dynamo.utils.counters
    x = torch.randn(4, 4, requires_grad=True)
    found = []
    with fresh_cache():
        for _ in range(2):
            torch._dynamo.reset()  # a new process has no compiled functions
            counters.clear()
            total_loss(compiled(lambda x: {"loss_relu": x.relu().square().sum()}, [x])(x)).backward()
            found.append(counters["aot_autograd"]["autograd_cache_hit"])
    assert found == [0, 1]


@pytest.fixture
def no_compiler():
    torch._dynamo.reset()
    with torch._inductor.config.patch({"cpp.cxx": ("no-such-compiler",), "force_disable_caches": True}):
        yield


@pytest.mark.slow
@pytest.mark.usefixtures("no_compiler")
def test_a_machine_that_cannot_compile_says_so_and_trains_all_the_same(compose, capsys):
    cfg, real = compose("compiled=auto", f"updates={PAYS_FROM}")
    expected = updated(learner_of(cfg, real))
    learner = learner_of(cfg, real)
    learner.terms_of = maybe_compiled(learner.terms_of, cfg.compiled, cfg.updates, parameters=learner.parameters)
    torch.testing.assert_close(updated(learner), expected, rtol=0.0, atol=0.0)
    assert capsys.readouterr().out.count("cannot be compiled here") == 1


@pytest.mark.slow
@pytest.mark.usefixtures("no_compiler")
def test_where_compiled_losses_are_asked_for_it_is_an_error_that_there_can_be_none(compose):
    cfg, real = compose("compiled=true")
    learner = learner_of(cfg, real)
    learner.terms_of = maybe_compiled(learner.terms_of, cfg.compiled, cfg.updates, parameters=learner.parameters)
    with pytest.raises(RuntimeError, match="compiler"):
        learner.update()


@pytest.mark.parametrize(
    ("chosen", "updates", "pays", "compiles"),
    [
        ("auto", PAYS_FROM, True, True),
        ("auto", PAYS_FROM - 1, True, False),
        ("auto", PAYS_FROM, False, False),
        (True, 1, False, True),
        (False, PAYS_FROM, True, False),
    ],
)
def test_losses_are_compiled_where_it_pays_or_is_asked_for(chosen, updates, pays, compiles):
    def losses_of(batch):
        return batch

    assert (maybe_compiled(losses_of, chosen, updates, pays=pays) is not losses_of) == compiles


@torch.compiler.set_stance("force_eager")  # without a compiler
@pytest.mark.parametrize("error", [RuntimeError("g++ failed"), TorchDynamoException("g++ failed"), None], ids=repr)
def test_ctrl_c_during_compilation_ends_the_training(error):
    calls = []

    def losses_of(batch):
        calls.append(batch)
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            if error is not None:
                raise error from None
        return {"loss": batch}

    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt) as raised:
        maybe_compiled(losses_of, "auto", PAYS_FROM)(torch.ones(1))
    assert raised.value.__cause__ is error
    assert len(calls) == 1  # no second try without the compiler
    assert signal.getsignal(signal.SIGINT) is handler
