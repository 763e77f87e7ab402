"""One fit in a fresh process: `python benchmarks/cold_fit.py smooth|ideal`; prints JSON."""

import json
import sys
import time

begin = time.perf_counter()
import axis
import jax
import jax.numpy as jnp

from jaxid.replay import Numerics

reference, measured = axis.log()
run = axis.replay(reference, Numerics(set_valued=sys.argv[1] == "ideal"))
base = axis.plant(axis.TRUTH)
jax.block_until_ready(jnp.zeros(1) + 1)
ready = time.perf_counter()
axis.fit(run, base, axis.START, measured)
first = time.perf_counter()
axis.fit(run, base, axis.START, measured)
print(json.dumps({"fit": first - ready, "again": time.perf_counter() - first}))
