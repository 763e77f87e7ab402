"""Results of notebooks that take minutes, for those who read them in seconds.

    python -m benchmarks.notebooks NAME

Runs notebooks/NAME.py with all its long cells, and writes what they leave in `results`, with the commit and
the date, to notebooks/results/NAME.json.
"""

import argparse
import datetime
import json
import math
import os
import runpy
from pathlib import Path
from typing import Any

import matplotlib

from benchmarks.stored_runs import commit_of

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "notebooks" / "results"


def computed(name: str) -> dict[str, Any]:
    """Return the results of a notebook's long cells; values that are not finite are None."""
    matplotlib.use("Agg")
    os.environ["JAXID_LONG"] = "1"
    try:
        return _finite(runpy.run_path(str(ROOT / "notebooks" / f"{name}.py"))["results"])
    finally:
        del os.environ["JAXID_LONG"]


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(x) for key, x in value.items()}
    if isinstance(value, list):
        return [_finite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main() -> None:
    """Write the results of a notebook."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("name", help="notebook, such as hundred_samples")
    name = parser.parse_args().name
    head = {"commit": commit_of(ROOT), "date": datetime.date.today().isoformat()}
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(head | computed(name)) + "\n")


if __name__ == "__main__":
    main()
