"""Every reader: a log whose numbers are exactly those written, or an InputError of one line; nothing else."""

import io
import os
import pickle
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pandas
import polars
import pyarrow
import pytest
import scipy.io
import xarray
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from jaxid.errors import InputError
from jaxid.logs.log import read_log
from tests.support.random_logs import (
    FEW,
    MANY,
    MOVED,
    NUMBERS,
    damaged,
    in_file,
    outcome,
    same,
    steady_table,
    tables,
)
from tests.support.written_logs import COLUMNS


def csv_text(table, delimiter=",", quoted=False, end="\n", bom=False, comment=False, spaces=False):
    cell = (lambda x: f'"{x}"') if quoted else (lambda x: f" {x} " if spaces else x)
    rows = [list(table)] + [[repr(float(x)) for x in row] for row in zip(*table.values(), strict=True)]
    lines = [delimiter.join(map(cell, row)) for row in rows]
    text = end.join(["# a comment", *lines] if comment else lines) + end
    return text.encode("utf-8-sig" if bom else "utf-8")


STYLES = st.fixed_dictionaries(
    {
        "delimiter": st.sampled_from(",;\t"),
        "quoted": st.booleans(),
        "end": st.sampled_from(["\n", "\r\n"]),
        "bom": st.booleans(),
        "comment": st.booleans(),
        "spaces": st.booleans(),
    }
)


def npz(table, compressed=False):
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **table)
    return buffer.getvalue()


def mat(table, **options):
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, table, **options)
    return buffer.getvalue()


def of_parquet(table):
    buffer = io.BytesIO()
    parquet.write_table(pyarrow.table(table), buffer)
    return buffer.getvalue()


WRITERS = {
    ".csv": csv_text,
    ".npz": npz,
    ".mat": mat,
    ".parquet": of_parquet,
}
OTHERS = {
    ".npz": lambda table: npz(table, compressed=True),
    ".mat": lambda table: mat(table, do_compression=True),
    ".MAT": lambda table: mat(table, format="4"),
}
IN_MEMORY = {
    "dictionary": dict,
    "lists": lambda table: {name: list(values) for name, values in table.items()},
    "masked": lambda table: {name: np.ma.masked_invalid(values) for name, values in table.items()},
    "pandas": pandas.DataFrame,
    "nullable": lambda table: pandas.DataFrame(table).convert_dtypes(),
    "polars": polars.DataFrame,
    "xarray": lambda table: xarray.Dataset({name: ("k", values) for name, values in table.items()}),
}


def check_written(table, style):
    same(in_file(csv_text(table, **style), ".csv"), table)
    for suffix in (".npz", ".mat", ".parquet"):
        same(in_file(WRITERS[suffix](table), suffix), table)
    for suffix, writer in OTHERS.items():
        same(in_file(writer(table), suffix), table)
    for make in IN_MEMORY.values():
        same(outcome(make(table)), table)


@FEW
@given(tables(), STYLES)
def test_what_is_written_is_read(table, style):
    check_written(table, style)


@FEW
@given(tables(NUMBERS), STYLES)
def test_numbers_that_no_sensor_reads_are_refused(table, style):
    check_written(table, style)


@pytest.mark.slow
@MANY
@given(st.one_of(tables(), tables(NUMBERS)), STYLES)
def test_what_is_written_is_read_many(table, style):
    check_written(table, style)


@st.composite
def damaged_files(draw):
    suffix = draw(st.sampled_from(list(WRITERS)))
    sound = draw(st.sampled_from([WRITERS, OTHERS | WRITERS]))[suffix](steady_table())
    return suffix, draw(damaged(sound))


@settings(FEW, max_examples=100)
@given(damaged_files())
def test_a_damaged_file_is_read_or_refused(file):
    in_file(file[1], file[0])


@pytest.mark.slow
@settings(MANY, max_examples=20_000)
@given(damaged_files())
def test_a_damaged_file_is_read_or_refused_many(file):
    in_file(file[1], file[0])


@FEW
@given(st.binary(max_size=400), st.sampled_from([*WRITERS, ".npz"]))
def test_bytes_of_any_kind_are_refused(content, suffix):
    assert in_file(content, suffix) is None


ENTRIES = st.one_of(
    st.none(),
    st.text(max_size=3),
    st.booleans(),
    st.complex_numbers(),
    st.binary(max_size=2),
    st.lists(MOVED),
)


@FEW
@given(st.lists(st.one_of(ENTRIES, MOVED), min_size=50, max_size=60), st.sampled_from(["q", "u", "t"]))
def test_lists_of_anything(values, name):
    table = {"t": np.arange(len(values)) / 10, "q": np.ones(len(values)), "u": np.ones(len(values))}
    log = outcome(table | {name: values})
    if log is not None:
        numbers = [float(v) for v in values]
        np.testing.assert_array_equal(
            {"q": log.position, "u": log.force, "t": log.time}[name].ravel(), numbers
        )


# Objects and bombs


class Trap:
    """An object whose unpickling makes a folder."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_no_object_is_ever_unpickled(tmp_path):
    trap = tmp_path / "sprung"
    objects = np.array([Trap(trap)] * 60, dtype=object)
    pickle.loads(pickle.dumps(objects[0]))
    assert trap.exists()
    trap.rmdir()

    table = {"t": np.arange(60) / 500, "q": np.ones(60), "u": np.ones(60)}
    np.savez(tmp_path / "log.npz", **{**table, "u": objects})
    np.save(tmp_path / "log.npy", objects)
    (tmp_path / "log.npy").rename(tmp_path / "bare.npz")
    (tmp_path / "pickled.npz").write_bytes(pickle.dumps(Trap(trap)))
    (tmp_path / "pickled.mat").write_bytes(pickle.dumps(Trap(trap)))
    for name in ("log.npz", "bare.npz", "pickled.npz", "pickled.mat"):
        assert outcome(tmp_path / name) is None, name
    assert outcome({**table, "u": objects}) is None
    assert not trap.exists()
    # Objects beside the log are no concern of its.
    np.savez(tmp_path / "log.npz", **table, more=objects)
    assert read_log(tmp_path / "log.npz", COLUMNS).samples == 60
    assert not trap.exists()


@pytest.mark.parametrize(
    "value",
    [
        {"a": np.ones(60)},
        np.ones((60, 0)),
        np.array([1.0, "a", 2.0], dtype=object),
        np.array(["a"] * 60),
        np.ones(60) * 1j,
        scipy.sparse.csc_array(np.eye(60)),
    ],
    ids=["struct", "empty", "cell", "text", "complex", "sparse"],
)
def test_what_is_no_matrix_in_a_mat_file(tmp_path, value):
    table = {"t": np.arange(60) / 500, "q": np.ones(60), "u": value}
    scipy.io.savemat(tmp_path / "log.mat", table)
    assert outcome(tmp_path / "log.mat") is None


def array_file(shape, data=b"", kind="<f8"):
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + data


@pytest.mark.parametrize(
    "shape", ["(10000000000000,)", "(9223372036854775807, 9)", "(-1,)", "(60, 'a')", "(1e9,)"]
)
def test_a_shape_that_the_data_do_not_have(tmp_path, shape):
    path = tmp_path / "log.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for name in "tqu":
            archive.writestr(f"{name}.npy", array_file(shape, bytes(480)))
    with pytest.raises(InputError, match="declares the shape|cannot be read"):
        read_log(path, COLUMNS)


def test_a_bomb_is_not_unpacked(tmp_path):
    """An array that would be 40 GiB: its size is read, and nothing is unpacked."""
    path = tmp_path / "log.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("t.npy", array_file("(5368709120,)", bytes(10_000)))
    content = path.read_bytes()
    # The directory states the largest size that it can.
    at = content.rindex(b"PK\x01\x02")
    path.write_bytes(content[: at + 24] + struct.pack("<I", 2**32 - 2) + content[at + 28 :])
    with pytest.raises(InputError, match=r"variable 't': declares the shape \(5368709120,\)"):
        read_log(path, {"time": "t", "position": "t2", "force": "u"})


def test_a_matrix_larger_than_any_log(tmp_path):
    content = bytearray(mat({"t": np.arange(60) / 500, "q": np.ones(60), "u": np.ones(60)}))
    # Dimensions of the first variable: 1 by 60.
    at = content.index(struct.pack("<ii", 1, 60))
    content[at : at + 8] = struct.pack("<ii", 2**30, 2**10)
    (tmp_path / "log.mat").write_bytes(content)
    with pytest.raises(InputError, match=r"variable 't': is 8.19e\+03 GiB large; at most 4 GiB"):
        read_log(tmp_path / "log.mat", COLUMNS)


def test_a_compressed_matrix_whose_data_end_early(tmp_path):
    content = mat({"t": np.arange(60) / 500, "q": np.ones(60), "u": np.ones(60)}, do_compression=True)
    size = struct.unpack("<I", content[132:136])[0]
    first = zlib.decompress(content[136 : 136 + size])
    short = zlib.compress(first[: len(first) // 2])
    head = content[:132] + struct.pack("<I", len(short)) + short
    (tmp_path / "log.mat").write_bytes(head + content[136 + size :])
    assert outcome(tmp_path / "log.mat") is None


def test_parquet_with_a_column_twice(tmp_path):
    column = pyarrow.array(np.arange(60) / 500)
    parquet.write_table(
        pyarrow.Table.from_arrays([column] * 4, ["t", "q", "u", "u"]), tmp_path / "log.parquet"
    )
    assert outcome(tmp_path / "log.parquet") is None


def test_the_memory_that_a_file_declares_is_not_taken(tmp_path):
    """A file of 1 kB that declares 3.9 GiB is refused before that is allocated."""
    path = tmp_path / "log.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for name in "tqu":
            archive.writestr(f"{name}.npy", array_file("(500000000,)", bytes(480)))
    before = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    assert outcome(path) is None
    after = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    assert after - before < 2**28
