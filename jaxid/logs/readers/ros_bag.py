"""Topics of ROS recordings: rosbag2 (SQLite and MCAP), single MCAP files, and ROS 1 bags.

A column is a field of a topic's messages, "/joint_states.position[elbow]". Each topic has a clock and a rate.
Times of messages are taken from their headers and led to the clock of the recorder by a line, which takes off
the offset and the drift between computers, and all but the shortest of the transport's delay.
"""

from __future__ import annotations

import importlib
import re
import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError, cause, suggest
from jaxid.logs.readers.array_files import pick_columns
from jaxid.logs.readers.extras import need
from jaxid.logs.readers.rows import Rows
from jaxid.logs.readers.table import Assumed, Table, on_one_time

# Names that `time` may have: of the message's header, or of the recorder.
HEADER, RECORDED = "header.stamp", "log_time"
_JOINTS = "sensor_msgs/msg/JointState"
# Fields of a joint state whose entries have the names of joints.
JOINT_VECTORS = ("position", "velocity", "effort")
_NAME = re.compile(r"(?P<topic>[^.]+)\.(?P<field>[^\[\]]+)(\[(?P<entry>.+)\])?$")
# Messages whose bytes are read at once.
_PART = 20_000
# Offset between two clocks that is reported [s], and their drift.
_OFFSET, _DRIFT = 1e-3, 1e-5
# Largest chunk of an MCAP [bytes]; chosen: 300 times that of ROS.
_CHUNK = 2**28
# Nanoseconds in a second. Stamps are counted in whole ones: as seconds since 1970 they would have 0.2 us.
_SECOND = 10**9
# Stamp of a message without header, and the last one that a recorder gives: the year 2116 [ns].
_NONE, _LAST = np.iinfo(np.int64).min, 2**62


@dataclass(frozen=True)
class _Column:
    """One wanted column: topic, field of its messages, and entry of an array (empty: all)."""

    topic: str
    path: str
    entry: str


@dataclass
class _Topic:
    """Messages of one topic, as far as they are wanted; times are whole nanoseconds."""

    columns: dict[str, _Column]
    recorded: list[np.ndarray] = field(default_factory=list)
    stamps: list[np.ndarray] = field(default_factory=list)
    values: dict[str, list[np.ndarray]] = field(default_factory=dict)


def read_ros(path: Path, names: list[str], rows: Rows | None) -> Table:
    """Read fields of topics; see `read_table`. Needs rosbags.

    Args:
        path: Folder of a rosbag2, or a file .mcap, .db3 or .bag.
        names: Fields, as "/joint_states.position[elbow]" (a joint by its name), "/command.data[2]" (an entry,
            from 1) or "/imu.angular_velocity.z"; and as time "header.stamp", or "log_time" of the recorder.
        rows: Rows of the joined topics.
    """
    highlevel = need("rosbags.highlevel", path, "a ROS recording")
    typesys = need("rosbags.typesys", path, "a ROS recording")
    clocks = [name for name in names if name in (HEADER, RECORDED)]
    if len(clocks) != 1:
        hint = f'say time = "{HEADER}" in [log], or "{RECORDED}" for the clock of the recorder'
        raise InputError(
            "the time of a message is of its header or of the recorder", where=str(path), hint=hint
        )
    wanted = {name: _column(name, path) for name in names if name not in clocks}

    try:
        need_chunks(path)
        store = typesys.get_typestore(typesys.Stores.LATEST)
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            _check_topics(wanted, reader, path)
            topics = {
                topic: _read(reader, topic, {n: c for n, c in wanted.items() if c.topic == topic}, path)
                for topic in dict.fromkeys(c.topic for c in wanted.values())
            }
    except (InputError, OSError):
        raise
    except Exception as error:
        # A damaged recording raises errors of a dozen kinds, down to those of SQLite and of the compression.
        what = f"cannot be read ({cause(error)})"
        raise InputError(
            what, where=str(path), hint="is it a ROS recording? `ros2 bag info` shows"
        ) from error

    times, said = _times(topics, clocks[0] == HEADER, path)
    readings = {
        name: (times[topic], np.concatenate(of.values[name]))
        for topic, of in topics.items()
        for name in of.columns
    }
    time, columns = on_one_time(readings)
    known = {clocks[0]: time, **columns}
    picked, taken = pick_columns(path, known, names, rows)
    # A time without a message is no reading; NaN in a message is a fault, as in any other format.
    whole = frozenset(name for name, (_, values) in readings.items() if not np.isnan(values).any())
    return Table(picked, taken, {}, tuple(said), whole)


def need_chunks(path: Path) -> None:
    """Refuse an MCAP with a chunk that unpacks to more than it declares, or to more than chunks have.

    The library unpacks a chunk at once, and compares its size with the declared one afterwards.

    Args:
        path: A file, or the folder of a rosbag2; files of other formats have no chunks.

    Raises:
        InputError: If there is such a chunk.
    """
    for file in [path] if path.is_file() else sorted(path.glob("*.mcap")):
        for size, compression, data in _chunks(file) if file.suffix.lower() == ".mcap" else ():
            if size > _CHUNK:
                what = f"has a chunk that declares {size / 2**20:.4g} MiB"
                hint = f"at most {_CHUNK / 2**20:g} MiB: record it with smaller chunks"
                raise InputError(what, where=str(file), hint=hint)
            if not _unpacks_to(data, compression, size):
                what = f"has a chunk that unpacks to more than the {size} bytes that it declares"
                raise InputError(what, where=str(file), hint="record it again")


def _chunks(file: Path) -> Iterator[tuple[int, bytes, bytes]]:
    """Yield declared size, compression and data of each chunk of an MCAP, up to a record that is cut off.

    Source:
        MCAP, "Format specification": records of a byte of kind and 8 of length, chunks are kind 6.
    """
    whole = file.stat().st_size
    with file.open("rb") as raw:
        at = len(b"\x89MCAP0\r\n")
        while at + 9 <= whole:
            raw.seek(at)
            kind, length = struct.unpack("<BQ", raw.read(9))
            at += 9 + length
            if kind == 6 and length >= 40 and at <= whole:
                size, _, name = struct.unpack("<QII", raw.read(32)[16:])
                compression = raw.read(min(name, length))
                packed = int.from_bytes(raw.read(8), "little")
                yield size, compression, raw.read(min(packed, length))


def _unpacks_to(data: bytes, compression: bytes, size: int) -> bool:
    """Check that data unpack to at most this size, a part at a time; the library refuses damaged ones."""
    if compression == b"zstd":
        known = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
        unpacker = importlib.import_module(known).ZstdDecompressor()
    elif compression == b"lz4":
        unpacker = importlib.import_module("lz4.frame").LZ4FrameDecompressor()
    else:
        return True
    try:
        while not unpacker.eof and size >= 0:
            part = unpacker.decompress(data, max_length=2**20)
            if not part and unpacker.needs_input:
                break
            size, data = size - len(part), b""
    except Exception:
        return True
    return size >= 0


def _column(name: str, path: Path) -> _Column:
    match = _NAME.match(name)
    if match is None:
        hint = 'write topic, field and entry: "/joint_states.position[elbow]"'
        raise InputError(f"'{name}' names no field of a topic", where=str(path), hint=hint)
    return _Column(match["topic"], match["field"], match["entry"] or "")


def _check_topics(wanted: Mapping[str, _Column], reader: Any, path: Path) -> None:
    for column in wanted.values():
        if column.topic not in reader.topics or not reader.topics[column.topic].msgcount:
            there = [name for name, info in reader.topics.items() if info.msgcount]
            raise InputError(
                f"has no topic '{column.topic}'", where=str(path), hint=suggest(column.topic, there)
            )


def _read(reader: Any, topic: str, columns: dict[str, _Column], path: Path) -> _Topic:
    """Read the wanted fields of all messages of a topic."""
    out = _Topic(columns, values={name: [] for name in columns})
    connections = [c for c in reader.connections if c.topic == topic]
    for part in _parts(reader.messages(connections=connections)):
        kind = part[0][0].msgtype
        recorded = np.array([stamp for _, stamp, _ in part], dtype=np.int64)
        if recorded.min() < 0 or recorded.max() > _LAST:
            k = int(np.argmax((recorded < 0) | (recorded > _LAST)))
            what = f"a message of '{topic}' was recorded at {recorded[k]} ns since 1970, which no clock gives"
            raise InputError(what, where=str(path), hint="record it again")
        out.recorded.append(recorded)
        quick = kind == _JOINTS and all(c.path in JOINT_VECTORS for c in columns.values())
        if not (quick and reader.is2 and _quickly([raw for _, _, raw in part], out, path)):
            for connection, _, raw in part:
                message = reader.deserialize(raw, connection.msgtype)
                _add(message, out, path)
    if not out.recorded:
        raise InputError(f"no message of '{topic}' can be read", where=str(path), hint="record it again")
    return out


def _parts(messages: Iterator[Any]) -> Iterator[list[Any]]:
    part = []
    for message in messages:
        part.append(message)
        if len(part) == _PART:
            yield part
            part = []
    if part:
        yield part


def _add(message: Any, out: _Topic, path: Path) -> None:
    """Add the wanted fields of one message."""
    header = getattr(message, "header", None)
    stamp = getattr(header, "stamp", None)
    at = _NONE if stamp is None else stamp.sec * _SECOND + stamp.nanosec
    out.stamps.append(np.array([at], dtype=np.int64))
    for name, column in out.columns.items():
        value: Any = message
        for part in column.path.split("."):
            if not hasattr(value, part):
                fields = [f for f in getattr(value, "__dataclass_fields__", {}) if not f.startswith("_")]
                raise InputError(
                    f"messages of '{column.topic}' have no '{part}'",
                    where=str(path),
                    hint=suggest(part, fields),
                )
            value = getattr(value, part)
        joints = (
            [str(joint) for joint in getattr(message, "name", [])] if column.path in JOINT_VECTORS else []
        )
        value = np.atleast_1d(np.asarray(value, dtype=np.float64))
        value = value if not column.entry else value[[_entry(column, joints, value.size, path)]]
        out.values[name].append(value[None, :])


def _entry(column: _Column, joints: Sequence[str], size: int, path: Path) -> int:
    """Return the entry of an array, from 0: a joint by its name, or a number from 1."""
    if column.entry in joints and joints.index(column.entry) < size:
        return joints.index(column.entry)
    if column.entry.isdigit() and 1 <= int(column.entry) <= size:
        return int(column.entry) - 1
    what = f"'{column.topic}.{column.path}' has no entry '{column.entry}'"
    hint = suggest(column.entry, joints) if joints and size else f"it has {size}"
    raise InputError(what, where=str(path), hint=hint)


def _quickly(raws: Sequence[bytes], out: _Topic, path: Path) -> bool:
    """Read joint states of one layout at once; return whether they are of one.

    Messages with the same names have their numbers at the same bytes.
    """
    first = bytes(raws[0])
    layout = _layout(first)
    if layout is None or any(len(raw) != len(first) for raw in raws):
        return False
    joints, starts, sizes, text = layout
    block = np.frombuffer(b"".join(raws), dtype=np.uint8).reshape(len(raws), len(first))
    if np.any(block[:, 12:text] != block[0, 12:text]):
        return False
    for vector in JOINT_VECTORS:
        # Lengths of the arrays are the same too.
        at = starts[vector] - 8
        if np.any(block[:, at : at + 8] != block[0, at : at + 8]) and sizes[vector]:
            return False
    order = "<" if first[1] else ">"

    def numbers(kind: str, at: int, count: int) -> np.ndarray:
        size = np.dtype(kind).itemsize * count
        return np.ascontiguousarray(block[:, at : at + size]).view(f"{order}{kind}")

    stamps = numbers("i4", 4, 1)[:, 0].astype(np.int64) * _SECOND + numbers("u4", 8, 1)[:, 0]
    for name, column in out.columns.items():
        values = numbers("f8", starts[column.path], sizes[column.path]).astype(np.float64)
        if column.entry:
            values = values[:, [_entry(column, joints, sizes[column.path], path)]]
        out.values[name].append(values)
    out.stamps.append(stamps)
    return True


def _layout(raw: bytes) -> tuple[list[str], dict[str, int], dict[str, int], int] | None:
    """Return names, places and lengths of the arrays of a joint state, and the end of its names.

    Source:
        OMG, "Common Data Representation": numbers stand at multiples of their size, after 4 bytes of header.
    """
    order = "<" if raw[1] else ">"

    def count(at: int) -> tuple[int, int]:
        at = 4 + -(-(at - 4) // 4) * 4
        return struct.unpack_from(f"{order}I", raw, at)[0], at + 4

    try:
        length, at = count(12)
        names, at = count(at + length)
        joints = []
        for _ in range(names):
            length, at = count(at)
            joints.append(raw[at : at + length].rstrip(b"\0").decode())
            at += length
        text, starts, sizes = at, {}, {}
        for vector in JOINT_VECTORS:
            sizes[vector], at = count(at)
            # An empty array takes no place, and no alignment.
            at = 4 + -(-(at - 4) // 8) * 8 if sizes[vector] else at
            starts[vector] = at
            at += 8 * sizes[vector]
    except (struct.error, UnicodeDecodeError):
        return None
    return (joints, starts, sizes, text) if at <= len(raw) else None


def _times(
    topics: Mapping[str, _Topic], by_header: bool, path: Path
) -> tuple[dict[str, np.ndarray], list[Assumed]]:
    """Return the times of each topic's messages on one clock, from the first of them on [s]."""
    recorded = {name: np.concatenate(of.recorded) for name, of in topics.items()}
    begin = min(t[0] for t in recorded.values())
    if not by_header:
        said = [Assumed("time", RECORDED, "the clock of the recorder, with the delay of the transport")]
        return {name: (t - begin) / _SECOND for name, t in recorded.items()}, said

    stamped = {name: np.concatenate(of.stamps) for name, of in topics.items()}
    stamped = {name: t for name, t in stamped.items() if t.any() and not (t == _NONE).any()}
    times, said = {}, []
    for name, t in recorded.items():
        if name not in stamped:
            reason = (
                f"messages of {name} have no stamp: the recorder's clock, with the delay of the transport"
            )
            said.append(Assumed("time", RECORDED, reason))
            times[name] = (t - begin) / _SECOND
            continue
        since = (stamped[name] - stamped[name][0]) / _SECOND
        if len(topics) == 1:
            return {name: since}, said

        # Clocks may be years apart: that part of the offset is taken off in whole nanoseconds.
        apart = int(t[0]) - int(stamped[name][0])
        offset, drift = _line(since, (t - stamped[name] - apart) / _SECOND)
        times[name] = (t[0] - begin) / _SECOND + offset + (1 + drift) * since
        offset += apart / _SECOND
        if abs(offset) > _OFFSET or abs(drift) > _DRIFT:
            reason = (
                f"stamps of {name} are {offset:+.4g} s from the recorder's clock and drift by "
                f"{1e6 * drift:+.3g} ppm: a line takes off both"
            )
            said.append(Assumed("clock", name, reason))
    return times, said


def _line(since: np.ndarray, delay: np.ndarray) -> tuple[float, float]:
    """Return offset and drift of the recorder's clock from the stamps: a line below the differences.

    A message is recorded after its stamp, so the smallest delays show the clocks. The line goes through the
    smallest differences of the first and of the last tenth.

    Args:
        since: Stamps, from the first one on [s].
        delay: Time of the record less the stamp, up to a constant [s].
    """
    part = max(since.size // 10, 1)
    first, last = int(np.argmin(delay[:part])), since.size - part + int(np.argmin(delay[-part:]))
    span = since[last] - since[first]
    drift = float((delay[last] - delay[first]) / span) if span > 0 and since.size > 100 else 0.0
    return float(delay[first] - drift * since[first]), drift
