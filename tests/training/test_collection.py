"""Collection by workers on one machine or several: weights are sent, transitions arrive, and all workers are closed."""

import multiprocessing
import shutil
from importlib.util import find_spec

import pytest
import torch

from torchrl_h2o.data.hybrid_replay import TRANSITION_KEYS
from torchrl_h2o.objectives import make_actor
from torchrl_h2o.options import TrainOptions, check_options
from torchrl_h2o.training.collection import collecting
from torchrl_h2o.training.environments import make_simulator
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods.h2o_plus import H2O_PLUS
from torchrl_h2o.training.progress import Training

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is an extra: pip install 'torchrl_h2o[ray]'")
WORKERS = ["multi_sync", pytest.param("ray", marks=needs_ray)]


@pytest.fixture
def compose(compose, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "local")  # ignores any cluster that this machine is or was part of
    return lambda *overrides: compose("updates=20", "updates_per_epoch=10", "keep=last", *overrides)


@pytest.fixture
def actor(compose):
    torch.manual_seed(0)
    return make_actor(4, make_simulator(compose()[0]).action_spec_unbatched, [8, 8])


def open_collector(cfg, actor):
    return collecting(cfg, make_simulator(cfg, 1), actor, TRANSITION_KEYS)


@pytest.mark.slow
@pytest.mark.parametrize("kind", WORKERS)
def test_training_on_with_workers_is_training_in_one_go(compose, tmp_path, kind, monkeypatch):
    cfg, real = compose(f"collector={kind}", "gap=joint_noise")
    evaluate, workers, threads = Training.evaluate, [], torch.get_num_threads()

    def stop_and_go_on(self, evaluator, policy, epoch, **metrics):
        workers.append(len(multiprocessing.active_children()))
        if epoch == 1:  # the files on disk are those that an interruption would leave
            shutil.copytree(self.directory, tmp_path / "parts")
        evaluate(self, evaluator, policy, epoch, **metrics)

    monkeypatch.setattr(Training, "evaluate", stop_and_go_on)
    _, whole = train(H2O_PLUS, cfg, real, tmp_path / "whole")
    monkeypatch.undo()
    _, parts = train(H2O_PLUS, cfg, real, tmp_path / "parts")
    assert parts.rows == whole.rows
    assert len(whole.rows) == 2
    if kind == "multi_sync":
        assert workers == [2, 2]
    assert not multiprocessing.active_children()
    assert torch.get_num_threads() == threads


@pytest.mark.slow
@needs_ray
def test_an_epoch_is_drawn_from_its_seed_and_the_weights_that_were_sent(compose, actor):
    import ray

    cfg, _ = compose("collector=ray", "gap=joint_noise", "updates=100")

    def draw(seed):
        collector.set_seed(seed)
        return next(rollouts)

    with pytest.raises(KeyboardInterrupt), open_collector(cfg, actor) as collector:  # noqa: PT012
        rollouts = iter(collector)
        collector.update_policy_weights_()
        first, other, again = draw(5), draw(6), draw(5)
        for parameter in actor.parameters():
            parameter.data.add_(0.5)
        not_sent = draw(5)
        collector.update_policy_weights_()
        sent = draw(5)

        too_many, _ = compose("collector=ray", "collector.workers=1000", "steps_per_epoch=1000")
        with (
            pytest.raises(RuntimeError, match="ask for fewer, or add machines"),
            open_collector(too_many, actor),
        ):
            pass
        raise KeyboardInterrupt
    assert first.shape == (2, 4, 5)  # workers, worlds, steps
    assert set(first.keys(True, True)) == set(TRANSITION_KEYS)
    assert (first == again).all()
    assert (first == not_sent).all()
    assert not torch.equal(first["action"], other["action"])
    assert not torch.equal(first["action"], sent["action"])
    assert not torch.equal(first["action"][0], first["action"][1])  # each worker has its own random stream
    assert not ray.is_initialized()


@pytest.mark.parametrize(("workers", "worlds"), [(3, 4), (4, 4), (4, 3)])
def test_workers_and_worlds_that_cannot_share_an_epoch_are_refused(compose, workers, worlds):
    with pytest.raises(ValueError, match=rf"workers={workers} num_worlds={worlds}.*steps_per_epoch=40"):
        check_options(
            compose("collector=multi_sync", f"collector.workers={workers}", f"num_worlds={worlds}")[0], TrainOptions
        )


def test_workers_and_worlds_that_can_share_an_epoch_are_taken(compose):
    check_options(compose("collector=multi_sync", "collector.workers=2", "num_worlds=4")[0], TrainOptions)


def test_steps_of_a_target_are_fewer_than_those_of_each_world_of_each_worker(compose):
    options = ("steps_per_epoch=400", "num_worlds=4", "n_steps=60")
    check_options(compose(*options)[0], TrainOptions)
    with pytest.raises(ValueError, match="n_steps=60: must be from 1 to 49"):
        check_options(compose("collector=multi_sync", "collector.workers=2", *options)[0], TrainOptions)


def test_ray_that_is_not_installed_is_named_with_what_to_do(compose, monkeypatch):
    monkeypatch.setattr("torchrl_h2o.options.train.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'torchrl_h2o\[ray\]'"):
        check_options(compose("collector=ray")[0], TrainOptions)
