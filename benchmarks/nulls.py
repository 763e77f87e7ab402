"""Rate at which discovery names an effect where nothing is missing: complete cases, logs of the stepper.

    python -m benchmarks.nulls [--logs N] [--machine NAME] [--no-sensor]

prints the table and exits with 1 where more than one log in sixty is not `nothing_missing`.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from jaxid.commands.discover import discover
from tests.support.axis_log import log_of
from truth.axis import machines
from truth.axis.cases import case_text, write_case

NOISE = (0.3, 1.0, 3.0)
# Name -> preset, motion, and seconds of the log of each seed in turn.
MACHINES = {
    "emps_like": (machines.emps_like, "linear", (25.0, 12.0)),
    "servo": (machines.servo, "rotary", (1.0, 2.0, 0.5)),
    "heavy_slide": (machines.heavy_slide, "linear", (2.0, 1.2, 5.0)),
}


def judged(name: str, seed: int, noise: float, sensor: bool, folder: Path):
    """Search one log, and return the verdict."""
    preset, motion, durations = MACHINES[name]
    setup = preset(seed, noise, durations[seed % len(durations)])
    declared = [*setup.machine.effects.items()]
    off = 1.2 + 0.1 * (seed % 5)
    text = case_text(setup, declared, off=off, motion=motion, sensor=sensor)
    return discover(write_case(folder, text), log_of(setup), refit=False)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, default=20, help="seeds at each level of noise")
    parser.add_argument("--machine", choices=MACHINES, default="emps_like")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--no-sensor", action="store_true", help="do not state the sensor")
    options = parser.parse_args()
    wrong = total = 0
    with tempfile.TemporaryDirectory() as folder:
        for noise in NOISE:
            for seed in range(options.first, options.first + options.logs):
                begin = time.perf_counter()
                d = judged(options.machine, seed, noise, not options.no_sensor, Path(folder))
                wrong += d.verdict != "nothing_missing"
                total += 1
                _print(noise, seed, d, time.perf_counter() - begin)
    print(f"{total - wrong} of {total} logs: nothing_missing")
    return int(wrong > total / 60)


def _print(noise: float, seed: int, d, seconds: float) -> None:
    rms = float(d.gaps_before[0].force.rms[0])
    kinds = ", ".join(d.kinds) or (d.where.text if d.where else "")
    floor = float(d.noise_floor[0])
    line = f"noise {noise:3g}  seed {seed:3d}  {d.verdict:16s} rms {rms:9.3g}  floor {floor:9.3g}"
    print(f"{line}  {seconds:5.1f} s  {kinds}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
