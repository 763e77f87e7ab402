"""One fit in a fresh process: `python -m benchmarks.cold_fit smooth|ideal [solver of optimistix]`.

Prints JSON: wall time [s], CPU time [s], half the sum of squares.
"""

import json
import sys
import time

import jax
import jax.numpy as jnp

from benchmarks import axis
from jaxid.simulation.replay import Numerics

reference, measured = axis.log()
run = axis.replay(reference, Numerics(set_valued=sys.argv[1] == "ideal"))
base = axis.plant(axis.TRUTH)
jax.block_until_ready(jnp.zeros(1) + 1)
if len(sys.argv) > 2:
    from benchmarks import axis_rivals as rivals

    solver, start, seen = rivals.OPTIMISTIX[sys.argv[2]], jnp.asarray(axis.START), jnp.asarray(measured)
wall, cpu = time.perf_counter(), time.process_time()
if len(sys.argv) > 2:
    cost = jax.block_until_ready(rivals.optimistix_fit(solver, run, base, start, seen, False))[1]
else:
    cost = axis.fit(run, base, axis.START, measured).cost
print(json.dumps([time.perf_counter() - wall, time.process_time() - cpu, float(cost)]))
