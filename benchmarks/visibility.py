"""Evidence of the effects of the benchmark of discovery, by its oracle alone.

    python -m benchmarks.visibility [--split test]

Prints the evidence of the true effect in each log with one hidden effect, in nats: the lesser of both logs.
"""

import argparse

import numpy as np

from truth.hidden import oracle
from truth.hidden.cases import cases

SINGLE = ("effects", "short")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--split", default="test", choices=("calibrate", "test"))
    options = parser.parse_args()
    single = [case for case in cases(options.split) if case.group in SINGLE]
    sights = [sight for case in single for sight in oracle.sights(case).values()]
    seen = np.sort([min(sight.evidence) for sight in sights if sight.visible])
    print(f"{len(sights)} logs, {len(sights) - len(seen)} in which the effect is invisible")
    print(f"of the others, evidence in nats: least {seen[0]:.0f}, ", end="")
    print(", ".join(f"{p} % {np.percentile(seen, p):.0f}" for p in (1, 5, 10, 25, 50)))
    print(", ".join(f"below {n}: {np.sum(seen < n)}" for n in (50, 100, 300)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
