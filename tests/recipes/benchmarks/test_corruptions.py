"""The benchmark of damaged logs: its damages, its criterion, and an arm that is not among its systems."""

from dataclasses import replace

import numpy as np
import pytest
from corruption_cases import CORRUPTIONS
from corruption_logs import DamagedLog, GoodLog
from corruptions import judge, verdict

from tests.data.audit.recorded import arm, recording, rows_of
from torchrl_h2o.data import Audit, Finding, audit
from torchrl_h2o.effects import BodyMass, Gravity


def log_of(*effects, seed=0) -> DamagedLog:
    data = recording(*effects, seed=seed, rows=4000)
    return DamagedLog(rows_of(data)[:-1], data.action, dt=0.01)


@pytest.fixture(scope="module")
def good() -> GoodLog:
    other = log_of(BodyMass(6.0), Gravity(3.0))
    return GoodLog("arm", log_of(), ((0, 2), (1, 3)), log_of(seed=1).action, other, lambda step: arm(), 0.01)


def test_there_are_thirty_damages_with_different_names():
    assert len({corruption.name for corruption in CORRUPTIONS}) == 30


@pytest.mark.parametrize("corruption", CORRUPTIONS, ids=lambda corruption: corruption.name)
def test_damage_changes_the_log_and_leaves_the_original(good, corruption):
    before = good.log.observation.copy(), good.log.action.copy()
    damaged = corruption.damage(good, np.random.default_rng(0))
    same_rows = np.array_equal(damaged.observation, before[0]) and np.array_equal(damaged.action, before[1])
    assert not same_rows or damaged.time is not None or damaged.edit is not None
    np.testing.assert_array_equal(good.log.observation, before[0])
    np.testing.assert_array_equal(good.log.action, before[1])


def test_only_a_serious_finding_of_a_responsible_check_is_right():
    severe, note = Finding("rows", "severe", "a"), Finding("time", "note", "b")
    assert verdict(Audit((severe, note)), ("rows",))["outcome"] == "named"
    assert verdict(Audit((severe, note)), ("time",)) == {
        "right": False, "outcome": "missed", "check": "rows", "severity": "severe", "words": "a",
    }  # fmt: skip


def test_undamaged_log_passes_through_the_file(good, tmp_path):
    transitions = good.log.read(tmp_path)
    assert audit(transitions, good.simulation(good.log, transitions)).severe == ()


def test_refused_file_is_right(good, tmp_path):
    number = next(i for i, corruption in enumerate(CORRUPTIONS) if corruption.name == "rows with NaN")
    row = judge(good, number, CORRUPTIONS[number], 0, tmp_path)
    assert (row["outcome"], row["right"]) == ("refused", True)
    assert "the value is nan" in row["words"]


@pytest.mark.slow
def test_damages_of_another_system_are_named(good, tmp_path):
    with_step = replace(good, log=replace(good.log, dt=0.01))
    rows = [judge(with_step, i, corruption, 0, tmp_path) for i, corruption in enumerate(CORRUPTIONS)]
    assert sum(row["right"] for row in rows) >= 28, [row for row in rows if not row["right"]]
