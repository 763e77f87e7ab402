"""The names of all columns that a log has, before it is known which of them are needed."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError, cause
from jaxid.logs.readers import READERS, Reader, reader_of
from jaxid.logs.readers.array_files import header_of
from jaxid.logs.readers.csv_file import dialect_of, read_csv
from jaxid.logs.readers.dialect import Dialect, bare, cells_of, split_unit
from jaxid.logs.readers.excel_file import header_of_book
from jaxid.logs.readers.extras import need
from jaxid.logs.readers.hdf5_file import datasets_of, read_hdf5
from jaxid.logs.readers.lerobot import info_of, read_lerobot, root_of
from jaxid.logs.readers.mat_file import MatFile
from jaxid.logs.readers.ros_bag import HEADER, JOINT_VECTORS, need_chunks, read_ros
from jaxid.logs.readers.tdms_file import WAVEFORM_TIME, quiet, read_tdms
from jaxid.logs.units import parse_unit

# Most entries of an array in a message that count as columns: longer ones are pictures and clouds.
_MOST_ENTRIES = 64
# Head of the time before each channel of a TwinCAT Scope.
_SCOPE_TIME = "Name"
# Depth to which the fields of a message are followed.
_DEPTH = 4


@dataclass(frozen=True)
class Contents:
    """The columns of a log.

    Attributes:
        names: Names as `[log]` takes them; a time that stands before each group of columns once only.
        units: Units that the file states, by name.
        time: Name of the time, if the format has one of its own; empty: it is one of the names, or missing.
        episodes: Number of episodes of a dataset; 0: the format has none.
    """

    names: tuple[str, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    time: str = ""
    episodes: int = 0


def contents_of(path: Path) -> Contents:
    """Return the columns of a file.

    Raises:
        InputError: If the file cannot be read, or its format lists no columns.
    """
    reader = reader_of(path, None)
    try:
        return _of_reader(path, reader)
    except InputError:
        raise
    except Exception as error:
        # A damaged file raises errors of a dozen kinds.
        hint = "is it a log of its suffix? export it again"
        raise InputError(f"cannot be read ({cause(error)})", where=str(path), hint=hint) from error


def _of_reader(path: Path, reader: Reader) -> Contents:
    if reader is read_csv:
        return _of_text(path)
    if reader is read_ros:
        return _of_ros(path)
    if reader is read_lerobot:
        return _of_lerobot(path)
    if reader is read_hdf5:
        return _of_hdf5(path)
    if reader is read_tdms:
        return _of_tdms(path)
    suffix = path.suffix.lower()
    if reader is READERS.get(".xlsx"):
        return _with_units(header_of_book(path))
    if reader is READERS.get(".npz"):
        return Contents(tuple(_of_archive(path)))
    if reader is READERS.get(".mat"):
        return _of_matlab(path)
    if reader is READERS.get(".parquet"):
        schema = need("pyarrow.parquet", path, "Parquet").read_schema(path)
        return Contents(tuple(schema.names))
    hint = "write the case by hand, see docs/case_file.md"
    raise InputError(f"the columns of a '{suffix}' cannot be listed", where=str(path), hint=hint)


def _with_units(header: Sequence[str], units: Sequence[str] = ()) -> Contents:
    """Return the columns of a header; the unit of a name is cut off where names stay distinct."""
    kept = [name for name in header if name]
    bare_names = [split_unit(name)[0] for name in header]
    names, found = [], {}
    for k, name in enumerate(header):
        if not name:
            continue
        short = bare_names[k]
        shown = short if bare_names.count(short) == kept.count(name) else name
        if shown not in names:
            names.append(shown)
            unit = units[k] if k < len(units) and units[k] else split_unit(name)[1]
            found |= {shown: unit} if unit else {}
    return Contents(tuple(names), found)


def _of_text(path: Path) -> Contents:
    """Return the header of a text table: the last line of text above the numbers that is no row of units."""
    dialect, lines = dialect_of(path, [])
    scope = _scope_header(lines, dialect)
    if scope is not None:
        dialect, _ = dialect_of(path, scope)
        return replace(_with_units(dialect.header, dialect.units), time=_SCOPE_TIME)
    cells = [cell for cell in dialect.header if cell]
    if cells and not dialect.units.count("") == 0 and _are_units(cells):
        above = _line_above(lines, dialect)
        if above is not None:
            dialect, _ = dialect_of(path, above)
    return _with_units(dialect.header, dialect.units)


def _scope_header(lines: Sequence[str], dialect: Dialect) -> list[str] | None:
    """Return the channels of a row as a TwinCAT Scope writes it, "Name" before each; None without one.

    Rows of metadata, a key before each value, stand between it and the numbers.
    """
    for line in lines:
        cells = cells_of(bare(line), dialect.separator)
        if len(cells) > 3 and set(cells[::2]) == {_SCOPE_TIME} and all(cells[1::2]):
            return list(dict.fromkeys(cells[1::2]))
    return None


def _are_units(cells: Sequence[str]) -> bool:
    """Check whether cells are units: all known ones, or signs for none, and at least two of them known."""
    known = [parse_unit(cell.strip("[]() ")) is not None for cell in cells]
    blank = [cell.strip("[]() ") in ("", "-", "1") for cell in cells]
    return sum(known) > 1 and all(k or b for k, b in zip(known, blank, strict=True))


def _line_above(lines: Sequence[str], dialect: Dialect) -> list[str] | None:
    """Return the names in the line above a row of units; None if there is no such line."""
    rows = [cells_of(bare(line), dialect.separator) for line in lines if line.strip()]
    for above, row in zip(rows, rows[1:], strict=False):
        if tuple(row) == dialect.header and len(above) >= len(row) - 1:
            return list(dict.fromkeys(name for name in above if name))
    return None


def _of_archive(path: Path) -> Iterator[str]:
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            shape, kind = header_of(archive, info)
            if not kind.hasobject:
                yield from _columns(info.filename.removesuffix(".npy"), shape)


def _columns(name: str, shape: Sequence[int]) -> Iterator[str]:
    """Return the names of the columns of an array; none if it is no log of samples."""
    long = [n for n in shape if n > 1]
    if len(long) == 1:
        yield name
    elif len(long) == 2 and min(long) <= _MOST_ENTRIES:
        yield from (f"{name}[{k + 1}]" for k in range(min(long)))


def _of_matlab(path: Path) -> Contents:
    content = path.read_bytes()
    if content[124:128] in (b"\x00\x02IM", b"\x02\x00MI"):
        return _of_hdf5(path)
    if content[126:128] in (b"IM", b"MI"):
        found = [v for v in MatFile(content).variables.values() if v.numeric]
        return Contents(tuple(name for v in found for name in _columns(v.name, v.shape)))
    from scipy.io import whosmat

    return Contents(tuple(name for base, shape, _ in whosmat(path) for name in _columns(base, shape)))


def _of_hdf5(path: Path) -> Contents:
    names, units = [], {}
    for name, shape, unit in datasets_of(path):
        columns = list(_columns(name, shape))
        names += columns
        units |= dict.fromkeys(columns, unit) if unit else {}
    return Contents(tuple(names), units)


def _of_tdms(path: Path) -> Contents:
    nptdms = need("nptdms", path, "TDMS")
    names, units, waveform = [], {}, False
    with quiet(), path.open("rb") as raw, nptdms.TdmsFile.open(raw) as file:
        for group in file.groups():
            for channel in group.channels():
                name = f"{group.name}/{channel.name}"
                names.append(name)
                waveform |= "wf_increment" in channel.properties
                unit = channel.properties.get("unit_string")
                units |= {name: str(unit)} if unit else {}
    return Contents(tuple(names), units, WAVEFORM_TIME if waveform else "")


def _of_lerobot(path: Path) -> Contents:
    root = root_of(path)
    assert root is not None, "the caller found the dataset"
    info = info_of(root)
    names: list[str] = []
    for name, feature in info.features.items():
        if name == "timestamp" or feature.kind.startswith("float"):
            named = len(feature.entries) == feature.width
            entries = feature.entries if named else range(1, min(feature.width, _MOST_ENTRIES) + 1)
            names += [name] if feature.width == 1 else [f"{name}[{entry}]" for entry in entries]
    return Contents(tuple(names), {}, "timestamp", info.episodes)


def _of_ros(path: Path) -> Contents:
    highlevel = need("rosbags.highlevel", path, "a ROS recording")
    typesys = need("rosbags.typesys", path, "a ROS recording")
    names: list[str] = []
    try:
        need_chunks(path)
        store = typesys.get_typestore(typesys.Stores.LATEST)
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            for topic, info in reader.topics.items():
                connections = [c for c in reader.connections if c.topic == topic]
                first = next(iter(reader.messages(connections=connections)), None) if info.msgcount else None
                if first is None:
                    continue
                try:
                    message = reader.deserialize(first[2], first[0].msgtype)
                except Exception:
                    # A message without a known definition is no column; the others are.
                    continue
                names += [f"{topic}.{name}" for name in _fields(message, _joints(message))]
    except (InputError, OSError):
        raise
    except Exception as error:
        what = f"cannot be read ({cause(error)})"
        hint = "is it a ROS recording? `ros2 bag info` shows"
        raise InputError(what, where=str(path), hint=hint) from error
    return Contents(tuple(names), {}, HEADER)


def _joints(message: Any) -> list[str]:
    """Return the names of the joints of a message; empty if it has none."""
    for name in ("name", "joint_names"):
        given = getattr(message, name, None)
        if isinstance(given, list) and all(isinstance(joint, str) for joint in given):
            return [str(joint) for joint in given]
    return []


def _fields(message: Any, joints: Sequence[str], depth: int = _DEPTH) -> Iterable[str]:
    """Return the numbers of a message as names of columns, without those of its header."""
    for name in getattr(message, "__dataclass_fields__", {}):
        value = getattr(message, name)
        if name.startswith("_") or name == "header":
            continue
        if isinstance(value, float) and not isinstance(value, bool):
            yield name
        elif isinstance(value, int) and not isinstance(value, bool) and name == "data":
            yield name
        elif isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.size <= _MOST_ENTRIES:
            by_name = depth == _DEPTH and name in JOINT_VECTORS and len(joints) == value.size
            named = joints if by_name else [str(k + 1) for k in range(value.size)]
            yield from (f"{name}[{entry}]" for entry in named)
        elif hasattr(value, "__dataclass_fields__") and depth > 1:
            yield from (f"{name}.{below}" for below in _fields(value, joints, depth - 1))
