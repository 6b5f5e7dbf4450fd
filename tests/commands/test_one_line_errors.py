"""Expected errors of the scripts are one line; bugs, and expected errors on request, have a traceback."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hydra.errors import ConfigCompositionException

from tests.full_disk import small_disk
from tests.small_runs import ROOT
from torchrl_h2o.commands.one_line_errors import is_expected, one_line_errors
from torchrl_h2o.data import DataError, LogColumns
from torchrl_h2o.effects import Gravity

JOB = """
import torchrl_h2o.quiet
import numpy as np
from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.effects import Gravity
from torchrl_h2o.options import CloseTheLoopOptions

@hydra_main({folder!r}, "close_the_loop", CloseTheLoopOptions)
def main(cfg):
    import os
    assert os.environ.get("HYDRA_FULL_ERROR") == {during!r}
    {job}

main()
"""


def raised_by(call):
    try:
        call()
    except Exception as error:
        return error
    raise AssertionError("nothing was raised")


def test_errors_that_the_package_raises_are_expected_and_those_of_others_are_not():
    assert is_expected(raised_by(lambda: Gravity(-3.0)))
    assert is_expected(raised_by(lambda: LogColumns.load("nowhere.yaml")))
    assert is_expected(DataError("wrong", "correct it"))
    assert is_expected(ConfigCompositionException("no such option"))
    assert not is_expected(raised_by(lambda: np.zeros(2) + np.zeros(3)))
    assert not is_expected(raised_by(lambda: {}["a"]))
    assert not is_expected(raised_by(lambda: Path("nowhere").read_text()))

    def elsewhere():
        raise ValueError("raised outside the package")

    assert not is_expected(raised_by(elsewhere))


def test_an_expected_error_is_one_line_without_a_traceback(capsys, monkeypatch):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    with pytest.raises(SystemExit, match="1"), one_line_errors():
        raise DataError("two\nlines", "correct them", source="a.csv")
    assert capsys.readouterr().err == "DataError: a.csv: two lines; correct them\n"
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(DataError), one_line_errors():
        raise DataError("wrong", "correct it")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EDQUOT])
def test_a_disk_that_is_full_or_may_not_be_written_is_one_line(capsys, monkeypatch, number):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    with pytest.raises(SystemExit, match="1"), one_line_errors():
        raise OSError(number, os.strerror(number), "out/report.json")
    (line,) = capsys.readouterr().err.splitlines()
    assert os.strerror(number) in line
    assert line.endswith("'out/report.json'; make room, or choose a folder that can be written")


def run(folder, *arguments, full=False):
    environment = {name: value for name, value in os.environ.items() if name != "HYDRA_FULL_ERROR"}
    environment |= {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)} | ({"HYDRA_FULL_ERROR": "1"} if full else {})
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "options", "said"),
    [
        ("close_the_loop.py", ["data=nowhere.csv"], "ValueError: data=nowhere.csv: there is no such file"),
        ("close_the_loop.py", ["dat=nowhere.csv"], "ValueError: no option dat; did you mean data?"),
        ("close_the_loop.py", ["simulator=nothing"], "ValueError: simulator=nothing: must be gymnasium"),
        ("close_the_loop.py", ["data=short.csv"], "DataError: short.csv, column 'v', row 1: the row has 1 columns"),
        ("evaluate.py", ["checkpoint=nowhere"], "ValueError: checkpoint=nowhere: it is not the folder of a run"),
        ("h2o_plus.py", ["mend=nowhere"], "ValueError: mend=nowhere: there is no such file"),
        ("train.py", ["method=nothing"], "ValueError: method=nothing: must be"),
        ("paper.py", ["table=nothing"], "ValueError: table=nothing: must be"),
        ("report.py", ["group=[returns]"], "ValueError: no option group; did you mean groups?"),
    ],
)
def test_a_wrong_path_option_or_layout_ends_a_script_with_one_line(tmp_path, script, options, said):
    (tmp_path / "short.csv").write_text("a,b\n1,2\n")
    done = run(tmp_path, str(ROOT / "recipes" / script), *options)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert said in line


@pytest.mark.slow
def test_a_traceback_is_there_on_request_and_for_bugs(tmp_path):
    folder = str(ROOT / "torchrl_h2o" / "config")

    def script(job, during=None, full=False):
        (tmp_path / "job.py").write_text(JOB.format(folder=folder, job=job, during=during))
        return run(tmp_path, "job.py", full=full)

    expected = script("Gravity(-3.0)")
    assert (expected.returncode, expected.stderr.count("\n")) == (1, 1)
    assert expected.stderr.startswith("ValueError: Gravity: scale = -3 lies outside")
    on_request = script("Gravity(-3.0)", during="1", full=True)
    assert on_request.returncode == 1
    assert "Traceback" in on_request.stderr
    bug = script("np.zeros(2) + np.zeros(3)")
    assert bug.returncode == 1
    assert "Traceback" in bug.stderr
    assert "operands could not be broadcast" in bug.stderr


@pytest.mark.slow
@pytest.mark.parametrize("script", ["close_the_loop.py", "h2o_plus.py", "train.py"])
def test_a_folder_that_cannot_be_written_ends_a_script_with_one_line(tmp_path, script):
    with small_disk(tmp_path / "disk") as disk:
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        done = run(disk, str(ROOT / "recipes" / script))
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "Read-only file system" in line
    assert line.endswith("make room, or choose a folder that can be written")
