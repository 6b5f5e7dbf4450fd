"""The summary of a run: which version of the library it names."""

import importlib.metadata
import json
import shutil
import subprocess

import pytest
import torch

import torchrl_h2o
from torchrl_h2o.training import judging

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository of the user with one commit, and the library's file in an environment inside it."""
    installed = tmp_path / "mine" / "env" / "judging.py"
    installed.parent.mkdir(parents=True)
    installed.write_text("")
    monkeypatch.setattr(judging, "__file__", str(installed))
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


def commit_in_summary(folder):
    judging.write_summary(folder, {})
    return json.loads((folder / "summary.json").read_text())["versions"].get("commit")


def test_the_commit_of_a_repository_that_only_surrounds_the_installed_library_is_not_told(repository, tmp_path):
    assert commit_in_summary(tmp_path) is None


def test_the_commit_is_that_of_the_repository_the_library_runs_from(repository, tmp_path):
    repository("add", ".")
    repository("commit", "-m", "second")
    commit = repository("rev-parse", "--short", "HEAD")
    assert commit_in_summary(tmp_path) == commit
    (tmp_path / "mine" / "env" / "judging.py").write_text("changed")
    assert commit_in_summary(tmp_path) == f"{commit}-dirty"


def test_without_git_no_commit_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit_in_summary(tmp_path) is None


def test_a_library_that_runs_from_a_copy_and_is_not_installed_has_a_summary(tmp_path, monkeypatch):
    def uninstalled(name, version=importlib.metadata.version):
        if name == "torchrl_h2o":
            raise importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(judging, "version", uninstalled)
    judging.write_summary(tmp_path, {})
    versions = json.loads((tmp_path / "summary.json").read_text())["versions"]
    assert versions["torchrl_h2o"] == torchrl_h2o.__version__
    assert versions["torch"] == torch.__version__
