"""SO-101 as a whole: its MJCF and raw motions in, the MJCF with fitted servos out, by one command.

    JAXID_DATA=FOLDER python -m benchmarks.so101_arm [-o DIR]

Runs `jaxid identify so101.xml MOTION... --validate MOTION... -o out` in a fresh process, on the files as they
are. What the command prints of MuJoCo's replay stands in DIR/so101_arm.md, with the time that it took.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

from benchmarks.stored_runs import commit_of

ROOT = Path(__file__).parents[1]
HERE = Path(__file__).parent / "results"
FITTED = ("multisine", "friction_gravity", "prbs_excitation")
# The motions that `benchmarks.so101` leaves out as well.
LEFT_OUT = ("backlash_detection", "single_joint_rotation", "slow_precision")
LEFT_OUT += ("step_response", "trapezoidal_profile", "wave_motion")


def main() -> int:
    """Run the command, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    if "JAXID_DATA" not in os.environ:
        parser.error("set JAXID_DATA to the folder of the measured data")
    data = Path(os.environ["JAXID_DATA"]) / "so101"

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        command = [sys.executable, "-m", "jaxid.cli", "identify", str(data / "so101.xml")]
        command += [str(data / f"{name}.csv") for name in FITTED]
        for name in LEFT_OUT:
            command += ["--validate", str(data / f"{name}.csv")]
        begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        done = subprocess.run([*command, "-o", str(out)], capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - begin
        cpu = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        if not (out / "result.json").exists():
            print(done.stderr, file=sys.stderr)
            return 1
        result = json.loads((out / "result.json").read_text())

    replay = done.stdout[done.stdout.index("replay by MuJoCo") :].split("\n\n")[0].rstrip()
    own = [1e3 * x for x in result["gap"]["simulation"]["validation"]]
    shown = f"jaxid identify so101.xml {' '.join(f'{n}.csv' for n in FITTED)} --validate ... -o out"
    lines = [
        "# SO-101 by one command",
        "",
        f"Written by `python -m benchmarks.so101_arm` on {date.today()}, at {commit_of(ROOT)}.",
        f"`{shown}` took {seconds:.0f} s, {cpu:.0f} s of a processor.",
        f"It ended with status {done.returncode}; converged: {str(result['converged']).lower()}.",
        f"Left out of the fit: {', '.join(LEFT_OUT)}.",
        "",
        "```",
        replay,
        "```",
        "",
        "jaxid's own simulation of the arm is off on the motions left out, in the worst of them, by joint:",
        f"{', '.join(f'{x:.2g}' for x in own)} mrad.",
    ]
    (options.o / "so101_arm.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
