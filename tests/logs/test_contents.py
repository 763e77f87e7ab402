"""Columns of a log whose names nobody has stated, in the formats that logs come in."""

import json

import h5py
import nptdms
import numpy as np
import openpyxl
import pytest
from pyarrow import Table, parquet
from rosbags.rosbag2 import StoragePlugin
from scipy.io import savemat

from jaxid.errors import InputError
from jaxid.logs.readers.contents import contents_of
from tests.logs.test_formats import T, joint_states
from tests.support.ros_bags import write_bag
from tests.support.written_logs import signals, write_csv


def test_a_plain_header(tmp_path):
    found = contents_of(write_csv(tmp_path / "log.csv", signals()))
    assert found.names == ("t", "q", "u")
    assert found.units == {}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1"])
def test_units_of_a_header_behind_metadata(tmp_path, encoding):
    rows = [
        "Gerät;X1",
        "Abtastzeit;1 ms",
        "",
        "Zeit [s];Lage [mm];Strom [A]",
        "0,000;0,0;0,1",
        "0,001;0,5;0,2",
    ]
    (tmp_path / "log.csv").write_text("\n".join(rows), encoding=encoding)
    found = contents_of(tmp_path / "log.csv")
    assert found.names == ("Zeit", "Lage", "Strom")
    assert found.units == {"Zeit": "s", "Lage": "mm", "Strom": "A"}


def test_a_row_of_units_is_no_header(tmp_path):
    rows = ["Zeit;Lage;Strom", "ms;mm;A", "0,0;0,0;0,1", "1,0;0,5;0,2"]
    (tmp_path / "log.csv").write_text("\n".join(rows))
    found = contents_of(tmp_path / "log.csv")
    assert found.names == ("Zeit", "Lage", "Strom")
    assert found.units == {"Zeit": "ms", "Lage": "mm", "Strom": "A"}


def test_a_time_before_each_channel(tmp_path):
    rows = ["Name\tAxis1.ActPos\tName\tAxis1.ActCurrent", "0\t0\t0\t1", "1\t0.5\t1\t2"]
    (tmp_path / "log.csv").write_text("\n".join(rows))
    found = contents_of(tmp_path / "log.csv")
    assert (found.names, found.time) == (("Name", "Axis1.ActPos", "Axis1.ActCurrent"), "Name")


def test_arrays_and_their_columns(tmp_path):
    arrays = {"t": T, "pos": np.stack([T, 2 * T]), "gain": np.float64(3.0)}
    np.savez(tmp_path / "log.npz", **arrays)
    savemat(tmp_path / "log.mat", {**arrays, "note": "text"})
    for name in ("log.npz", "log.mat"):
        assert contents_of(tmp_path / name).names == ("t", "pos[1]", "pos[2]")


def test_hdf5_parquet_excel_and_tdms(tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["axis/q"] = T
        file["axis/q"].attrs["units"] = "mm"
        file["note"] = "text"
    found = contents_of(tmp_path / "log.h5")
    assert (found.names, found.units) == (("axis/q",), {"axis/q": "mm"})

    parquet.write_table(Table.from_pydict({"t": T, "q": T}), tmp_path / "log.parquet")
    assert contents_of(tmp_path / "log.parquet").names == ("t", "q")

    book = openpyxl.Workbook()
    for row in (["Antrieb", "X1", None], [], ["t [s]", "q [mm]", "u"], *([t, t, t] for t in T.tolist())):
        book.active.append(row)
    book.save(tmp_path / "log.xlsx")
    found = contents_of(tmp_path / "log.xlsx")
    assert (found.names, found.units) == (("t", "q", "u"), {"t": "s", "q": "mm"})

    with nptdms.TdmsWriter(tmp_path / "log.tdms") as writer:
        properties = {"wf_increment": 0.001, "wf_start_offset": 0.0, "unit_string": "mm"}
        writer.write_segment([nptdms.ChannelObject("axis", "q", T, properties=properties)])
    found = contents_of(tmp_path / "log.tdms")
    assert (found.names, found.units, found.time) == (("axis/q",), {"axis/q": "mm"}, "wf_time")


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_joints_of_a_bag(tmp_path, plugin):
    found = contents_of(write_bag(tmp_path / "bag", plugin, joint_states()))
    assert found.time == "header.stamp"
    assert found.names == (
        "/joint_states.position[shoulder]",
        "/joint_states.position[elbow]",
        "/joint_states.effort[shoulder]",
        "/joint_states.effort[elbow]",
    )


def test_features_of_a_dataset(tmp_path):
    (tmp_path / "meta").mkdir()
    motors = ["pan.pos", "lift.pos"]
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": motors}},
        "observation.images.top": {"dtype": "video", "shape": [480, 640, 3]},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    (tmp_path / "meta/info.json").write_text(json.dumps({"features": features, "total_episodes": 4}))
    found = contents_of(tmp_path)
    assert found.names == ("observation.state[pan.pos]", "observation.state[lift.pos]", "timestamp")
    assert (found.time, found.episodes) == ("timestamp", 4)


def test_what_lists_no_columns(tmp_path):
    (tmp_path / "log.csv").write_text("0.0,1.0\n0.1,2.0\n")
    with pytest.raises(InputError, match="no header row"):
        contents_of(tmp_path / "log.csv")


def test_the_shapes_of_an_archive_are_read_without_its_arrays(tmp_path):
    """An array of objects is no column, and no reason to refuse the others."""
    np.savez(tmp_path / "log.npz", t=T, q=T, more=np.array([{}] * T.size, dtype=object))
    assert contents_of(tmp_path / "log.npz").names == ("t", "q")


@pytest.mark.parametrize("suffix", ["npz", "mat", "parquet", "tdms", "h5", "xlsx", "mcap"])
def test_a_file_that_is_none_of_its_suffix_lists_no_columns(tmp_path, suffix):
    (tmp_path / f"log.{suffix}").write_bytes(b"this is no such file" * 20)
    with pytest.raises(InputError, match=r"cannot be read \(.*\); ") as caught:
        contents_of(tmp_path / f"log.{suffix}")
    assert "\n" not in str(caught.value)
