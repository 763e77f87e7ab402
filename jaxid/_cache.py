"""Compiled code that commands keep on disk, so that the second run of a command compiles nothing.

It is the persistent cache of JAX, and beside it whole functions, see `jaxid.numerics.kept`. This module
chooses the folder, limits its size, and removes entries that cannot be read because another run is writing
them or was killed while it did.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import os
import platform
import re
import time
import warnings
from pathlib import Path
from typing import Any

_MOST_BYTES = 500_000_000
# Below this time [s], compiling costs little more than reading.
_SECONDS = 0.02
_ENTRIES = "*-cache"
_UNREADABLE = "Error reading persistent compilation cache entry for '([^']*)'"
_UNWRITTEN = "Error writing persistent compilation cache entry"


def configure() -> None:
    """Keep compiled code, unless the user has set the folder of JAX's cache, or `JAXID_CACHE` is `off`.

    Call it before JAX is imported, because it sets environment variables.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or os.environ.get("JAXID_CACHE") == "off":
        return
    try:
        folder = home() / _host()
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            return
        _shrink(folder)
    except (OSError, RuntimeError):
        return  # no home, or one that cannot be written to: all works, only slower
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAXID_KEPT", str(folder))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(_SECONDS))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    _heal(folder)


def home() -> Path:
    """Return jaxid's folder among the caches of this user."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxid"


def _host() -> str:
    """Return a name for this kind of processor, because machines of several kinds may share a home."""
    try:
        info = Path("/proc/cpuinfo").read_text()
        features = next((line for line in info.split("\n") if line.startswith(("flags", "Features"))), "")
    except OSError:
        features = platform.processor()
    return hashlib.sha256(f"{platform.machine()} {features}".encode()).hexdigest()[:16]


def _shrink(folder: Path) -> None:
    """Remove the oldest entries of a cache that is too large."""
    stats = [(path.stat(), path) for path in folder.glob(_ENTRIES)]
    total = 0
    for _, size, path in sorted(((s.st_mtime, s.st_size, path) for s, path in stats), reverse=True):
        total += size
        if total > _MOST_BYTES:
            path.unlink(missing_ok=True)


def _heal(folder: Path) -> None:
    """Compile unreadable entries again without a warning, and remove them when the command ends.

    JAX compiles such an entry anew but keeps the file, and warns of it again in every run. Its warning names
    the function, and the entries of that name are removed if they are older than this run. An entry that
    another run is writing at this moment is whole by then, and newer.
    """
    unreadable_names: set[str] = set()
    shown, begun = warnings.showwarning, time.time()

    def note(message: Any, *rest: Any, **more: Any) -> None:
        unreadable = re.match(_UNREADABLE, str(message))
        if unreadable:
            unreadable_names.add(unreadable[1])
        elif not str(message).startswith(_UNWRITTEN):
            shown(message, *rest, **more)

    def clear() -> None:
        for path in folder.glob(_ENTRIES):
            if any(path.name.startswith(name) for name in unreadable_names):
                with contextlib.suppress(OSError):
                    if path.stat().st_mtime < begun:
                        path.unlink()

    warnings.showwarning = note
    atexit.register(clear)
