"""Damaged and suspicious files of every format are refused in one line."""

import io
import pickle
import struct
import zipfile
import zlib

import h5py
import numpy as np
import pytest
import torch

from tests.data.readers.log_files import (
    FORMATS,
    Q,
    T,
    U,
    V,
    layout,
    write_mat73,
    write_mcap,
)
from torchrl_h2o.data import DataError, load
from torchrl_h2o.data.readers import file_kind


@pytest.fixture(params=FORMATS)
def log(request, tmp_path):
    """A log in one of the formats, and its layout."""
    path = tmp_path / request.param
    return path, FORMATS[request.param](path)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_file_that_is_cut_off_is_refused(log, share):
    path, columns = log
    if path.suffix in (".csv", ".txt"):
        pytest.skip("a text that is cut between two lines is a shorter log")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError) as caught:
        load(path, columns=columns)
    assert caught.value.source == str(path)
    assert len(str(caught.value)) < 700
    assert "\n" not in str(caught.value)


def objects():
    content = io.BytesIO()
    np.savez(content, q=np.array([print], dtype=object))
    return content.getvalue()


def torch_file():
    content = io.BytesIO()
    torch.save({"a": torch.zeros(1)}, content)
    return content.getvalue()


@pytest.mark.parametrize("content", [objects(), torch_file(), pickle.dumps([1]), b"PK\x03\x04"])
def test_a_pickle_as_an_npz_is_refused(tmp_path, content):
    (tmp_path / "log.npz").write_bytes(content)
    with pytest.raises(DataError, match="this is a pickle"):
        load(tmp_path / "log.npz", columns=layout())


def test_an_array_that_states_more_than_the_file_has_is_refused(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**11,)})
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as archive:
        archive.writestr("q.npy", header.getvalue() + bytes(80))
    with pytest.raises(DataError, match=r"it states 800000000000 bytes \[100000000000\], but the file stores 80"):
        load(tmp_path / "log.npz", columns=layout())


@pytest.mark.parametrize("name", ["log.npz", "log.mat", "log.parquet"])
def test_a_small_file_of_very_many_values_is_refused(tmp_path, monkeypatch, name):
    monkeypatch.setattr(file_kind, "UNSUSPICIOUS_BYTES", 2**16)
    zeros, path = np.zeros(200_000), tmp_path / name  # 1.6 MB in memory
    if name == "log.npz":
        np.savez_compressed(path, q=zeros)
    elif name == "log.mat":
        from scipy.io import savemat

        savemat(path, {"q": zeros}, do_compression=True)
    else:
        pyarrow = pytest.importorskip("pyarrow")
        from pyarrow import parquet

        parquet.write_table(pyarrow.table({"q": zeros}), path)
    with pytest.raises(DataError, match=r"it states 160\d+ bytes of values, but the file has \d+"):
        load(path, columns=layout())


def test_two_arrays_of_one_name_and_encrypted_ones_are_refused(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, t=T, q=Q, v=V, u=U)
    content = path.read_bytes()
    array = io.BytesIO()
    np.save(array, 2.0 * Q)
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("q.npy", array.getvalue())
    with pytest.raises(DataError, match="two arrays have this name") as caught:
        load(path, columns=layout())
    assert caught.value.column == "q"
    local, central = content.index(b"PK\x03\x04"), content.index(b"PK\x01\x02")
    marked = bytearray(content)
    marked[local + 6] |= 1
    marked[central + 8] |= 1
    path.write_bytes(bytes(marked))
    with pytest.raises(DataError, match=r"cannot be read as \.npz: .*encrypted"):
        load(path, columns=layout())


def matlab_object(name, kind):
    """A variable of a MATLAB 5 file that is an object, as MATLAB writes it; scipy writes none."""

    def element(number, content):
        return struct.pack("<II", number, len(content)) + content.ljust(-(-len(content) // 8) * 8, b"\0")

    reference = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
    reference += element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1))
    parts = (element(1, text.encode()) for text in (name, "MCOS", kind))
    return element(14, element(6, struct.pack("<II", 17, 0)) + b"".join(parts) + element(14, reference))


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", ["timeseries", "timetable"])
def test_objects_of_matlab_are_named_with_what_to_save(tmp_path, kind, compressed):
    from scipy.io import savemat

    savemat(tmp_path / "log.mat", {"t": T})
    added = matlab_object("hip", kind)
    if compressed:
        packed = zlib.compress(added)
        added = struct.pack("<II", 15, len(packed)) + packed
    with (tmp_path / "log.mat").open("ab") as file:
        file.write(added)
    with pytest.raises(DataError, match=rf"column 'hip': it is a {kind}.*t = hip.Time; x = hip.Data; save") as caught:
        load(tmp_path / "log.mat", columns=layout())
    assert caught.value.column == "hip"


def test_an_object_of_matlab_in_a_newer_file_is_named(tmp_path):
    columns = write_mat73(tmp_path / "log.mat")
    with h5py.File(tmp_path / "log.mat", "a") as file:
        file["hip"] = np.zeros((1, 6), np.uint32)
        file["hip"].attrs["MATLAB_class"] = np.bytes_("timeseries")
        file["hip"].attrs["MATLAB_object_decode"] = 3
    with pytest.raises(DataError, match=r"it is a timeseries.*hip\.Data"):
        load(tmp_path / "log.mat", columns=columns)


def linked_to_itself(file):
    file["log/again"] = file["log"]


def linked_twice(file):
    file["log/more"] = file["t"]


@pytest.mark.parametrize("link", [linked_to_itself, linked_twice])
def test_a_group_of_a_matlab_file_that_is_linked_again_is_refused(tmp_path, link):
    """Followed, the links have no end, or give one array any number of names."""
    columns = write_mat73(tmp_path / "log.mat")
    with h5py.File(tmp_path / "log.mat", "a") as file:
        link(file)
    with pytest.raises(DataError, match=r"it is another link to (log|t|log/more);"):
        load(tmp_path / "log.mat", columns=columns)


def test_a_bag_with_damaged_bytes_is_refused(tmp_path):
    path = tmp_path / "log.mcap"
    columns = write_mcap(path)
    whole, content = load(path, columns=columns), path.read_bytes()
    refused = 0
    for place in range(60, len(content) - 400, 397):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x11]) + content[place + 1 :])
        try:
            assert torch.equal(load(path, columns=columns)["observation"], whole["observation"])
        except DataError:
            refused += 1
    assert refused > 3


@pytest.mark.parametrize(
    ("last", "is_whole"),
    [("0.5000", True), ("0.50", False), ("0.", False), ("-1", False), ("0.5000\n", True), ("0.50\n", True)],
)
def test_a_last_cell_that_may_be_cut_is_refused(tmp_path, last, is_whole):
    (tmp_path / "log.csv").write_text("t,q,v,u\n0.00,1,1,0.1234\n0.01,2,2,-0.1230\n0.02,3,3," + last)
    if is_whole:
        assert len(load(tmp_path / "log.csv", columns=layout())) == 2
        return
    with pytest.raises(DataError, match="without a line break, so this number may be cut") as caught:
        load(tmp_path / "log.csv", columns=layout())
    assert (caught.value.column, caught.value.row) == ("u", 4)


def test_a_last_cell_that_is_not_used_or_cannot_be_cut_is_read(tmp_path):
    (tmp_path / "log.csv").write_text("t,q,v,u,mode\n0.00,1,1,0.1234,run\n0.01,2,2,-0.1230,ru")
    assert len(load(tmp_path / "log.csv", columns=layout())) == 1
    (tmp_path / "log.csv").write_text("t,q,v,u\n0.00,1,1,7\n0.01,2,2,-9")
    assert len(load(tmp_path / "log.csv", columns=layout())) == 1
