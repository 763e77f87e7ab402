"""One fit in a fresh process: `python benchmarks/cold_fit.py smooth|ideal`; prints JSON."""

import json
import sys
import time

import axis
import jax
import jax.numpy as jnp

from jaxid.replay import Numerics

reference, measured = axis.log()
run = axis.replay(reference, Numerics(set_valued=sys.argv[1] == "ideal"))
base = axis.plant(axis.TRUTH)
jax.block_until_ready(jnp.zeros(1) + 1)
wall, cpu = time.perf_counter(), time.process_time()
axis.fit(run, base, axis.START, measured)
print(json.dumps([time.perf_counter() - wall, time.process_time() - cpu]))
