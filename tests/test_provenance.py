"""What a result says of the code that produced it."""

import importlib.metadata
import shutil
import subprocess

import pytest
import torch

import torchrl_h2o
from torchrl_h2o import provenance as module
from torchrl_h2o.provenance import provenance

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository of the user with one commit, and the library's file in an environment inside it."""
    installed = tmp_path / "mine" / "env" / "provenance.py"
    installed.parent.mkdir(parents=True)
    installed.write_text("")
    monkeypatch.setattr(module, "__file__", str(installed))
    for name in ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE"):  # set where a hook of git runs the tests
        monkeypatch.delenv(name, raising=False)

    def git(*arguments):
        who = ["-c", "user.name=somebody", "-c", "user.email=somebody@example.org", "-c", "commit.gpgsign=false"]
        done = subprocess.run(
            ["git", "-C", tmp_path / "mine", *who, *arguments], check=True, capture_output=True, text=True
        )
        return done.stdout.strip()

    git("init")
    git("commit", "--allow-empty", "-m", "first")
    return git


def test_the_commit_of_a_repository_that_only_surrounds_the_installed_library_is_not_told(repository):
    assert provenance()["commit"] is None


def test_the_commit_is_that_of_the_repository_the_library_runs_from(repository, tmp_path):
    repository("add", ".")
    repository("commit", "-m", "second")
    made_by = provenance()
    assert made_by["commit"] == repository("rev-parse", "--short", "HEAD")
    assert made_by["dirty"] is False
    (tmp_path / "mine" / "env" / "provenance.py").write_text("changed")
    assert provenance()["dirty"] is True


def test_without_git_no_commit_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert provenance()["commit"] is None


def test_a_package_that_is_not_installed_has_no_version(monkeypatch):
    def uninstalled(name, version=importlib.metadata.version):
        if name == "mujoco":
            raise importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(module, "version", uninstalled)
    versions = provenance()["versions"]
    assert "mujoco" not in versions
    assert versions["torchrl_h2o"] == torchrl_h2o.__version__
    assert versions["torch"] == torch.__version__


def test_cpu_time_counts_from_where_the_work_began():
    began = module.cpu_seconds()
    assert 0.0 <= provenance(began)["cpu_s"] <= provenance()["cpu_s"]
