"""One tick of the law `adaptive`, identification included, against the 0.25 ms of a loop at 4 kHz.

    python -m benchmarks.control_step [CASE.toml] [--ticks 100000]

The case (absent: two links, as in the tests) is simulated, and its readings are given to `jaxid.Live` one
by one, as the loop of a machine does. Times are of whole calls, from array to array; *in a scan* is the
time of the law alone, a tick within one compiled loop. Other processes on the machine make the worst wall
time longer; processor time, of all threads, is without them.
"""

import argparse
import gc
import tempfile
import time
from pathlib import Path

import numpy as np

BUDGET_US = 250.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("case", nargs="?", type=Path)
    parser.add_argument("--ticks", type=int, default=100_000)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        times, scanned = measured(args.case or two_links(Path(folder), args.ticks), args.ticks)
    print(f"{len(times)} ticks; in a scan {scanned:.2f} us each")
    for name, column in zip(("wall", "processor"), times.T, strict=True):
        part = {"median": np.median(column), "99 %": np.percentile(column, 99), "worst": column.max()}
        text = ", ".join(f"{k} {v:.1f} us" for k, v in part.items())
        print(f"{name}: {text}; {100 * np.mean(column > BUDGET_US):.3f} % over {BUDGET_US:g} us")


def two_links(folder: Path, ticks: int) -> Path:
    from truth.arm.two_links_case import written

    return written(folder, "velocity_average = 4\nreach = 8", ticks * 2.5e-4)


def measured(case: Path, ticks: int) -> tuple[np.ndarray, float]:
    """Time the ticks of a case.

    Returns:
        Wall and processor time of each call [us], (ticks, 2), and time of a tick in one compiled loop [us].
    """
    from jaxid.commands.live import Live

    live = Live(case)
    ticks = min(ticks, len(live.reference))
    # What a law costs does not depend on how well it follows.
    readings = live.reference + 1e-5 * np.random.default_rng(0).standard_normal(live.reference.shape)
    for reading in readings[:2000]:
        live.command(reading)
    rewind(live)
    times = np.empty((ticks, 2))
    gc.collect()
    gc.disable()
    for k in range(ticks):
        start, spent = time.perf_counter(), time.process_time()
        live.command(readings[k])
        times[k] = time.perf_counter() - start, time.process_time() - spent
    gc.enable()
    return 1e6 * times, 1e6 * in_a_scan(live, readings[:ticks])


def rewind(live) -> None:
    """Set a controller back to its start; its compiled law is kept."""
    live._tick, live.memory, live.switched = 0, live._controller.start(*first(live)), None


def first(live) -> tuple:
    import jax

    from jaxid.controllers import Tick

    path = jax.tree.map(lambda x: x[0], live._path)
    n = live.reference.shape[1]
    return Tick(live.reference[0], path, tuple(range(n)), np.asarray(True)), np.zeros(n), live._path


def in_a_scan(live, readings: np.ndarray) -> float:
    """Time the law in one compiled loop; return seconds a tick."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from jaxid.controllers import Tick

    law, driven = live._controller, tuple(range(readings.shape[1]))

    @eqx.filter_jit
    def run(law, memory, readings, path):
        def tick(memory, now):
            reading, path = now
            u, memory = law.command(Tick(reading, path, driven), memory, jnp.zeros(1))
            return memory, u

        return jax.lax.scan(tick, memory, (readings, path))[1]

    path = jax.tree.map(lambda x: jnp.asarray(x[: len(readings)]), live._path)
    args = (law, law.start(*first(live)), jnp.asarray(readings), path)
    run(*args).block_until_ready()
    start = time.perf_counter()
    run(*args).block_until_ready()
    return (time.perf_counter() - start) / len(readings)


if __name__ == "__main__":
    main()
