"""The process-wide settings that jaxid needs: float64, XLA's loop flag, and one flag for jaxlib 0.11.

They are set through the environment, so that importing jaxid does not import JAX. If JAX is imported
already, its configuration is updated instead. Settings of the user are kept.
"""

from __future__ import annotations

import os
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path

# XLA on CPU runs a scan as one native kernel only if the loop body touches few bytes; past that
# it dispatches op by op, which makes gradients of small systems 2 to 50 times slower. The option
# is undocumented: benchmarks/ keeps a measurement on it, because a new jaxlib may drop it.
LOOP_OPTION = "xla_cpu_small_while_loop_byte_threshold"
LOOP_FLAG = f"--xla_backend_extra_options={LOOP_OPTION}=1000000000"

# With jaxlib 0.11 threads that run compiled code at once, as in a study, wait for each other for ever
# unless each runs its matrix products by itself. Versions before and after do not.
THREADS_OPTION = "xla_cpu_multi_thread_eigen"


def configure() -> None:
    """Enable float64 and the loop flag; warn once if JAX's backend is already running."""
    os.environ["JAX_ENABLE_X64"] = "1"
    jax = sys.modules.get("jax")
    if jax is not None:
        jax.config.update("jax_enable_x64", True)
    flags = os.environ.get("XLA_FLAGS", "")
    needed = _with_threads_flag(_with_loop_flag(flags))
    if needed == flags:
        return
    if jax is not None and _backend_is_up():
        warnings.warn(
            "jaxid was imported after JAX had started its backend: gradients through simulations "
            "will be several times slower. Import jaxid before the first JAX computation.",
            stacklevel=3,
        )
        return
    os.environ["XLA_FLAGS"] = needed


def _with_loop_flag(flags: str) -> str:
    """Append the option, inside the user's xla_backend_extra_options if that is set.

    XLA keeps only the last occurrence of a flag, so a second one would undo the user's.
    """
    if LOOP_OPTION in flags:
        return flags
    key = "--xla_backend_extra_options="
    words = flags.split()
    for i, word in enumerate(words):
        if word.startswith(key):
            words[i] = f"{word},{LOOP_FLAG[len(key) :]}"
            return " ".join(words)
    return " ".join([*words, LOOP_FLAG])


def _with_threads_flag(flags: str) -> str:
    """Append the flag of jaxlib 0.11, where that version is installed and the user has not set it."""
    if THREADS_OPTION in flags or not _installed_jaxlib().startswith("0.11."):
        return flags
    return f"{flags} --{THREADS_OPTION}=false"


def _installed_jaxlib() -> str:
    """Read the version of jaxlib from its folder's name: importing it takes a second, its metadata 50 ms."""
    package = find_spec("jaxlib")
    if package is None or package.origin is None:
        return ""
    folder = Path(package.origin).parent
    found = [entry.stem.removeprefix("jaxlib-") for entry in folder.parent.glob("jaxlib-*.dist-info")]
    return found[0] if found else ""


def _backend_is_up() -> bool:
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bool(bridge is not None and bridge.backends_are_initialized())
