"""Readers of containers (HDF5, Excel, TDMS, MCAP, db3, LeRobot): the numbers written, or one line.

Text tables, arrays and tables in memory are those of `test_readers_by_hypothesis.py`.
"""

import contextlib
import functools
import io
import json
import sqlite3
import struct
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxid.logs.log import read_log
from jaxid.logs.readers.contents import contents_of
from tests.support.random_logs import (
    FEW,
    MANY,
    NUMBERS,
    damaged,
    in_file,
    outcome,
    same,
    steady_table,
    tables,
)
from tests.support.written_logs import COLUMNS, refuse

EPOCH_NS = 1_700_000_000 * 10**9
JOINT = "sensor_msgs/msg/JointState"
ROS = {
    "time": "header.stamp",
    "position": "/joint_states.position[elbow]",
    "force": "/joint_states.effort[elbow]",
}
LEROBOT = {"time": "timestamp", "position": "observation.state[elbow_flex.pos]", "force": "action[1]"}


# Writers: a table and a layout of the format -> bytes. A library that is missing skips the test.


def hdf5(table, layout: str) -> bytes:
    h5py = pytest.importorskip("h5py")
    buffer = io.BytesIO()
    options = {
        "chunked": {"chunks": (16,), "maxshape": (None,)},
        "compressed": {"chunks": (16,), "compression": "gzip", "shuffle": True, "fletcher32": True},
        "lzf": {"compression": "lzf"},
    }
    latest = {"libver": "latest"} if layout == "latest" else {}
    with h5py.File(buffer, "w", userblock_size=512 if layout == "matlab" else 0, **latest) as file:
        if layout == "rows":
            kind = [(name, values.dtype) for name, values in table.items()]
            file["run/table"] = np.array(list(zip(*table.values(), strict=True)), dtype=kind)
        for name, values in table.items() if layout != "rows" else ():
            values = np.atleast_2d(values) if layout == "matlab" else values
            values = values.astype(values.dtype.newbyteorder(">")) if layout == "big" else values
            place = f"run/axis/{name}" if layout == "grouped" else name
            file.create_dataset(place, data=values, **options.get(layout, {})).attrs["kind"] = "measured"
    content = buffer.getvalue()
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(124) + b"\x00\x02IM"
    return text + content[128:] if layout == "matlab" else content


def xlsx(table, layout: str) -> bytes:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook(write_only=layout == "streamed")
    sheet = book.create_sheet("log") if layout == "streamed" else book.active
    if layout == "second":
        sheet.append(["nothing here"])
        sheet = book.create_sheet("log")
    for row in [["Antrieb", "X1"], []] if layout == "metadata" else []:
        sheet.append(row)
    sheet.append(list(table))
    for row in zip(*table.values(), strict=True):
        # No cell holds infinity or NaN: Excel has an error there, and openpyxl would leave the cell empty.
        sheet.append([float(x) if np.isfinite(x) else "#NUM!" for x in row])
    buffer = io.BytesIO()
    book.save(buffer)
    return buffer.getvalue()


def tdms(table, layout: str) -> bytes:
    nptdms = pytest.importorskip("nptdms")
    buffer = io.BytesIO()
    half = len(table["t"]) // 2
    parts = [slice(None, half), slice(half, None)] if layout == "segments" else [slice(None)]
    with nptdms.TdmsWriter(buffer, version=4713 if layout == "version 2" else 4712) as writer:
        for part in parts:
            channels = []
            for name, values in table.items():
                properties = {"unit_string": "", "wf_start_offset": 0.0, "wf_increment": float(table["t"][1])}
                channels.append(nptdms.ChannelObject("axis", name, values[part], properties=properties))
            writer.write_segment(channels)
    return buffer.getvalue()


def stamps(table) -> list[int]:
    return [EPOCH_NS + round(float(t) * 1e9) for t in table["t"]]


JOINTS = {"one": ["elbow"], "two": ["shoulder", "elbow"], "odd": ["a", "elbow", "längeres"]}


def states(table, joints: str):
    """Yield recorded time [ns] and joint state of each row; joints beside the elbow have other numbers."""
    written = pytest.importorskip("tests.support.ros_bags")
    names = JOINTS[joints]
    at = names.index("elbow")
    for stamp, q, u in zip(stamps(table), table["q"], table["u"], strict=True):
        values = [[0.0] * at + [float(x)] + [1.0] * (len(names) - at - 1) for x in (q, u)]
        message = written.joint_state(written.STORE, 0.0, names, *values)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        yield stamp, message


def rosbag2(table, layout: str) -> dict[str, bytes]:
    """Return the files of a rosbag2, as the writer of rosbags makes it."""
    library = pytest.importorskip("rosbags.rosbag2")
    written = pytest.importorskip("tests.support.ros_bags")
    container, joints = layout.split()
    plugin = library.StoragePlugin.SQLITE3 if container == "db3" else library.StoragePlugin.MCAP
    with tempfile.TemporaryDirectory() as folder:
        writer = library.Writer(Path(folder) / "bag", version=8, storage_plugin=plugin)
        if container == "zstd":
            writer.set_compression(library.CompressionMode.STORAGE, library.CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection("/joint_states", JOINT, typestore=written.STORE)
            for stamp, message in states(table, joints):
                writer.write(connection, stamp, written.STORE.serialize_cdr(message, JOINT))
        return {p.name: p.read_bytes() for p in sorted((Path(folder) / "bag").iterdir())}


def bag(table, layout: str) -> bytes:
    """Return the one file of a rosbag2 that holds its messages."""
    [content] = [part for name, part in rosbag2(table, layout).items() if name != "metadata.yaml"]
    return content


def rosbag1(table, layout: str) -> bytes:
    """Return a bag of ROS 1."""
    library = pytest.importorskip("rosbags.rosbag1")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    with tempfile.TemporaryDirectory() as folder:
        writer = library.Writer(Path(folder) / "log.bag")
        compression, joints = layout.split()
        if compression != "plain":
            writer.set_compression(library.Writer.CompressionFormat[compression.upper()])
        with writer:
            connection = writer.add_connection("/joint_states", JOINT, typestore=store)
            for k, (stamp, state) in enumerate(states(table, joints)):
                header = store.types["std_msgs/msg/Header"](k, state.header.stamp, "base")
                fields = (header, state.name, state.position, state.velocity, state.effort)
                writer.write(connection, stamp, store.serialize_ros1(store.types[JOINT](*fields), JOINT))
        return (Path(folder) / "log.bag").read_bytes()


def foxglove(table, layout: str) -> bytes:
    """Return an MCAP of Foxglove's writer, with the message's definition as text."""
    mcap = pytest.importorskip("mcap.writer")
    mcap_ros2 = pytest.importorskip("mcap_ros2.writer")
    written = pytest.importorskip("tests.support.ros_bags")
    definition = written.STORE.generate_msgdef(JOINT, ros_version=2)[0]
    kind = {"lz4": mcap.CompressionType.LZ4, "zstd": mcap.CompressionType.ZSTD}
    buffer = io.BytesIO()
    writer = mcap_ros2.Writer(
        buffer, chunk_size=2000, compression=kind.get(layout, mcap.CompressionType.NONE)
    )
    schema = writer.register_msgdef(JOINT, definition)
    for stamp, q, u in zip(stamps(table), table["q"], table["u"], strict=True):
        message = {
            "header": {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""},
            "name": ["elbow"],
            "position": [float(q)],
            "velocity": [],
            "effort": [float(u)],
        }
        writer.write_message("/joint_states", schema, message, stamp)
    writer.finish()
    return buffer.getvalue()


def lerobot(table, layout: str) -> dict[str, bytes]:
    """Return the files of a dataset of one episode."""
    pytest.importorskip("pyarrow")
    written = pytest.importorskip("tests.support.lerobot_sets")
    both = {
        name: np.stack([values, values], axis=1).astype(np.float64)
        for name, values in (("state", table["q"]), ("action", table["u"]))
    }
    with tempfile.TemporaryDirectory() as folder:
        root = written.lerobot(Path(folder) / "set", layout, [{"time": table["t"], **both}], "float64")
        return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


class Container(NamedTuple):
    """A format: its writer and layouts, the columns of its log, and what its writer keeps of numbers."""

    suffix: str
    write: Callable[[Any, str], Any]
    layouts: tuple[str, ...]
    columns: tuple[Mapping, ...] = (COLUMNS,)
    resolution: float = 1e-12
    digits: int = 17


# Stamps of ROS are whole nanoseconds: two of them, rounded, make a time. Excel's writer keeps 16 digits.
CLOCKS = (ROS, {**ROS, "time": "log_time"})
GROUPED = {"time": "axis/t", "position": "q", "force": "axis/u"}
CONTAINERS = {
    "hdf5": Container(
        ".h5", hdf5, ("plain", "grouped", "chunked", "compressed", "lzf", "latest", "rows", "big")
    ),
    "matlab": Container(".mat", hdf5, ("matlab",)),
    "excel": Container(".xlsx", xlsx, ("plain", "second", "metadata", "streamed"), digits=15),
    "tdms": Container(
        ".tdms", tdms, ("plain", "segments", "version 2"), (COLUMNS, GROUPED, {**COLUMNS, "time": "wf_time"})
    ),
    "mcap": Container(".mcap", bag, ("mcap one", "mcap two", "mcap odd", "zstd two"), CLOCKS, 1.1e-9),
    "foxglove": Container(".mcap", foxglove, ("lz4", "zstd", "plain"), CLOCKS, 1.1e-9),
    "db3": Container(".db3", bag, ("db3 one", "db3 two", "db3 odd"), CLOCKS, 1.1e-9),
    "rosbag2": Container("", rosbag2, ("db3 two", "mcap two", "zstd odd"), CLOCKS, 1.1e-9),
    "rosbag1": Container(".bag", rosbag1, ("plain two", "lz4 odd", "bz2 one"), CLOCKS, 1.1e-9),
    "lerobot": Container("", lerobot, ("v2.1", "v3.0"), (LEROBOT,)),
}


def in_container(content: bytes | Mapping[str, bytes], container: Container, columns: Mapping):
    """Return the outcome of a file, or of a folder of files."""
    if isinstance(content, bytes):
        return in_file(content, container.suffix, columns)
    with tempfile.TemporaryDirectory() as folder:
        for name, part in content.items():
            (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(folder) / name).write_bytes(part)
        return outcome(Path(folder), columns)


def check_written(data, name: str, numbers=None) -> None:
    container = CONTAINERS[name]
    table = data.draw(tables() if numbers is None else tables(numbers))
    if container.digits < 17:
        table |= {n: np.array([float(f"{x:.{container.digits}g}") for x in v]) for n, v in table.items()}
    content = container.write(table, data.draw(st.sampled_from(container.layouts)))
    log = in_container(content, container, data.draw(st.sampled_from(container.columns)))
    same(log, table, container.resolution)


def packed(parts: Mapping[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return buffer.getvalue()


@functools.cache
def sound(name: str, layout: str) -> bytes | Mapping[str, bytes]:
    return CONTAINERS[name].write(steady_table(), layout)


def check_damaged(data, name: str) -> None:
    container = CONTAINERS[name]
    content = sound(name, data.draw(st.sampled_from(container.layouts)))
    if name == "excel" and data.draw(st.booleans()):
        # What is damaged before it is packed has a right checksum.
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            parts = {info.filename: archive.read(info) for info in archive.infolist()}
        part = data.draw(st.sampled_from(sorted(parts)))
        content = packed({**parts, part: data.draw(damaged(parts[part]))})
    elif isinstance(content, bytes):
        content = data.draw(damaged(content))
    else:
        part = data.draw(st.sampled_from(sorted(content)))
        content = {**content, part: data.draw(damaged(content[part]))}
    in_container(content, container, data.draw(st.sampled_from(container.columns)))


@pytest.mark.parametrize("name", CONTAINERS)
@settings(FEW, max_examples=8)
@given(st.data())
def test_what_is_written_is_read(name, data):
    check_written(data, name)


@pytest.mark.parametrize("name", CONTAINERS)
@settings(FEW, max_examples=8)
@given(st.data())
def test_numbers_that_no_sensor_reads_are_refused(name, data):
    check_written(data, name, NUMBERS)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTAINERS)
@MANY
@given(st.data())
def test_what_is_written_is_read_many(name, data):
    check_written(data, name, data.draw(st.sampled_from([None, NUMBERS])))


@pytest.mark.parametrize("name", CONTAINERS)
@settings(FEW, max_examples=25)
@given(st.data())
def test_a_damaged_file_is_read_or_refused(name, data):
    check_damaged(data, name)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTAINERS)
@settings(MANY, max_examples=4000)
@given(st.data())
def test_a_damaged_file_is_read_or_refused_many(name, data):
    check_damaged(data, name)


# Magic numbers, so that some bytes come past the first look.
STARTS = st.sampled_from(
    [b"", b"\x89HDF\r\n\x1a\n", b"PK\x03\x04", b"TDSm", b"\x89MCAP0\r\n", b"SQLite format 3\x00"]
)


@pytest.mark.parametrize("name", [name for name, container in CONTAINERS.items() if container.suffix])
@settings(FEW, max_examples=15)
@given(STARTS, st.binary(max_size=400))
def test_bytes_of_any_kind_are_refused(name, start, content):
    container = CONTAINERS[name]
    sound(name, container.layouts[0])
    assert in_file(start + content, container.suffix, container.columns[0]) is None


@settings(FEW, max_examples=15)
@given(st.sampled_from(["meta/info.json", "data/chunk-000/episode_000000.parquet"]), st.binary(max_size=400))
def test_a_dataset_of_bytes_of_any_kind_is_refused(name, content):
    files = sound("lerobot", "v2.1")
    assert in_container({**files, name: content}, CONTAINERS["lerobot"], LEROBOT) is None


# Declared sizes: what is not in the file is refused before memory is taken for it, which `outcome` checks.


def sheet(rows: str, head: str = "") -> bytes:
    """Return a workbook whose sheet has these rows as XML."""
    space = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    text = f'{head}<worksheet xmlns="{space}">{rows}</worksheet>'.encode()
    with zipfile.ZipFile(io.BytesIO(xlsx(steady_table(), "plain"))) as archive:
        parts = {info.filename: archive.read(info) for info in archive.infolist()}
    return packed({**parts, "xl/worksheets/sheet1.xml": text})


def cells(*values, row: int) -> str:
    """Return a row of a sheet as XML."""
    parts = [
        f'<c t="inlineStr"><is><t>{v}</t></is></c>' if isinstance(v, str) else f"<c><v>{v}</v></c>"
        for v in values
    ]
    return f'<row r="{row}">{"".join(parts)}</row>'


HEADER_ROW = cells("t", "q", "u", row=1)
BODY_ROWS = [cells(k / 500, 1.0, 2.0, row=k + 2) for k in range(60)]


def refuse_content(content: bytes, container: str, match: str, columns: Mapping | None = None) -> None:
    """Check that a file is refused with these words, and that little memory was taken."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{CONTAINERS[container].suffix}"
        path.write_bytes(content)
        columns = CONTAINERS[container].columns[0] if columns is None else columns
        assert outcome(path, columns) is None
        refuse(path, columns, match=match)


def test_a_sheet_of_a_wrong_dimension_is_read_whole():
    """Programs other than Excel state the first cell only, or a size of their own."""
    rows = HEADER_ROW + "".join(BODY_ROWS)
    for stated in ("A1", "A1:B7", "A1:XFD1048576"):
        content = sheet(f'<dimension ref="{stated}"/><sheetData>{rows}</sheetData>')
        log = in_file(content, ".xlsx")
        assert log is not None
        assert log.samples == 60


def test_a_row_beyond_the_last_one():
    for place in (2**20 + 1, 10**12):
        rows = HEADER_ROW + "".join(BODY_ROWS) + cells(1.0, 1.0, 1.0, row=place)
        content = sheet(f"<sheetData>{rows}</sheetData>")
        refuse_content(content, "excel", "sheet 'Sheet' has a row after 1048576, the last one of Excel")


def test_a_sheet_of_thousands_of_columns():
    """Each row has one cell in the last column that a name can have: 140 kB of None beside it."""
    rows = HEADER_ROW + "".join(
        row.replace("</row>", f'<c r="ZZZ{k + 2}"><v>1</v></c></row>')
        for k, row in enumerate(cells(k / 500, 1.0, 2.0, row=k + 2) for k in range(4000))
    )
    log = in_file(sheet(f"<sheetData>{rows}</sheetData>"), ".xlsx")
    assert log is not None
    assert log.samples == 4000


def test_entities_that_grow():
    head = "<!DOCTYPE x [<!ENTITY e0 'ha'>"
    head += "".join(f"<!ENTITY e{k + 1} '{f'&e{k};' * 10}'>" for k in range(9)) + "]>"
    rows = HEADER_ROW.replace(">t<", ">&e9;<") + "".join(BODY_ROWS)
    refuse_content(sheet(f"<sheetData>{rows}</sheetData>", head), "excel", "cannot be read")


def test_a_workbook_that_unpacks_to_gigabytes():
    content = sheet(f"<sheetData>{HEADER_ROW + ' ' * 10_000}</sheetData>")
    # The directory states the largest size that it can, for the last of its files.
    at = content.rindex(b"PK\x01\x02")
    content = content[: at + 24] + struct.pack("<I", 2**32 - 2) + content[at + 28 :]
    refuse_content(content, "excel", "unpacks from .* to 4096 MiB; at most 1024 MiB")
    content = content[: at + 24] + struct.pack("<I", 2**27) + content[at + 28 :]
    refuse_content(content, "excel", "unpacks from .* to 128 MiB; .* 200 times its size")


def one_dataset(**options) -> bytes:
    """Return an HDF5 file in which the position is a dataset made with these options."""
    h5py = pytest.importorskip("h5py")
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name in "tu":
            file[name] = steady_table()[name]
        file.create_dataset("q", **options)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"shape": (10**13,), "dtype": "f8", "chunks": (1024,)}, r"is 7.45e\+04 GiB large; at most 4 GiB"),
        ({"shape": (10**8,), "dtype": "f8", "chunks": (1024,)}, "100000000 values, and the file holds 0 "),
        ({"shape": (10**8,), "dtype": "f8"}, "declares 100000000 values, and the file holds 0 of them"),
        ({"shape": (10**8,), "dtype": "f8", "chunks": (1024,), "fillvalue": np.nan}, "the file holds 0 of"),
        ({"shape": (60,), "dtype": np.dtype(("f8", (10**8,)))}, "is 44.7 GiB large"),
        ({"shape": (60,), "dtype": "S10000000"}, "is not numeric"),
        ({"shape": (60,), "dtype": np.dtype([("q", "f8"), ("more", "V1000000")])}, "the file holds 0 of"),
    ],
    ids=["rows", "chunks", "plain", "nan", "arrays", "text", "table"],
)
def test_a_dataset_that_the_file_does_not_hold(options, match):
    refuse_content(one_dataset(**options), "hdf5", match)


def test_a_dataset_that_was_written_in_part(tmp_path):
    """A recorder makes room, and stops early: HDF5 gives zeros for the rest, which nobody measured."""
    h5py = pytest.importorskip("h5py")
    for fill in (0.0, np.nan):
        with h5py.File(tmp_path / "log.h5", "w") as file:
            for name, values in steady_table().items():
                options = {"chunks": (10,), "fillvalue": fill} if name == "q" else {}
                file.create_dataset(name, shape=(60,), dtype="f8", **options)
                file[name][: 50 if name == "q" else 60] = values[: 50 if name == "q" else 60]
        match = "declares 60 values, and the file holds 50" if fill == 0 else r"10 row\(s\) are NaN"
        refuse(tmp_path / "log.h5", match=match)
    assert read_log(tmp_path / "log.h5", {**COLUMNS, "rows": [0, 50]}).samples == 50


def test_a_dataset_without_a_shape_is_none():
    h5py = pytest.importorskip("h5py")
    refuse_content(one_dataset(data=h5py.Empty("f8")), "hdf5", "has no variable 'q'; there is: t, u")


def waveforms(**changed) -> bytes:
    """Return a TDMS file of two rates, whose times are properties, with other values or properties of `q`."""
    nptdms = pytest.importorskip("nptdms")
    buffer = io.BytesIO()
    with nptdms.TdmsWriter(buffer) as writer:
        for name, count, step in (("q", 300, 0.002), ("u", 60, 0.01)):
            properties = {"wf_increment": step, "wf_start_offset": 0.0}
            properties |= changed.get("properties", {}) if name == "q" else {}
            values = changed.get("values", np.arange(300) / 300) if name == "q" else np.ones(count)
            writer.write_segment([nptdms.ChannelObject("axis", name, values, properties=properties)])
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"values": ["text"] * 300}, "channel 'q': is not numeric"),
        ({"values": np.full(300, np.nan)}, "row.s. are NaN or infinite"),
        ({"properties": {"wf_increment": np.inf}}, r"has 0 reading\(s\)"),
        ({"properties": {"wf_increment": "fast"}}, "cannot be read"),
        ({"properties": {"wf_increment": 0.0}}, r"has 1 reading\(s\)"),
    ],
    ids=["text", "nan", "inf", "word", "zero"],
)
def test_waveforms_of_no_numbers(changed, match):
    wave = {**COLUMNS, "time": "wf_time"}
    assert in_file(waveforms(), ".tdms", wave) is not None
    refuse_content(waveforms(**changed), "tdms", match, wave)


@pytest.mark.parametrize("count", [10**8, 2**40, 2**64 - 1])
@pytest.mark.parametrize("kind", ["numbers", "text"])
def test_a_channel_that_declares_values_that_the_file_does_not_have(count, kind):
    values = [f"{k}" for k in range(60)] if kind == "text" else steady_table()["q"]
    content = tdms({**steady_table(), "q": values}, "plain")
    # The number of values stands behind the length of the index, the kind and the dimension.
    at = content.index(b"/'axis'/'q'") + len("/'axis'/'q'") + 12
    assert struct.unpack("<Q", content[at : at + 8]) == (60,)
    changed = content[:at] + struct.pack("<Q", count) + content[at + 8 :]
    refuse_content(changed, "tdms", "declares|cannot be read|is empty|not numeric|unequal lengths")


def test_a_tdms_file_that_was_not_closed_is_read_and_said(capfd):
    """LabVIEW writes the length of a segment when it ends; npTDMS then writes lines of its own on stderr."""
    content = tdms(steady_table(), "plain")
    open_end = content[:12] + b"\xff" * 8 + content[20:]
    log = in_file(open_end, ".tdms")
    assert log is not None
    assert [a.setting for a in log.assumed if a.value == "incomplete"] == ["last_segment"]
    refuse_content(open_end[:-9], "tdms", "unequal lengths: 't' 60, 'q' 60, 'u' 58")
    assert capfd.readouterr().err == ""


def dataset_with(**changed) -> dict[str, bytes]:
    """Return a LeRobot dataset whose info.json has other entries."""
    files = sound("lerobot", "v2.1")
    info = json.loads(files["meta/info.json"])
    return {**files, "meta/info.json": json.dumps({**info, **changed}).encode()}


FEATURE = {"dtype": "float64", "shape": [2], "names": ["shoulder_pan.pos", "elbow_flex.pos"]}
FEATURES = {"observation.state": FEATURE, "action": FEATURE, "timestamp": {"dtype": "float64", "shape": [1]}}


@pytest.mark.parametrize(
    "features",
    [
        None,
        ["observation.state", "action", "timestamp"],
        {**FEATURES, "action": 5},
        {**FEATURES, "action": {**FEATURE, "shape": ["a"]}},
        {**FEATURES, "action": {**FEATURE, "shape": 2}},
        {**FEATURES, "action": {**FEATURE, "shape": [float("inf")]}},
    ],
    ids=["none", "list", "number", "word", "no list", "infinite"],
)
def test_an_info_of_other_kinds(features):
    assert in_container(dataset_with(features=FEATURES), CONTAINERS["lerobot"], LEROBOT) is not None
    assert in_container(dataset_with(features=features), CONTAINERS["lerobot"], LEROBOT) is None


@pytest.mark.parametrize("names", [5, "ab", {"motors": 7}, {}, [["a", "b"]], [None, {}]])
def test_names_of_other_kinds_are_none(names):
    files = dataset_with(features={**FEATURES, "action": {**FEATURE, "names": names}})
    assert in_container(files, CONTAINERS["lerobot"], LEROBOT) is not None


def test_an_info_that_is_nested_deep():
    files = {**sound("lerobot", "v2.1"), "meta/info.json": b'{"features":' + b"[" * 200_000}
    assert in_container(files, CONTAINERS["lerobot"], LEROBOT) is None


def test_an_entry_that_the_data_do_not_have(tmp_path):
    wide = {**FEATURE, "shape": [3], "names": [*FEATURE["names"], "gripper.pos"]}
    for name, content in dataset_with(features={**FEATURES, "action": wide}).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    columns = {**LEROBOT, "force": "action[gripper.pos]"}
    refuse(tmp_path, columns, match=r"'action\[gripper.pos\]' is entry 3, and the data have 2")


def test_a_dataset_of_more_rows_than_any_log(monkeypatch):
    """Parquet packs equal numbers to nothing: the rows that it declares are looked at first."""
    monkeypatch.setattr("jaxid.logs.readers.array_files._LARGEST", 100)
    assert in_container(sound("lerobot", "v3.0"), CONTAINERS["lerobot"], LEROBOT) is None
    monkeypatch.setattr("jaxid.logs.readers.array_files._LARGEST", 480)
    assert in_container(sound("lerobot", "v3.0"), CONTAINERS["lerobot"], LEROBOT) is not None


def record(kind: int, content: bytes) -> bytes:
    """Return a record of an MCAP."""
    return struct.pack("<BQ", kind, len(content)) + content


def text(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def mcap_of_one_chunk(data: bytes, compression: bytes, size: int) -> bytes:
    """Return an MCAP without a summary, with one chunk that declares this size."""
    magic = b"\x89MCAP0\r\n"
    fixed = struct.pack("<QQQI", 0, 10**9, size, 0)
    chunk = record(6, fixed + text(compression) + struct.pack("<Q", len(data)) + data)
    return magic + record(1, text(b"ros2") + text(b"")) + chunk + record(2, bytes(20)) + magic


def zeros(compression: str, count: int) -> bytes:
    """Return a packed record of an unknown kind that has this many bytes, all zero, made a part at a time."""
    if compression == "lz4":
        packer = pytest.importorskip("lz4.frame").LZ4FrameCompressor()
        parts = [packer.begin()]
    else:
        packer = pytest.importorskip("backports.zstd").ZstdCompressor()
        parts = []
    parts.append(packer.compress(struct.pack("<BQ", 0x80, count - 9)))
    part = bytes(2**20)
    parts += [packer.compress(part) for _ in range(count // len(part))]
    return b"".join([*parts, packer.compress(part[: count % len(part) - 9]), packer.flush()])


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_a_chunk_that_unpacks_to_gigabytes(compression):
    sound("foxglove", "lz4")
    size = 2**30 + 20
    data = zeros(compression, size)
    assert len(data) < 2**23
    kind = compression.encode()
    refuse_content(mcap_of_one_chunk(data, kind, size), "mcap", "has a chunk that declares 1024 MiB")
    refuse_content(mcap_of_one_chunk(data, kind, 2**60), "mcap", "chunk that declares .* at most 256 MiB")
    match = "a chunk that unpacks to more than the 2000 bytes that it declares"
    refuse_content(mcap_of_one_chunk(data, kind, 2000), "mcap", match)


@pytest.mark.parametrize("size", [2**31, 2**40, 2**63 - 1, 2**64 - 1])
def test_lengths_of_records_that_the_file_does_not_have(size):
    sound("foxglove", "lz4")
    content = mcap_of_one_chunk(b"", b"", 0)
    refuse_content(content, "mcap", "has no topic")
    # The header is the first record, and the chunk is the next one.
    header = 9 + 8 + struct.unpack("<Q", content[9:17])[0]
    assert content[header] == 6
    for at in (9, header + 1):
        changed = content[:at] + struct.pack("<Q", size) + content[at + 8 :]
        refuse_content(changed, "mcap", "cannot be read")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ("UPDATE messages SET data = 1000000000 WHERE id = 1", "cannot be read"),
        ("UPDATE messages SET data = zeroblob(1000000) WHERE id = 1", "cannot be read|no entry"),
        ("UPDATE messages SET data = 'text'", "cannot be read"),
        ("UPDATE messages SET timestamp = 'noon' WHERE id = 5", "cannot be read"),
        ("UPDATE messages SET timestamp = 9e18 WHERE id = 5", "which no clock gives"),
        ("UPDATE topics SET type = 'std_msgs/msg/Nothing'", "cannot be read"),
        ("UPDATE topics SET name = 7", "cannot be read|has no topic"),
        ("UPDATE message_definitions SET encoded_message_definition = 'int32 a'", "cannot be read|have no"),
        ("DELETE FROM messages", "has no topic"),
        ("DROP TABLE messages", "cannot be read"),
    ],
)
def test_a_database_with_other_contents(tmp_path, change, match):
    (tmp_path / "log.db3").write_bytes(sound("db3", "db3 two"))
    with contextlib.closing(sqlite3.connect(tmp_path / "log.db3")) as database:
        database.execute(change)
        database.commit()
    assert outcome(tmp_path / "log.db3", ROS) is None
    refuse(tmp_path / "log.db3", ROS, match=match)


@pytest.mark.parametrize(
    ("unit", "stated"),
    [
        ("mm", "mm"),
        (np.bytes_("mm"), "mm"),
        (np.array([b"mm"]), "mm"),
        (np.bytes_(b"\xb0"), "\ufffd"),
        (b"\xff\xfe", "\ufffd\ufffd"),
        (np.array([], dtype="f8"), None),
        (5.0, None),
    ],
    ids=["text", "bytes", "array", "latin", "neither", "empty", "number"],
)
def test_units_of_any_kind(tmp_path, unit, stated):
    """A unit that is no text is none, and one in another encoding can be printed."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values in steady_table().items():
            file[name] = values
        file["q"].attrs["units"] = unit
    units = contents_of(tmp_path / "log.h5").units
    assert units == ({} if stated is None else {"q": stated})
    "".join(units.values()).encode()
    log = outcome(tmp_path / "log.h5")
    assert log is not None
    scale = 1e-3 if stated == "mm" else 1.0
    np.testing.assert_allclose(log.position[:, 0], scale * steady_table()["q"], rtol=1e-12)
