"""Six masses with Coulomb friction: identified algebraically in the first instants, then tracked.

Wi, Ri, Ri & Ri, "Parameter Identification of Vibrating MIMO Mass-Spring-Damper Mechanical Systems with
Coulomb Friction". Hypotheses, of logs without noise and samples before 0.1 s only: every mass and
stiffness within 1 %, every damping and friction within 5 %, at 1 kHz and 10 kHz, with friction and
without; and x2 tracked to 0.5 mm RMS from 0.2 s on, once the controller knows what was found.

The machine is the exact simulator of the tests (set-valued friction, 5 us), which shares no code with
jaxid; the controller is the case's own, called tick by tick. The paper's claims are set beside ours.

    python experiments/wi_mimo_coulomb.py [-o results/wi_mimo_coulomb] [--only NAME]
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from common import Table, copied, parser_of

import jaxid
from jaxid.estimators import METHODS
from jaxid.estimators.result import Estimate
from jaxid.machine import build_machine

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from chain_stepper import ChainMachine, simulate_under
from stepper import Sensor

SECONDS, TRACKED_FROM, FIRST = 10.0, 0.2, 0.1
AIMS = {"mass": 1.0, "stiffness": 1.0, "damping": 5.0, "coulomb_friction": 5.0}  # %
FORMS = [name for name in METHODS if name.startswith("algebraic")]


def variant(folder: Path, name: str, *, rate: float, friction: bool = True, actuated: str = "") -> Path:
    """The case at another rate, without friction or with fewer drives, as a file of its own."""
    text = (folder / "chain6.toml").read_text()
    text = re.sub(r"period = [\d.]+", f"period = {1 / rate}", text)
    text = re.sub(r"sample_rate = [\d.]+", f"sample_rate = {rate}", text)
    if not friction:
        text = re.sub(r"# mu m g.*?\n\n(?=\[controller\])", "", text, flags=re.S)
    if actuated:
        text = text.replace('kind = "chain"', f'kind = "chain"\nactuated = {actuated}')
    path = folder / f"{name}.toml"
    path.write_text(text + f"\n[algebraic]\nwindow = [0.0, {FIRST}]\n")
    return path


def truth(case: Path) -> dict[str, float]:
    """True values by name."""
    return {f.name: f.true for f in build_machine(jaxid.load_case(case)).parameters.free}


def chain(case: Path, actuated: list[int] | None = None) -> ChainMachine:
    """The independent simulator's machine with the case's true values."""
    values = truth(case)
    of = lambda what: [v for name, v in values.items() if name.startswith(what)]
    levels = of("coulomb_friction")
    effects = {("coulomb_friction", k + 1): {"level": v} for k, v in enumerate(levels)}
    return ChainMachine(of("mass"), of("damping"), of("stiffness"), effects, actuated)


def run(case: Path, seconds: float, *, identify: bool = False) -> tuple[dict, jaxid.Live, list]:
    """The case's controller on the independent machine; and what was told at every tick."""
    live, told = jaxid.Live(case, identify=identify), []

    def law(_: int, reading: np.ndarray) -> np.ndarray:
        u = live.command(reading)
        told.append(live.told)
        return u

    log = simulate_under(chain(case), law, Sensor(0.0, 0.0), rate=1 / live.period, duration=seconds)
    return log | {"reference": live.reference[: len(log["t"])]}, live, told


def as_log(log: dict, source: str) -> jaxid.Log:
    """What a person would have of it."""
    return jaxid.Log(log["t"], log["position"], log["force"], reference=log["reference"], source=source)


def worst(found: Estimate, true: dict[str, float]) -> dict[str, tuple[float, int, int]]:
    """Of each kind of parameter the largest error of those told [%], how many these are, and of how many."""
    out: dict[str, tuple[float, int, int]] = {}
    for name, value, told in zip(found.names, found.theta, found.identifiable, strict=True):
        kind = re.split(r"[\[.]", name)[0]
        most, count, of = out.get(kind, (0.0, 0, 0))
        error = 100 * abs(value / true[name] - 1) if told else 0.0
        out[kind] = max(most, error), count + bool(told), of + 1
    return out


def words(kind: tuple[float, int, int] | None) -> str:
    """The same as a cell of a table."""
    if kind is None:
        return "-"
    most, told, of = kind
    return f"{most:.2g}" + ("" if told == of else f" ({told} of {of})")


def first_instants(folder: Path) -> bool:
    """Every form of the method on the first 0.1 s, and when its estimates lock in."""
    begin, good = time.perf_counter(), True
    head = ["friction", "rate [Hz]", "method", *(f"{k} [%]" for k in AIMS)]
    table = Table("largest error on the first 0.1 s", head)
    locks = Table(
        "locked in [ms]: within its aim for good; trusted for good",
        ["friction", "rate [Hz]", *AIMS, "trusted"],
    )
    refusals: set[str] = set()
    for friction in (False, True):
        for rate in (1e3, 1e4):
            name = f"{'with' if friction else 'without'}_{rate:g}"
            case = variant(folder, name, rate=rate, friction=friction)
            log = as_log(run(case, FIRST)[0], "exact simulator")
            true, shown = truth(case), ("yes" if friction else "no", f"{rate:g}")
            for method in (*FORMS, "inverse_dynamics", "output_error"):
                if "sign" in method and not friction:
                    continue
                try:
                    found = jaxid.identify(case, log, method=method).estimate
                except jaxid.InputError as error:
                    table.row(*shown, method, *["refused"] * len(AIMS))
                    refusals.add(f"{method}, {rate:g} Hz: {error}")
                    continue
                errors = worst(found, true)
                table.row(*shown, method, *(words(errors.get(k)) for k in AIMS))
                if method == "algebraic":
                    good &= all(most <= AIMS[k] and told == of for k, (most, told, of) in errors.items())
            told = jaxid.follow(case, log)
            locks.row(*shown, *_locked(told, list(true), true, rate))
    table.show(time.perf_counter() - begin)
    print(*refusals, sep="\n")
    locks.show(0.0)
    print(f"every mass and stiffness within 1 %, damping and friction within 5 %: {'yes' if good else 'NO'}")
    return good


def _locked(told, names: list[str], true: dict[str, float], rate: float) -> list[str]:
    """When the last parameter of each kind is within its aim for good, and all are trusted."""
    out = []
    error = 100 * np.abs(told.theta / np.array([true[n] for n in names]) - 1)
    for kind, aim in AIMS.items():
        own = [k for k, n in enumerate(names) if n.startswith(kind)]
        outside = np.flatnonzero((error[:, own] > aim).any(axis=1)) if own else []
        out.append("-" if not own else _instant(outside, len(error), rate))
    return [*out, _instant(np.flatnonzero(~told.trusted.all(axis=1)), len(error), rate)]


def _instant(outside: np.ndarray, samples: int, rate: float) -> str:
    last = outside[-1] + 1 if len(outside) else 0
    return "not by the end" if last >= samples else f"{1e3 * (last + 1) / rate:.3g}"


def tracking(folder: Path) -> bool:
    """Identify, switch, track: the paper's figures 3 to 8."""
    begin, good = time.perf_counter(), True
    head = ["friction", "controller", "x2", "worst mass", "switched at [ms]"]
    table = Table("tracking from 0.2 s on, RMS error [mm]", head)
    for friction in (False, True):
        case = variant(folder, f"track_{'with' if friction else 'without'}", rate=1e3, friction=friction)
        for identify in (False, True):
            log, live, told = run(case, SECONDS, identify=identify)
            late = log["t"] >= TRACKED_FROM
            rms = 1e3 * np.sqrt(np.mean((log["true_position"] - log["reference"])[late] ** 2, axis=0))
            switched = "never" if live.switched is None else f"{1e3 * live.switched * live.period:.0f}"
            who = "what was found" if identify else "the paper's wrong values"
            shown = f"{rms[1]:.3f}", f"{rms.max():.3f}", switched if identify else "-"
            table.row("yes" if friction else "no", who, *shown)
            if identify:
                good &= bool(rms[1] <= 0.5)
                figures(folder, case, log, told, friction)
    table.show(time.perf_counter() - begin)
    print(f"x2 within 0.5 mm: {'yes' if good else 'NO'}")
    return good


def figures(folder: Path, case: Path, log: dict, told: list, friction: bool) -> None:
    """Estimates over the first instants, positions and forces over the whole run."""
    true, first = truth(case), [x for x in told if x is not None]
    kinds = [k for k in AIMS if any(n.startswith(k) for n in true)]
    units = {"mass": "kg", "stiffness": "N/m", "damping": "N s/m", "coulomb_friction": "N"}
    size = {"sharex": True, "layout": "constrained"}
    figure, axes = plt.subplots(len(kinds), 1, figsize=(7, 2.1 * len(kinds)), **size)
    changed = next((k for k, x in enumerate(first) if x is first[-1]), len(first))
    t = 1e3 * log["t"][1 : changed + 2]
    theta = np.stack([x.theta for x in first[: len(t)]])
    for ax, kind in zip(axes, kinds, strict=True):
        own = [k for k, n in enumerate(true) if n.startswith(kind)]
        for colour, k in enumerate(own):
            value = list(true.values())[k]
            ax.plot(t, theta[:, k], color=f"C{colour}", label=f"{colour + 1}")
            ax.axhline(value, color=f"C{colour}", lw=0.6, ls=":")
        values = [list(true.values())[k] for k in own]
        ax.set_ylim(0.0, 1.6 * max(values))
        ax.set_ylabel(f"{kind.replace('coulomb_friction', 'friction')} [{units[kind]}]")
    axes[0].legend(ncols=7, fontsize="small", title="of mass or spring; dotted: true")
    axes[-1].set_xlabel("time [ms]")
    suffix = "with" if friction else "without"
    figure.savefig(folder / f"estimates_{suffix}_friction.png", dpi=130)
    figure, axes = plt.subplots(3, 1, figsize=(8, 8), **size)
    for k in range(6):
        axes[0].plot(log["t"], 1e3 * log["true_position"][:, k], label=f"{k + 1}")
        axes[1].plot(log["t"], 1e3 * (log["true_position"] - log["reference"])[:, k])
        axes[2].plot(log["t"], log["force"][:, k])
    axes[1].set_ylim(-2, 2)
    for ax, words in zip(axes, ("position [mm]", "tracking error [mm]", "force [N]"), strict=True):
        ax.set_ylabel(words)
    axes[0].legend(ncols=6, title="mass", fontsize="small")
    axes[-1].set_xlabel("time [s]")
    figure.savefig(folder / f"tracking_{suffix}_friction.png", dpi=130)
    plt.close("all")


PARTS: dict[str, Callable[[Path], bool]] = {"first_instants": first_instants, "tracking": tracking}


def main() -> int:
    parser = parser_of(__doc__, "results/wi_mimo_coulomb")
    parser.add_argument("--only", choices=PARTS, help="one part")
    args = parser.parse_args()
    folder = copied(args.o, ("chain6.toml",))
    results = {name: part(folder) for name, part in PARTS.items() if args.only in (None, name)}
    print("\n" + ", ".join(f"{name}: {'accepted' if good else 'rejected'}" for name, good in results.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
