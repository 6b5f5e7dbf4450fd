"""HybridReplayBuffer: shares of both streams, marks, seeds, capacity, and exact resumption."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.data.recordings import assert_same, make_recording
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.data.hybrid_replay import TRANSITION_KEYS
from torchrl_h2o.data.transition_checks import UnstableSimulatorError


def stream(steps, offset=0.0, seed=0):
    """Returns transitions whose observation, action and reward identify their row."""
    td = make_recording((steps,), (False,), seed=seed)
    ids = torch.arange(steps, dtype=torch.float32)[:, None] + offset
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        td[key] = ids.expand_as(td[key]).clone()
    return td


def make_buffer(real=20, capacity=50, sim=30, **kwargs):
    buffer = HybridReplayBuffer(stream(real), capacity, (8, 5), **kwargs)
    if sim:
        buffer.extend(stream(sim, offset=1000))
    return buffer


@settings(max_examples=12, deadline=None)
@given(n_real=st.integers(0, 40), n_sim=st.integers(0, 40), seed=st.integers(0, 99))
def test_rows_are_whole_and_marked_by_their_stream(n_real, n_sim, seed):
    if n_real + n_sim == 0:
        return
    torch.manual_seed(seed)
    batch = make_buffer().sample((n_real, n_sim))
    assert batch.batch_size == batch["real"].shape == (n_real + n_sim,)
    assert batch["real"].dtype == torch.bool
    assert batch["real"].sum() == n_real
    ids = batch["next", "reward"].flatten()
    assert torch.equal(ids < 1000, batch["real"])
    for key in ("observation", "action", ("next", "observation")):
        assert (batch[key] == ids[:, None]).all()


def test_every_row_of_both_streams_is_drawn_about_equally_often():
    torch.manual_seed(0)
    batch = make_buffer(real=4, sim=5).sample((4000, 5000))
    _, counts = batch["next", "reward"].flatten().unique(return_counts=True)
    assert len(counts) == 9
    assert (counts - 1000).abs().max() < 5 * 1000**0.5


def test_batch_holds_the_chosen_entries_and_nothing_else():
    assert set(make_buffer().sample().keys(True, True)) == {*TRANSITION_KEYS, "real"}
    buffer = make_buffer(keys=["observation", ("next", "truncated")])
    assert set(buffer.sample().keys(True, True)) == {"observation", ("next", "truncated"), "real"}


def test_batch_is_a_copy():
    buffer = make_buffer()
    buffer.sample()["observation"].fill_(-1)
    assert (buffer.sample((200, 200))["observation"] >= 0).all()


def test_real_rows_alone_before_anything_is_simulated():
    buffer = make_buffer(sim=0)
    assert buffer.sample((6, 0))["real"].all()
    with pytest.raises(RuntimeError, match=r"no simulated transitions yet.*sample\(\(13, 0\)\)"):
        buffer.sample()


def test_oldest_simulated_rows_go_and_real_rows_stay():
    buffer = make_buffer(capacity=10, sim=0)
    for start in range(0, 24, 4):
        buffer.extend(stream(4, offset=1000 + start))
    assert len(buffer) == 30
    batch = buffer.sample((500, 500))
    simulated = batch["next", "reward"][~batch["real"]].unique().tolist()
    assert simulated == list(range(1014, 1024))
    assert len(batch["next", "reward"][batch["real"]].unique()) == 20


def test_rows_added_are_drawn_at_once():
    buffer = make_buffer(sim=1)
    buffer.extend(stream(1, offset=7000))
    batch = buffer.sample((0, 200))
    assert batch["next", "reward"].unique().tolist() == [1000, 7000]


def test_collector_batches_of_environments_and_time_are_taken():
    buffer = make_buffer(sim=0)
    buffer.extend(stream(12, offset=1000).reshape(3, 4))
    assert len(buffer) == 32


def test_simulated_rows_take_the_dtype_of_the_real_ones():
    buffer = make_buffer(sim=0)
    rows = stream(3, offset=1000)
    rows["observation"] = rows["observation"].double()
    buffer.extend(rows)
    assert buffer.sample()["observation"].dtype == torch.float32


def test_what_was_added_is_not_changed_by_the_caller_later():
    buffer = make_buffer(sim=0)
    rows = stream(3, offset=1000)
    buffer.extend(rows)
    rows["observation"].zero_()
    assert (buffer.sample((0, 20))["observation"] >= 1000).all()


@pytest.mark.parametrize("key", TRANSITION_KEYS, ids=str)
def test_missing_entry_is_named(key):
    name = repr(key).replace("(", r"\(").replace(")", r"\)")
    with pytest.raises(ValueError, match=f"the real data lack {name}"):
        HybridReplayBuffer(stream(5).exclude(key), 10)
    with pytest.raises(ValueError, match=f"the simulated data lack {name}"):
        make_buffer(sim=0).extend(stream(5).exclude(key))


def test_rows_of_another_task_are_refused_and_nothing_is_kept():
    buffer = make_buffer(sim=0)
    with pytest.raises(ValueError, match=r"'observation' has the shape \[4\].*\[3\]"):
        buffer.extend(make_recording(observations=4))
    assert len(buffer) == 20


@pytest.mark.parametrize("sizes", [(0, 0), (-1, 3)])
def test_impossible_batch_size_is_refused(sizes):
    with pytest.raises(ValueError, match="expected \\(real, simulated\\)"):
        make_buffer().sample(sizes)


def test_empty_real_data_and_no_room_are_refused():
    with pytest.raises(ValueError, match=r"batch size \[0\]"):
        HybridReplayBuffer(stream(5)[:0], 10)
    with pytest.raises(ValueError, match="sim_capacity is 0"):
        HybridReplayBuffer(stream(5), 0)


def test_seed_repeats_the_draws():
    def draw():
        torch.manual_seed(3)
        buffer = make_buffer()
        return torch.stack([buffer.sample() for _ in range(3)])

    assert_same(draw(), draw())


@pytest.mark.parametrize("scratch", [False, True])
@pytest.mark.parametrize("way", ["state_dict", "dumps"])
@pytest.mark.parametrize("sim", [0, 1, 30, 77], ids="sim={}".format)
def test_resumed_buffer_goes_on_as_the_unbroken_one(tmp_path, sim, way, scratch):
    def go_on(buffer):
        buffer.extend(stream(9, offset=5000))
        return torch.stack([buffer.sample() for _ in range(4)])

    def new(name, **kwargs):
        place = {"scratch_dir": tmp_path / name} if scratch else {}
        return make_buffer(capacity=50, **kwargs, **place)

    torch.manual_seed(1)
    buffer = new("first", sim=sim)
    if sim:
        buffer.sample()
    if way == "dumps":
        buffer.dumps(tmp_path / "checkpoint")
    else:
        torch.save(buffer.state_dict(), tmp_path / "checkpoint.pt")
    generator = torch.get_rng_state()
    unbroken = go_on(buffer)

    resumed = new("second", sim=13)  # its previous content must be discarded
    if way == "dumps":
        resumed.loads(tmp_path / "checkpoint")
    else:
        resumed.load_state_dict(torch.load(tmp_path / "checkpoint.pt", weights_only=True))
    assert len(resumed) == 20 + min(sim, 50)
    torch.set_rng_state(generator)
    assert_same(go_on(resumed), unbroken)


def test_checkpoint_holds_neither_real_data_nor_empty_room(tmp_path):
    buffer = HybridReplayBuffer(stream(5000), 100_000)
    buffer.extend(stream(10))
    buffer.dumps(tmp_path / "checkpoint")
    size = sum(path.stat().st_size for path in (tmp_path / "checkpoint").rglob("*.memmap"))
    assert size == 10 * 4 * (3 + 2 + 3 + 1) + 10 * 2
    assert not list((tmp_path / "checkpoint").rglob("*.p*kl*"))
    torch.save(buffer.state_dict(), tmp_path / "state.pt")
    assert (tmp_path / "state.pt").stat().st_size < 10_000


def test_checkpoint_replaces_an_older_one(tmp_path):
    buffer = make_buffer(sim=10)
    buffer.dumps(tmp_path / "checkpoint")
    buffer.extend(stream(5, offset=2000))
    buffer.dumps(tmp_path / "checkpoint")
    other = make_buffer(sim=0)
    other.loads(tmp_path / "checkpoint")
    assert len(other) == 35
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]


def test_failed_checkpoint_leaves_the_older_one(tmp_path, monkeypatch):
    buffer = make_buffer(sim=10)
    buffer.dumps(tmp_path / "checkpoint")
    buffer.extend(stream(5, offset=2000))
    with monkeypatch.context() as patch:
        patch.setattr("tensordict.TensorDict.memmap", lambda *args, **kwargs: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            buffer.dumps(tmp_path / "checkpoint")
    other = make_buffer(sim=0)
    other.loads(tmp_path / "checkpoint")
    assert len(other) == 30


def test_checkpoint_of_other_real_data_is_refused(tmp_path):
    buffer = make_buffer()
    buffer.dumps(tmp_path / "checkpoint")
    other = HybridReplayBuffer(stream(20, offset=1), 50)
    with pytest.raises(ValueError, match="load the same real data first"):
        other.loads(tmp_path / "checkpoint")
    with pytest.raises(ValueError, match="load the same real data first"):
        other.load_state_dict(buffer.state_dict())


def test_checkpoint_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"holds 30 simulated transitions.*room for 10"):
        make_buffer(capacity=10, sim=0).load_state_dict(make_buffer().state_dict())


def test_mapped_real_data_are_not_copied(tmp_path):
    real = stream(20)
    real.memmap_(tmp_path / "real")
    buffer = HybridReplayBuffer(real, 10)
    assert buffer.real[:]["observation"].data_ptr() == real["observation"].data_ptr()
    assert buffer.sample((4, 0))["observation"].shape == (4, 3)


NUMBERS = ("observation", "action", ("next", "observation"), ("next", "reward"))
with_steps = pytest.mark.parametrize("n_steps", [1, 3])


def pattern(key):
    return repr(key).replace("(", r"\(").replace(")", r"\)")


@with_steps
@pytest.mark.parametrize("key", NUMBERS, ids=str)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300])
def test_simulated_numbers_that_are_not_finite_are_refused_and_no_row_is_kept(key, value, n_steps):
    torch.manual_seed(0)
    buffer, untouched = make_buffer(n_steps=n_steps), make_buffer(n_steps=n_steps)
    rows = stream(12, offset=2000)
    rows[key] = rows[key].double()
    rows[key][6:8] = value
    said = rf"the simulator produced a {pattern(key)} that is NaN or infinite in 2 of 12 rows, and no row was added"
    with pytest.raises(UnstableSimulatorError, match=said):
        buffer.extend(rows)
    for one in (buffer, untouched):
        one.extend(stream(5, offset=1030))
    state, expected = buffer.state_dict(), untouched.state_dict()
    for kept in ("rows", "waiting"):
        torch.testing.assert_close(state[kept], expected[kept], rtol=0, atol=0)


@with_steps
@pytest.mark.parametrize("key", NUMBERS, ids=str)
def test_real_numbers_that_are_not_finite_are_refused(key, n_steps):
    real = stream(20)
    real[key][4:7] = float("nan")
    with pytest.raises(ValueError, match=f"{pattern(key)} of the real data is NaN or infinite in"):
        HybridReplayBuffer(real, 10, n_steps=n_steps)


@pytest.mark.parametrize("key", [("next", "terminated"), ("next", "done")], ids=str)
@pytest.mark.parametrize("value", [0.5, float("nan"), 1.0])
def test_flags_that_are_not_boolean_are_refused(key, value):
    buffer, rows = make_buffer(sim=0), stream(12)
    rows[key] = torch.full((12, 1), value)
    with pytest.raises(ValueError, match=rf"{pattern(key)} of the simulated data is torch.float32, .*\.bool\(\)"):
        buffer.extend(rows)
    with pytest.raises(ValueError, match=rf"{pattern(key)} of the real data is torch.float32, .*\.bool\(\)"):
        HybridReplayBuffer(rows, 10)
