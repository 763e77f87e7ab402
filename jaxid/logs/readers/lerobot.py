"""Episodes of LeRobot datasets, in the layouts v2 (a file each) and v3 (many in a file)."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError, cause, suggest
from jaxid.logs.readers.array_files import pick_columns
from jaxid.logs.readers.extras import need
from jaxid.logs.readers.rows import Rows
from jaxid.logs.readers.table import Assumed, Table
from jaxid.settings import LogTable

# The file that a dataset has in both layouts.
INFO = "meta/info.json"
_NAMED = re.compile(r"(?P<feature>[^\[\]]+)\[(?P<entry>.+)\]$")


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
    features = _features(root)
    wanted = {name: _feature(name, features, path) for name in names}
    files = [path] if path.is_file() else sorted((root / "data").rglob("*.parquet"))
    episode = None if settings is None else settings.episode

    try:
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

    arrays = {
        name: values[feature]
        if entry is None
        else values[feature].reshape(len(values[feature]), -1)[:, entry]
        for name, (feature, entry) in wanted.items()
    }
    columns, taken = pick_columns(path, arrays, names, rows)
    return Table(columns, taken, {}, said)


def _features(root: Path) -> Mapping[str, Any]:
    where = str(root / INFO)
    try:
        return json.loads((root / INFO).read_text())["features"]
    except (ValueError, KeyError, TypeError) as error:
        hint = "download the dataset again"
        raise InputError("is no info.json of a LeRobot dataset", where=where, hint=hint) from error


def _feature(name: str, features: Mapping[str, Any], path: Path) -> tuple[str, int | None]:
    """Return the feature of a name and its entry, from 0; None: the whole feature."""
    match = _NAMED.match(name)
    feature, entry = (name, None) if match is None or name in features else (match["feature"], match["entry"])
    if feature not in features:
        raise InputError(f"has no feature '{feature}'", where=str(path), hint=suggest(feature, features))
    if entry is None:
        return feature, None
    names = features[feature].get("names") or []
    # Version 2 has the names of motors in a table of one list.
    names = next(iter(names.values()), []) if isinstance(names, dict) else names
    if entry in names:
        return feature, list(names).index(entry)
    width = int(np.prod(features[feature].get("shape") or [1]))
    if entry.isdigit() and 1 <= int(entry) <= width:
        return feature, int(entry) - 1
    hint = suggest(entry, names) if names else f"it has the entries 1 to {width}"
    raise InputError(f"feature '{feature}' has no entry '{entry}'", where=str(path), hint=hint)
