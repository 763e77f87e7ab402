"""Compiled code that commands keep on disk: the second run of a command compiles nothing.

JAX's own persistent cache does the work. Here is where it lies, how large it may grow, and what
becomes of an entry that cannot be read: another run may be writing it, or was killed while it did.
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
# Faster than that, compiling costs little more than reading.
_SECONDS = 0.02
_ENTRIES = "*-cache"
_UNREADABLE = "Error reading persistent compilation cache entry for '([^']*)'"
_UNWRITTEN = "Error writing persistent compilation cache entry"


def configure() -> None:
    """Keep compiled code, unless the user has told JAX where to, or `JAXID_CACHE` is `off`.

    To be called before JAX is imported; it goes through the environment, as JAX's users do.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or os.environ.get("JAXID_CACHE") == "off":
        return
    try:
        folder = _home() / _host()
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            return
        _shrink(folder)
    except (OSError, RuntimeError):
        return  # no home, or one that cannot be written to: all works, only slower
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(_SECONDS))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    _heal(folder)


def _home() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxid"


def _host() -> str:
    """What code compiled for this processor goes under: a home may be shared by many."""
    try:
        info = Path("/proc/cpuinfo").read_text()
        features = next((line for line in info.split("\n") if line.startswith(("flags", "Features"))), "")
    except OSError:
        features = platform.processor()
    return hashlib.sha256(f"{platform.machine()} {features}".encode()).hexdigest()[:16]


def _shrink(folder: Path) -> None:
    """Remove what was written first where it is too much."""
    stats = [(path.stat(), path) for path in folder.glob(_ENTRIES)]
    total = 0
    for _, size, path in sorted(((s.st_mtime, s.st_size, path) for s, path in stats), reverse=True):
        total += size
        if total > _MOST_BYTES:
            path.unlink(missing_ok=True)


def _heal(folder: Path) -> None:
    """Compile again what cannot be read, without a word, and remove it when the command ends.

    JAX compiles such an entry anew but leaves it as it is, to warn of it again in every run. It names
    the function; of its entries those go that are older than this run. What another run is writing
    just now is whole by then, and newer.
    """
    found: set[str] = set()
    shown, begun = warnings.showwarning, time.time()

    def note(message: Any, *rest: Any, **more: Any) -> None:
        unreadable = re.match(_UNREADABLE, str(message))
        if unreadable:
            found.add(unreadable[1])
        elif not str(message).startswith(_UNWRITTEN):
            shown(message, *rest, **more)

    def clear() -> None:
        for path in folder.glob(_ENTRIES):
            if any(path.name.startswith(name) for name in found):
                with contextlib.suppress(OSError):
                    if path.stat().st_mtime < begun:
                        path.unlink()

    warnings.showwarning = note
    atexit.register(clear)
