"""Episodes of LeRobot datasets, in the layouts v2 (a file each) and v3 (many in a file)."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError, cause, suggest
from jaxid.logs.readers.array_files import need_size, pick_columns
from jaxid.logs.readers.extras import need
from jaxid.logs.readers.rows import Rows
from jaxid.logs.readers.table import Assumed, Table
from jaxid.settings import LogTable

# The file that a dataset has in both layouts.
INFO = "meta/info.json"
_NAMED = re.compile(r"(?P<feature>[^\[\]]+)\[(?P<entry>.+)\]$")


@dataclass(frozen=True)
class Feature:
    """A column of a dataset.

    Attributes:
        kind: Type of its numbers, as "float32".
        width: Numbers in each sample.
        entries: Their names; empty: they have none.
    """

    kind: str
    width: int
    entries: tuple[str, ...]


@dataclass(frozen=True)
class Info:
    """What a dataset says of itself: its features by name, and the number of its episodes."""

    features: Mapping[str, Feature]
    episodes: int


def root_of(path: Path) -> Path | None:
    """Return the folder of the dataset that a file or folder belongs to; None if it is in none."""
    return next((folder for folder in (path, *path.resolve().parents) if (folder / INFO).is_file()), None)


def read_lerobot(path: Path, names: list[str], rows: Rows | None, settings: LogTable | None = None) -> Table:
    """Read one episode of a LeRobot dataset; see `read_table`. Needs pyarrow.

    Args:
        path: Folder of the dataset, or one of its data files.
        names: Features, as "timestamp", and their entries, as "observation.state[elbow_flex.pos]" or
            "action[3]", counted from 1.
        rows: Rows of the episode.
        settings: The `[log]` table, for `episode`.
    """
    parquet = need("pyarrow.parquet", path, "LeRobot")
    root = root_of(path)
    assert root is not None, "the caller found the dataset"
    features = info_of(root).features
    wanted = {name: _feature(name, features, path) for name in names}
    files = [path] if path.is_file() else sorted((root / "data").rglob("*.parquet"))
    episode = None if settings is None else settings.episode

    try:
        for file in files:
            need_size(8.0 * parquet.read_metadata(file).num_rows, str(file))
        there = {
            f: np.unique(parquet.read_table(f, columns=["episode_index"])["episode_index"].to_numpy())
            for f in files
        }
        known = sorted({int(k) for episodes in there.values() for k in episodes})
        said: tuple[Assumed, ...] = ()
        if episode is None:
            if len(known) != 1:
                hint = (
                    f"say episode = <number> in [log], one of {known[0]} to {known[-1]}"
                    if known
                    else "record some"
                )
                raise InputError(f"has {len(known)} episodes", where=str(path), hint=hint)
            episode = known[0]
            said = (Assumed("episode", episode, "the only one"),)
        if episode not in known:
            raise InputError(f"has no episode {episode}", where=str(path), hint=f"there are {known[:12]}")
        columns = list(dict.fromkeys(feature for feature, _ in wanted.values()))
        values: dict[str, Any] = {}
        for file in (f for f, episodes in there.items() if episode in episodes):
            table = parquet.read_table(file, columns=columns, filters=[("episode_index", "=", episode)])
            for name in columns:
                part = np.asarray(table[name].to_pylist(), dtype=np.float64)
                values[name] = np.concatenate([values[name], part]) if name in values else part
    except (InputError, OSError):
        raise
    except Exception as error:
        what = f"cannot be read ({cause(error)})"
        raise InputError(what, where=str(path), hint="is it a LeRobot dataset? download it again") from error

    arrays = {name: _taken(name, values[f], entry, path) for name, (f, entry) in wanted.items()}
    columns, taken = pick_columns(path, arrays, names, rows)
    return Table(columns, taken, {}, said)


def _taken(name: str, values: np.ndarray, entry: int | None, path: Path) -> np.ndarray:
    """Return a feature, or one entry of it."""
    if entry is None:
        return values
    flat = values.reshape(len(values), -1)
    if entry >= flat.shape[1]:
        what = f"feature '{name}' is entry {entry + 1}, and the data have {flat.shape[1]}"
        raise InputError(what, where=str(path), hint="download the dataset again")
    return flat[:, entry]


def info_of(root: Path) -> Info:
    """Return what the info.json of a dataset says.

    Raises:
        InputError: If it is none.
    """
    try:
        info = json.loads((root / INFO).read_text())
        features = {str(name): _described(about) for name, about in info["features"].items()}
        return Info(features, int(info.get("total_episodes") or 1))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        what, hint = "is no info.json of a LeRobot dataset", "download the dataset again"
        raise InputError(what, where=str(root / INFO), hint=hint) from error


def _described(about: Mapping[str, Any]) -> Feature:
    names = about.get("names") or []
    # Version 2 has the names of motors in a table of one list.
    names = next(iter(names.values()), []) if isinstance(names, dict) else names
    entries = tuple(map(str, names)) if isinstance(names, list) else ()
    return Feature(str(about.get("dtype", "")), math.prod(map(int, about.get("shape") or [1])), entries)


def _feature(name: str, features: Mapping[str, Feature], path: Path) -> tuple[str, int | None]:
    """Return the feature of a name and its entry, from 0; None: the whole feature."""
    match = _NAMED.match(name)
    feature, entry = (name, None) if match is None or name in features else (match["feature"], match["entry"])
    if feature not in features:
        raise InputError(f"has no feature '{feature}'", where=str(path), hint=suggest(feature, features))
    if entry is None:
        return feature, None
    entries, width = features[feature].entries, features[feature].width
    if entry in entries:
        return feature, entries.index(entry)
    if entry.isdecimal() and 1 <= int(entry) <= width:
        return feature, int(entry) - 1
    hint = suggest(entry, entries) if entries else f"it has the entries 1 to {width}"
    raise InputError(f"feature '{feature}' has no entry '{entry}'", where=str(path), hint=hint)
