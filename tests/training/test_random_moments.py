"""A run that is killed or interrupted at any moment resumes to the bytes of an unbroken one."""

import json
import multiprocessing
import random
import signal
import time

import pytest

from tests.small_runs import rows, trained
from torchrl_h2o.training.config_file import FILE, load_config
from torchrl_h2o.training.job import run_job
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.run_folder import claimed, resumable

MOMENTS = 20
FORK = multiprocessing.get_context("fork")  # the packages are imported once, so a run takes seconds
UNEQUAL = {"wall_s", "updates_per_second", "cpu_s", "dirty"}  # times, and the state of the repository


def run_once(cfg, folder):
    """Starts the run, or continues it, as the recipe does."""
    folder.mkdir(exist_ok=True)
    with claimed(folder), resumable(folder):
        cfg = load_config(folder) if (folder / FILE).exists() else cfg
        run_job(cfg, folder, [METHODS["h2o_plus"]])


def run_until(moment, number, cfg, folder):
    """Runs in a process that receives a signal after some seconds of computing.

    Returns its exit status, and how many seconds it computed if it ended before the signal.
    """
    seconds = FORK.Value("d")

    def run():
        if number == signal.SIGKILL:
            signal.signal(signal.SIGPROF, signal.SIG_DFL)  # ends the process at once, wherever it is
        else:
            signal.signal(signal.SIGPROF, lambda *_: signal.raise_signal(number))
        signal.setitimer(signal.ITIMER_PROF, moment)
        run_once(cfg, folder)
        signal.setitimer(signal.ITIMER_PROF, 0)
        seconds.value = time.process_time()

    process = FORK.Process(target=run)
    process.start()
    process.join()
    return process.exitcode, seconds.value


def results(folder):
    summary = json.loads((folder / "summary.json").read_text())
    summary = {key: value for key, value in summary.items() if key not in UNEQUAL}
    return trained(folder), rows(folder), summary, (folder / FILE).read_bytes()


@pytest.mark.slow
def test_twenty_random_kills_and_interrupts_resume_to_the_same_bytes(compose, tmp_path):
    cfg, _ = compose("updates=100")
    status, seconds = run_until(1000, signal.SIGKILL, cfg, tmp_path / "unbroken")
    assert status == 0
    expected = results(tmp_path / "unbroken")
    generator, broken = random.Random(0), 0
    for index in range(MOMENTS):
        number = generator.choice([signal.SIGKILL, signal.SIGINT])
        share, folder = generator.uniform(0.02, 1.0), tmp_path / f"broken_{index}"
        broken += run_until(share * seconds, number, cfg, folder)[0] != 0
        assert run_until(1000, signal.SIGKILL, cfg, folder)[0] == 0
        assert results(folder) == expected, f"{number.name} after {share:.3f} of the run"
        assert list(folder.rglob(".*")) == []
    assert broken >= MOMENTS // 2  # the others ended before their signal; times vary
