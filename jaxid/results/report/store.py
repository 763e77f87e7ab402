"""The content of a report in one file of arrays, from which it is rendered and plotted again."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError
from jaxid.results.report import data as content

# Entry of the archive that holds all that is no array.
_PAGE = "page"
# Keys that mark an array, a tuple and an object among the JSON of a page.
_ARRAY, _TUPLE, _CLASS = "#array", "#tuple", "#class"
# Samples of a log beyond which only every k-th is kept: more than a plot shows.
_MOST = 50_000
_CLASSES: dict[str, type] = {
    cls.__name__: cls
    for cls in vars(content).values()
    if isinstance(cls, type) and cls.__module__ == content.__name__
}


def packed(data: content.ReportData) -> bytes:
    """Return the content of a report as an .npz archive, logs of more than 50 000 samples thinned."""
    arrays: dict[str, np.ndarray] = {}
    thin = dataclasses.replace(data, views=tuple(_thinned(view) for view in data.views))
    page = json.dumps(_encoded(thin, arrays))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **{_PAGE: np.asarray(page)}, **arrays)
    return buffer.getvalue()


def unpacked(path: Path) -> content.ReportData:
    """Read the content of a report.

    Raises:
        InputError: If the file is missing, damaged, or of another version of jaxid.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files if name != _PAGE}
            page = json.loads(str(archive[_PAGE]))
        found = _decoded(page, arrays)
    except FileNotFoundError:
        hint = "run the command again with -o: it writes the file beside its JSON"
        raise InputError(
            "is missing: it holds the curves of the report", where=str(path), hint=hint
        ) from None
    except Exception as error:
        # A damaged archive raises errors of a dozen kinds.
        hint = "run the command again; the file may be of another version of jaxid"
        raise InputError(f"cannot be read: {error}", where=str(path), hint=hint) from error
    if not isinstance(found, content.ReportData):
        raise InputError("holds no report", where=str(path), hint="run the command again with -o")
    return found


def _thinned(view: content.LogView) -> content.LogView:
    """Return a view with at most so many samples, each k-th of them."""
    changes: dict[str, Any] = {}
    for size in (len(view.time), len(view.band_time)):
        step = -(-size // _MOST)
        for name, value in vars(view).items():
            if step > 1 and isinstance(value, np.ndarray) and len(value) == size:
                changes[name] = value[::step]
    return dataclasses.replace(view, **changes)


def _encoded(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return JSON for a value; arrays go into `arrays` under names of their own."""
    if isinstance(value, np.ndarray) and value.dtype != object:
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {_ARRAY: name}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _encoded(getattr(value, f.name), arrays) for f in dataclasses.fields(value)}
        return {_CLASS: type(value).__name__, **fields}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        named: Any = value
        return {_CLASS: type(value).__name__, **{k: _encoded(v, arrays) for k, v in named._asdict().items()}}
    if isinstance(value, Mapping):
        return {str(k): _encoded(v, arrays) for k, v in value.items()}
    if isinstance(value, tuple):
        return {_TUPLE: [_encoded(v, arrays) for v in value]}
    if isinstance(value, (list, np.ndarray)):
        return [_encoded(v, arrays) for v in value]
    return value.item() if isinstance(value, np.generic) else value


def _decoded(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if isinstance(value, list):
        return [_decoded(v, arrays) for v in value]
    if not isinstance(value, dict):
        return value
    if _ARRAY in value:
        return arrays[value[_ARRAY]]
    if _TUPLE in value:
        return tuple(_decoded(v, arrays) for v in value[_TUPLE])
    fields = {k: _decoded(v, arrays) for k, v in value.items() if k != _CLASS}
    return _CLASSES[value[_CLASS]](**fields) if _CLASS in value else fields
