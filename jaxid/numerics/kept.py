"""Compiled functions that commands keep on disk whole, so that a later command does not even trace them.

The persistent cache of JAX spares compiling, but its key needs the traced function, and tracing takes longer
than reading. Here the key is made of all that a trace depends on: the source of jaxid, the versions, the
settings of XLA, and the arguments but for the values of their arrays. A function whose arguments name a class
from elsewhere, such as a user's effect, is traced each time.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import os
import pickle
import platform
import threading
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxid.numerics.lanes import quick_to_compile

P = ParamSpec("P")
T = TypeVar("T")
# Environment variable with the folder; absent: nothing is kept.
FOLDER = "JAXID_KEPT"
# Packages whose classes and functions a key may name, because their versions are a part of it.
_KNOWN = ("jaxid", "numpy", "jax", "jaxlib", "equinox")
# End of the names of files, which `jaxid._cache` counts.
_END = "-cache"
_ARRAYS = (np.ndarray, np.generic, jax.Array)


class _Array:
    """Stands for an array in the static part of a tree."""


def kept_jit(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a function as `equinox.filter_jit` does, and keep its code if there is a folder for it.

    It is compiled in least time, unless it is a part of another compiled function.

    Args:
        function: Function of trees of arrays, defined in a module of jaxid; it returns such a tree.
    """
    plain, quick = eqx.filter_jit(function), functools.cache(lambda: _quick(function))
    calls: dict[bytes, Callable[[list], T] | None] = {}
    locks: dict[bytes, threading.Lock] = {}

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        leaves, structure = jax.tree.flatten((args, kwargs))
        arrays = [x for x in leaves if isinstance(x, _ARRAYS)]
        if any(isinstance(x, Tracer) for x in arrays):
            # Its code is a part of another function's, with the options of that one.
            return plain(*args, **kwargs)
        if FOLDER not in os.environ:
            return (plain if _tracing() else quick())(*args, **kwargs)
        static = jax.tree.unflatten(structure, [_Array if isinstance(x, _ARRAYS) else x for x in leaves])
        key = _key(function, static, arrays)
        if key is None:
            return quick()(*args, **kwargs)
        # Two threads may ask for one function at once: the second waits for the first.
        with locks.setdefault(key, threading.Lock()):
            if key not in calls:
                calls[key] = _ready(function, structure, leaves, arrays, key)
        compiled = calls[key]
        return quick()(*args, **kwargs) if compiled is None else compiled([np.asarray(x) for x in arrays])

    return call


def _tracing() -> bool:
    """Check that this runs while another function is traced."""
    return isinstance(jnp.zeros(()), Tracer)


def _quick(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a function in least time; see `jaxid.numerics.lanes.quick_to_compile`."""
    options = {"compiler_options": quick_to_compile()}
    return eqx.filter_jit(function, **options)  # pyright: ignore[reportCallIssue, reportArgumentType]  # those of `jax.jit`


def _key(function: Callable, static: Any, arrays: list) -> bytes | None:
    """Return the key of a call; None if something in it cannot be named in a later process."""
    out = io.BytesIO()
    try:
        _Pickler(out, protocol=5).dump((function.__module__, function.__qualname__, static))
    except Exception:  # whatever cannot be pickled is not kept
        return None
    shapes = [(x.shape, str(x.dtype)) for x in arrays]
    return hashlib.sha256(out.getvalue() + repr(shapes).encode() + _surroundings()).digest()


class _Pickler(pickle.Pickler):
    """A pickler that refuses classes and functions of other packages than those whose versions are known."""

    def reducer_override(self, thing: Any) -> Any:
        if isinstance(thing, type) or callable(thing):
            module = getattr(thing, "__module__", None) or ""
            if module.split(".")[0] not in (*_KNOWN, "builtins"):
                raise pickle.PicklingError(f"{thing!r} is from elsewhere")
        return NotImplemented


@functools.cache
def _surroundings() -> bytes:
    """Return what compiled code depends on beside its arguments."""
    root = Path(__file__).parents[1]
    files = sorted((str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in root.rglob("*.py"))
    versions = [version(name) for name in _KNOWN if name != "jaxid"]
    known = (files, versions, platform.python_version(), os.environ.get("XLA_FLAGS"), jax.default_backend())
    return repr((*known, _processor(), jax.device_count(), jax.config.read("jax_enable_x64"))).encode()


def _processor() -> tuple[str, ...]:
    """Return the kind of processor and its instructions: a home folder may serve several machines."""
    named = ("model name", "flags", "Features")
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        return (platform.machine(), *sorted({line for line in lines if line.startswith(named)}))
    return (platform.machine(), platform.processor())


def _ready(
    function: Callable, structure: Any, leaves: list, arrays: list, key: bytes
) -> Callable[[list], Any] | None:
    """Return the compiled function of a key, from disk or compiled now; None if it cannot be kept."""
    if jax.default_backend() != "cpu":
        return None
    path = Path(os.environ[FOLDER]) / f"kept_{function.__name__.strip('_')}-{key.hex()[:40]}{_END}"
    found = _read(path)
    return _compiled(function, structure, leaves, arrays, path) if found is None else found


def _read(path: Path) -> Callable[[list], Any] | None:
    from jax.experimental.serialize_executable import deserialize_and_load

    try:
        content, count, skeleton = pickle.loads(path.read_bytes())
        if b"lapack" in content:
            _register_lapack()
        trees = (jax.tree.structure((([0] * count,), {})), jax.tree.structure([0] * _arrays_in(skeleton)))
        return _calling(deserialize_and_load(content, *trees), skeleton)
    except FileNotFoundError:
        return None
    except Exception:  # unreadable: another run is writing it, or was killed while it did
        with contextlib.suppress(OSError):
            path.unlink()
        return None


@functools.cache
def _register_lapack() -> None:
    """Let XLA know the functions of LAPACK, which JAX makes known when it lowers a call of one."""
    jax.jit(jnp.linalg.solve).lower(np.eye(1), np.ones(1))


def _compiled(
    function: Callable, structure: Any, leaves: list, arrays: list, path: Path
) -> Callable[[list], Any] | None:
    from jax.experimental.serialize_executable import serialize

    kept: dict[str, Any] = {}

    def flat(values: list) -> list:
        rest = iter(values)
        given = [next(rest) if isinstance(x, _ARRAYS) else x for x in leaves]
        args, kwargs = jax.tree.unflatten(structure, given)
        out, shape = jax.tree.flatten(function(*args, **kwargs))
        made = [isinstance(x, _ARRAYS) for x in out]
        kept["skeleton"] = jax.tree.unflatten(
            shape, [_Array if m else x for x, m in zip(out, made, strict=True)]
        )
        return [x for x, m in zip(out, made, strict=True) if m]

    name = path.name.removesuffix(_END).replace("-", "_")
    flat.__name__ = flat.__qualname__ = name
    # Asking the compiler what it knows may read from the cache of JAX too.
    options = quick_to_compile()
    hits = _hits()
    lowered = jax.jit(flat).lower([np.asarray(x) for x in arrays])
    compiled, skeleton = lowered.compile(options), kept["skeleton"]
    # JAX keeps the code too. XLA cannot write out again what it has read, and one copy is enough.
    for copy in path.parent.glob(f"jit_{name}-*"):
        copy.unlink(missing_ok=True)
    # An address of Python's in the code would be of this process.
    if _hits() > hits or "callback" in lowered.as_text():
        return _calling(compiled, skeleton)
    with contextlib.suppress(Exception):  # not kept, but it serves this run
        content = pickle.dumps((serialize(compiled)[0], len(arrays), skeleton), protocol=5)
        part = path.with_suffix(f".{os.getpid()}.part")
        part.write_bytes(content)
        part.replace(path)
    return _calling(compiled, skeleton)


_COUNTED = threading.local()


@functools.cache
def _counts_hits() -> bool:
    def count(event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            _COUNTED.hits = getattr(_COUNTED, "hits", 0) + 1

    jax.monitoring.register_event_listener(count)
    return True


def _hits() -> int:
    """Return how often this thread has read from the cache of JAX, since it was asked first."""
    assert _counts_hits(), "the listener is registered once"
    return getattr(_COUNTED, "hits", 0)


def _arrays_in(skeleton: Any) -> int:
    return sum(x is _Array for x in jax.tree.leaves(skeleton))


def _calling(compiled: Any, skeleton: Any) -> Callable[[list], Any]:
    holes, shape = jax.tree.flatten(skeleton)

    def call(arrays: list) -> Any:
        rest = iter(compiled(arrays))
        return jax.tree.unflatten(shape, [next(rest) if x is _Array else x for x in holes])

    return call
