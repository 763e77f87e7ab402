"""Channels of TDMS files, as LabVIEW and DIAdem write them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError, cause, suggest
from jaxid.logs.readers.array_files import need_size, pick_columns
from jaxid.logs.readers.extras import need
from jaxid.logs.readers.rows import Rows
from jaxid.logs.readers.table import Assumed, Table, on_one_time

# Name of the time that the waveform properties of a channel give.
WAVEFORM_TIME = "wf_time"


def read_tdms(path: Path, names: list[str], rows: Rows | None) -> Table:
    """Read channels of a TDMS file; see `read_table`. Needs npTDMS.

    A channel's name is "group/channel", or the last part if it is the only one of that name. `wf_time` is the
    time that the properties wf_start_offset and wf_increment of the channels give.
    """
    nptdms = need("nptdms", path, "TDMS")
    said: list[Assumed] = []
    try:
        with quiet(), path.open("rb") as raw, nptdms.TdmsFile.open(raw) as file:
            channels = _channels(file)
            found = {name: _channel(name, channels, path) for name in names if name != WAVEFORM_TIME}
            for name, channel in found.items():
                _need_held(channel, path, f"{path}, channel '{name}'")
            if file.file_status.incomplete_final_segment:
                said.append(Assumed("last_segment", "incomplete", "the file ends early, and is read so far"))
            values = {name: _numbers(channel, f"{path}, channel '{name}'") for name, channel in found.items()}
            tracks = {name: _track(c, path) for name, c in found.items()} if WAVEFORM_TIME in names else {}
            units = {
                n: str(c.properties["unit_string"])
                for n, c in found.items()
                if c.properties.get("unit_string")
            }
    except (InputError, OSError):
        raise
    except Exception as error:
        # A damaged file raises errors of many kinds.
        what = f"cannot be read ({cause(error)})"
        raise InputError(what, where=str(path), hint="is it a TDMS file? export it again") from error

    sparse: frozenset[str] = frozenset()
    if tracks:
        reason = "of the channels' properties wf_start_offset and wf_increment"
        said.append(Assumed("time", WAVEFORM_TIME, reason))
        first = next(iter(tracks.values()))
        if all(np.array_equal(first, t) for t in tracks.values()):
            values[WAVEFORM_TIME] = first
        else:
            whole = frozenset(name for name, v in values.items() if not np.isnan(v).any())
            time, columns = on_one_time({n: (t, values[n][:, None]) for n, t in tracks.items()})
            values = {WAVEFORM_TIME: time, **columns}
            # A time without a reading is none; NaN in a channel is a fault, as in any other format.
            sparse = whole

    columns, taken = pick_columns(path, values, names, rows)
    return Table(columns, taken, units, tuple(said), sparse)


@contextmanager
def quiet() -> Iterator[None]:
    """Keep the lines from stderr that npTDMS writes there of itself."""
    from nptdms.log import log_manager

    level = log_manager.log_level
    log_manager.set_level(logging.CRITICAL)
    try:
        yield
    finally:
        log_manager.set_level(level)


def _need_held(channel: Any, path: Path, where: str) -> None:
    """Refuse a channel that declares more values than its file has bytes, before memory is taken for it.

    Raises:
        InputError: If it does, or is larger than any log.
    """
    size = path.stat().st_size
    if len(channel) > size:
        what = f"declares {len(channel)} values, and the file has {size} bytes"
        raise InputError(what, where=where, hint="export it again")
    need_size(8.0 * len(channel), where)


def _channels(file: Any) -> dict[str, list[Any]]:
    out: dict[str, list[Any]] = {}
    for group in file.groups():
        for channel in group.channels():
            for name in (channel.name, f"{group.name}/{channel.name}"):
                out.setdefault(name, []).append(channel)
    return out


def _channel(name: str, channels: dict[str, list[Any]], path: Path) -> Any:
    found = channels.get(name, [])
    if not found:
        raise InputError(f"has no channel '{name}'", where=str(path), hint=suggest(name, channels))
    if len(found) > 1:
        hint = f"write '{found[0].group_name}/{name}'"
        raise InputError(f"has {len(found)} channels '{name}'", where=str(path), hint=hint)
    return found[0]


def _track(channel: Any, path: Path) -> np.ndarray:
    """Return the times of a channel that its waveform properties give [s]."""
    try:
        # Properties that are no numbers make times that are none, which are refused with their row.
        with np.errstate(all="ignore"):
            return np.asarray(channel.time_track(), dtype=np.float64)
    except KeyError as error:
        hint = "name a channel as time, or give sample_rate"
        raise InputError(
            f"channel '{channel.name}' has no wf_increment", where=str(path), hint=hint
        ) from error


def _numbers(channel: Any, where: str) -> np.ndarray:
    """Read the numbers of a channel; time stamps as seconds since the first one.

    Raises:
        InputError: If they are not numbers.
    """
    values = np.asarray(channel[:])
    if values.dtype.kind == "M":
        return (values - values[:1]).astype("timedelta64[ns]").astype(np.float64) * 1e-9
    if values.dtype.kind not in "fiub":
        hint = "name a channel of real numbers"
        raise InputError(f"is not numeric ({values.dtype})", where=where, hint=hint)
    return values
