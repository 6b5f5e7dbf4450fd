"""Damaged files of every format: each reader returns valid transitions or raises a short DataError."""

import json
import re
import shutil
import warnings
import zipfile
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import h5py
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tests.data.readers import log_files as formats
from tests.data.recordings import assert_same, make_recording
from tests.data.test_d4rl import write as write_d4rl
from tests.data.test_log_columns import GOOD
from tests.fuzzing import (
    changes_of_entries,
    damaged,
    damages,
    few,
    many,
    outcome,
    some,
    text_damages,
    with_changed_entries,
)
from torchrl_h2o.data import LogColumns, read_d4rl, read_minari, read_robot_log, read_ted, write_minari, write_ted
from torchrl_h2o.data.readers.ted import require_ted

LOGS = {
    "csv": formats.write_csv,
    "txt": formats.write_txt,
    "npz": formats.write_npz,
    "mat": formats.write_mat,
    "mat73": formats.write_mat73,
    "parquet": formats.write_parquet,
    "mcap": formats.write_mcap,
}
FILES = [*LOGS, "d4rl", "minari", "ted"]
ROWS = 10_000  # more than any of the files holds, even with rows repeated


@dataclass(frozen=True)
class Original:
    """A valid source: a file or a folder, its files, and the function that reads it."""

    path: Path
    files: tuple[Path, ...]
    read: object


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    return cache(partial(make_original, tmp_path_factory.mktemp("originals")))


def make_original(root, name):
    if name in LOGS:
        path = root / f"run.{name.removesuffix('73')}" if name != "mat73" else root / "newer.mat"
        layout = LOGS[name](path)
        return Original(path, (path,), partial(read_robot_log, columns=layout))
    if name == "d4rl":
        path = write_d4rl(root / "a.hdf5")
        return Original(path, (path,), read_d4rl)
    if name == "minari":
        path, read = write_minari(make_recording(), "test-v0", root=root), read_minari
    else:
        path, read = write_ted(make_recording(), root / "ted"), read_ted
    return Original(path, tuple(sorted(file for file in path.rglob("*") if file.is_file())), read)


def copy_of(original, folder):
    """A fresh copy of a source."""
    path = folder / original.path.name
    if original.path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
        return Path(shutil.copytree(original.path, path))
    return Path(shutil.copyfile(original.path, path))


def assert_valid(td):
    if td is None:
        return
    td = td.clone()
    if ("next", "done") in td.keys(True):
        require_ted(td)
    assert 0 < len(td) < ROWS
    assert all(torch.isfinite(value).all() for value in td.values(True, True) if value.is_floating_point())


def assert_read_or_refused(original, folder, number, changes):
    path = copy_of(original, folder)
    chosen = original.files[number % len(original.files)]
    file = path if original.path == chosen else path / chosen.relative_to(original.path)
    file.write_bytes(damaged(file.read_bytes(), changes))
    assert_valid(outcome(original.read, path))


CHECKED = ["npz", "mcap"]  # their bytes have checksums: what is read equals the original


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKED)
@some
@given(share=st.floats(0, 1, exclude_max=True), flipped=st.integers(1, 255))
def test_a_flipped_byte_is_refused_or_changes_nothing(originals, tmp_path_factory, name, share, flipped):
    original = originals(name)
    content = bytearray(original.path.read_bytes())
    content[int(share * len(content))] ^= flipped
    path = copy_of(original, tmp_path_factory.getbasetemp())
    path.write_bytes(content)
    if (td := outcome(original.read, path)) is not None:
        assert_same(td, original.read(original.path))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["csv", "txt"])
@some
@given(share=st.floats(0, 1))
def test_a_text_that_is_cut_is_refused_or_a_shorter_log(originals, tmp_path_factory, name, share):
    original = originals(name)
    content, path = original.path.read_bytes(), copy_of(original, tmp_path_factory.getbasetemp())
    path.write_bytes(content[: int(share * len(content))])
    if (td := outcome(original.read, path)) is not None:
        whole = original.read(original.path)
        for key in ("observation", "action", ("next", "observation")):
            assert torch.equal(td[key], whole[key][: len(td)])


GROUPS = ["/", "/g", "/g/h"]
links = st.lists(
    st.tuples(st.sampled_from(GROUPS), st.text("abcdefgh", min_size=1, max_size=2), st.integers(0, 10), st.booleans()),
    min_size=1,
    max_size=6,
)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mat73", "d4rl", "minari"])
@some
@given(drawn=links)
def test_links_within_a_file(originals, tmp_path_factory, name, drawn):
    original = originals(name)
    path = copy_of(original, tmp_path_factory.getbasetemp())
    with h5py.File(path / "data" / "main_data.hdf5" if path.is_dir() else path, "a") as file:
        file.require_group("/g/h")
        for parent, link, number, soft in drawn:
            entries = [*GROUPS]
            file.visit(entries.append)
            target = entries[number % len(entries)]
            if link not in file[parent]:
                file[parent][link] = h5py.SoftLink(target) if soft else file[target]
    assert_valid(outcome(original.read, path))


@pytest.mark.slow
@some
@given(members=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9), st.sampled_from([0, 0, 1, 2**6])), max_size=5))
def test_members_of_an_archive(originals, tmp_path_factory, members):
    """Doubled, renamed and encrypted ones."""
    original = originals("npz")
    path = copy_of(original, tmp_path_factory.getbasetemp())
    with zipfile.ZipFile(original.path) as archive:
        names = archive.namelist()
        with zipfile.ZipFile(path, "w") as changed, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for name in names:
                changed.writestr(name, archive.read(name))
            for source, target, _ in members:
                changed.writestr(names[target % len(names)], archive.read(names[source % len(names)]))
    content = bytearray(path.read_bytes())
    for number, _, flag in members:
        for start, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
            content[[found.start() for found in re.finditer(start, content)][number % len(names)] + place] |= flag
    path.write_bytes(content)
    td = outcome(original.read, path)
    assert td is None or not members
    assert_valid(td)


sizes = st.floats(-12, 12).map(lambda exponent: 10.0**exponent)


@pytest.mark.slow
@some
@given(step=sizes, tolerance=sizes, gap=sizes, unit=st.sampled_from(["s", "ms", "ns"]))
def test_steps_and_gaps_of_any_size(tmp_path_factory, step, tolerance, gap, unit):
    path = tmp_path_factory.getbasetemp() / "gap.csv"
    path.write_text("t,q,u\n" + "".join(f"{t!r},{i},0\n" for i, t in enumerate([0.0, 1.0, 2.0, 2.0 + gap, 3.0 + gap])))
    entries = {"separator": ",", "header": True, "resample": step, "time_tolerance": tolerance}
    columns = [{"name": "t", "role": "time", "unit": unit}, {"name": "q", "role": "observation"}]
    columns.append({"name": "u", "role": "action"})
    assert_valid(outcome(partial(read_robot_log, columns={**entries, "columns": columns}), path))


any_damages = st.one_of(damages(), text_damages)
places = st.integers(0, 10**6)


@pytest.mark.parametrize("name", FILES)
@few
@given(number=places, changes=any_damages)
def test_damaged_bytes_of_a_file(originals, tmp_path_factory, name, number, changes):
    assert_read_or_refused(originals(name), tmp_path_factory.getbasetemp(), number, changes)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
@many
@given(number=places, changes=any_damages)
def test_many_damaged_bytes_of_a_file(originals, tmp_path_factory, name, number, changes):
    assert_read_or_refused(originals(name), tmp_path_factory.getbasetemp(), number, changes)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["minari", "ted"])
@many
@given(number=places, changes=changes_of_entries)
def test_many_changed_entries_of_the_description_of_a_folder(originals, tmp_path_factory, name, number, changes):
    original = originals(name)
    path = copy_of(original, tmp_path_factory.getbasetemp())
    described = [file for file in original.files if file.suffix == ".json"]
    file = path / described[number % len(described)].relative_to(original.path)
    file.write_text(json.dumps(with_changed_entries(json.loads(file.read_text()), changes)))
    assert_valid(outcome(original.read, path))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["minari", "ted"])
@many
@given(number=places, other=places, kind=st.sampled_from(["remove", "empty", "exchange", "folder"]))
def test_many_missing_and_exchanged_files_of_a_folder(originals, tmp_path_factory, name, number, other, kind):
    original = originals(name)
    path = copy_of(original, tmp_path_factory.getbasetemp())
    file, source = (path / original.files[n % len(original.files)].relative_to(original.path) for n in (number, other))
    content = source.read_bytes()
    file.unlink()
    if kind == "folder":
        file.mkdir()
    elif kind != "remove":
        file.write_bytes(content if kind == "exchange" else b"")
    assert_valid(outcome(original.read, path))


def assert_layout_or_refused(folder, content):
    path = folder / "columns.yaml"
    path.write_bytes(content)
    layout = outcome(LogColumns.load, path)
    assert layout is None or (layout.observation and isinstance(layout.columns, tuple))


@few
@given(changes=text_damages)
def test_a_damaged_description_of_columns(tmp_path_factory, changes):
    assert_layout_or_refused(tmp_path_factory.getbasetemp(), damaged(GOOD.encode(), changes))


@pytest.mark.slow
@many
@given(changes=any_damages)
def test_many_damaged_descriptions_of_columns(tmp_path_factory, changes):
    assert_layout_or_refused(tmp_path_factory.getbasetemp(), damaged(GOOD.encode(), changes))


@pytest.mark.slow
@many
@given(changes=changes_of_entries)
def test_many_descriptions_of_columns_with_changed_entries(tmp_path_factory, changes):
    entries = with_changed_entries(yaml.safe_load(GOOD), changes)
    content = yaml.safe_dump(entries, allow_unicode=True).encode(errors="surrogatepass")
    assert_layout_or_refused(tmp_path_factory.getbasetemp(), content)
