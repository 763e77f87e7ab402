"""Six masses with Coulomb friction: identified algebraically in the first instants, then tracked.

Wi, Ri, Ri & Ri, "Parameter Identification of Vibrating MIMO Mass-Spring-Damper Mechanical Systems with
Coulomb Friction". Hypotheses, of logs without noise and samples before 0.1 s only: every mass and
stiffness within 1 %, every damping and friction within 5 %, at 1 kHz and 10 kHz, with friction and
without; and x2 tracked to 0.5 mm RMS from 0.2 s on, once the controller knows what was found.

The machine is the exact simulator of `truth/` (set-valued friction, 5 us), which shares no code with
jaxid; the controller is the case's own, called tick by tick. The paper's claims are set beside ours.

    python -m experiments.wi_mimo_coulomb [-o results/wi_mimo_coulomb] [--only NAME]
"""

from __future__ import annotations

import itertools
import re
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import jaxid
from experiments import wi_figures
from experiments.common import Table, copied, parser_of
from experiments.wi_cases import CASE, FIRST, long_chain, one_driven, undeclared, variant
from experiments.wi_loop import driven, machine, true_values
from experiments.wi_noise import FORMS, noise
from jaxid.build import build_machine
from jaxid.estimators import METHODS
from jaxid.estimators.algebraic.online import Online, OnlineEstimate, window_rows
from jaxid.estimators.estimate import Estimate
from jaxid.numerics.lanes import run_alone
from truth.chain.six_masses import KINDS
from truth.chain.stepper import name_of

SECONDS, TRACKED_FROM = 10.0, 0.2
# The law with measured velocity, and the one with a reconstructed one and the error's integral.
LAWS = {"(4)-(5)": "[-60.0, -60.0]", "(9)-(12)": "[-60.0, -60.0, -60.0]"}
AIMS = {kind: 100 * aim for kind, aim in KINDS.items()}  # %


def worst(found: Estimate, true: dict[str, float]) -> dict[str, tuple[float, int, int]]:
    """Return by kind the largest error of identifiable parameters [%], their number, and that of all."""
    out: dict[str, tuple[float, int, int]] = {}
    for name, value, told in zip(found.names, found.theta, found.identifiable, strict=True):
        kind = re.split(r"[\[.]", name)[0]
        most, count, of = out.get(kind, (0.0, 0, 0))
        error = 100 * abs(value / true[name] - 1) if told else 0.0
        out[kind] = max(most, error), count + bool(told), of + 1
    return out


def words(kind: tuple[float, int, int] | None) -> str:
    """Format such an error as a cell of a table."""
    if kind is None:
        return "-"
    most, told, of = kind
    return f"{most:.2g}" + ("" if told == of else f" ({told} of {of})")


def first_instants(folder: Path) -> bool:
    """Run every form of the method on the first 0.1 s, and find when its estimates lock in."""
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
            log = driven(case, FIRST).log
            true, shown = true_values(case), ("yes" if friction else "no", f"{rate:g}")
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


def _locked(told: OnlineEstimate, names: list[str], true: dict[str, float], rate: float) -> list[str]:
    """Return when the last parameter of each kind is within its aim for good, and all are trusted."""
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
    head = ["friction", "law", "it knows", "x2", "worst mass", "switched at [ms]"]
    table = Table("tracking from 0.2 s on, RMS error [mm]", head)
    for friction, law, identify in itertools.product((False, True), LAWS, (False, True)):
        case = variant(folder, f"track_{len(LAWS[law])}_{friction}", friction=friction, poles=LAWS[law])
        run = driven(case, SECONDS, identify=identify)
        off = (run.position - run.log.reference)[run.log.time >= TRACKED_FROM]
        rms, live = 1e3 * np.sqrt(np.mean(off**2, axis=0)), run.live
        switched = "never" if live.switched is None else f"{1e3 * live.switched * live.period:.0f}"
        who = "what was found" if identify else "the paper's wrong values"
        shown = f"{rms[1]:.3f}", f"{rms.max():.3f}", switched if identify else "-"
        table.row("yes" if friction else "no", law, who, *shown)
        if identify:
            good &= bool(rms[1] <= 0.5)
        if identify and law == "(4)-(5)":
            suffix = "with" if friction else "without"
            wi_figures.estimates(folder / f"estimates_{suffix}_friction.png", run, true_values(case))
            wi_figures.tracking(folder / f"tracking_{suffix}_friction.png", run)
    table.show(time.perf_counter() - begin)
    print(f"x2 within 0.5 mm: {'yes' if good else 'NO'}")
    return good


def partial(folder: Path) -> bool:
    """Only mass 2 driven, every position measured: what can be told as the others begin to slide."""
    begin = time.perf_counter()
    case = one_driven(folder, 1.0)
    run = driven(case, 1.0, on=machine(case, [2]))
    true, slid = true_values(case), np.abs(run.velocity) > 1e-3
    first = [f"{1e3 * run.log.time[np.argmax(s)]:.0f}" if s.any() else "never" for s in slid.T]
    print(f"\nonly mass 2 driven: the masses first slide at {', '.join(first)} ms")
    head = ["until [s]", *AIMS, "not identified"]
    table = Table("told from the first instants: largest error [%] (how many)", head)
    good = True
    for until in (0.05, 0.1, 0.2, 0.3, 0.5, 1.0):
        case, log = one_driven(folder, until), _head(run.log, until)
        found = jaxid.identify(case, log, method="algebraic").estimate
        errors = worst(found, true)
        blind = [n for n, told in zip(found.names, found.identifiable, strict=True) if not told]
        short = [n.replace("coulomb_friction", "friction").replace(".level", "") for n in blind]
        table.row(f"{until:g}", *(words(errors.get(k)) for k in AIMS), " ".join(short) or "none")
        good &= until < FIRST or all(most <= AIMS[k] for k, (most, _, _) in errors.items())
    table.show(time.perf_counter() - begin)
    return good


def _head(log: jaxid.Log, until: float) -> jaxid.Log:
    """Cut a log at an instant, because the filters would use what comes later."""
    cut = log.time < until + 0.5 * log.period
    signals = {name: getattr(log, name)[cut] for name in ("time", "position", "force", "reference")}
    return replace(log, rows=(0, 0), **signals)


def cost(folder: Path) -> bool:
    """Seconds against the number of masses."""
    head = ["masses", "unknowns", "identify, first [s]", "again [ms]", "the fit alone [ms]", "a sample [us]"]
    table = Table("cost against masses, 0.1 s at 1 kHz", head)
    begin, times = time.perf_counter(), []
    for n in (2, 5, 10, 20, 50):
        case = long_chain(folder, n)
        log = jaxid.simulate(case).log
        whole, own, session = [], [], jaxid.open_session(case, log)
        for _ in range(4):
            start = time.perf_counter()
            found = jaxid.identify(case, log, method="algebraic").estimate
            middle = time.perf_counter()
            run_alone(METHODS["algebraic"](session))
            whole.append(middle - start)
            own.append(time.perf_counter() - middle)
        times.append(min(own))
        again = f"{1e3 * min(whole):.0f}", f"{1e3 * times[-1]:.1f}", f"{1e6 * _a_sample(case, log):.1f}"
        table.row(n, len(found.names), f"{whole[0]:.1f}", *again)
    table.show(time.perf_counter() - begin)
    return times[-1] / times[0] <= 50 / 2


def _a_sample(case: Path, log: jaxid.Log) -> float:
    """Seconds of the on-line recursion for one sample, compiled."""
    machine, quick = build_machine(jaxid.load_case(case)), np.abs(np.diff(log.position, axis=0)).max(axis=0)
    online = Online.of(machine, log.period, 5e-3 * quick / log.period, quick / log.period)
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        np.asarray(window_rows(online, log.position, log.force, np.zeros(log.position.shape, bool))[1])
        seconds.append(time.perf_counter() - start)
    return min(seconds) / log.samples


def hidden(folder: Path) -> bool:
    """Friction that the case leaves out at one mass, and a cubic spring at one place: named with it."""
    begin, good = time.perf_counter(), True
    table = Table(
        "hidden in the six masses, nothing declared", ["true", "verdict", "named", "evidence", "values"]
    )
    for kind, place, values in (
        ("coulomb_friction", 3, {"level": 4.7}),
        ("cubic_stiffness", 4, {"coefficient": 4e5}),
        ("backlash", 4, {"gap": 1e-3}),
    ):
        case = undeclared(folder, f"hidden_{kind}")
        log = driven(case, SECONDS, noise=1e-6, on=machine(case).with_effect(kind, place, **values)).log
        found = jaxid.discover(case, log)
        named = ", ".join(e.label for e in found.effects) or "-"
        evidence = ", ".join(f"{e.score.evidence:.0f}" for e in found.effects)
        estimates = found.after.names, found.after.theta, found.after.std
        values = ", ".join(
            f"{name} = {theta:.6g} ± {std:.2g}"
            for name, theta, std in zip(*estimates, strict=True)
            if any(name.startswith(e.label) for e in found.effects)
        )
        table.row(name_of(kind, place), found.verdict, named, evidence, values)
        good &= [e.label for e in found.effects] == [name_of(kind, place)]
    table.show(time.perf_counter() - begin)
    return good


PARTS: dict[str, Callable[[Path], bool]] = {
    "first_instants": first_instants,
    "tracking": tracking,
    "partial": partial,
    "noise": noise,
    "cost": cost,
    "hidden": hidden,
}


def main() -> int:
    parser = parser_of(__doc__, "results/wi_mimo_coulomb")
    parser.add_argument("--only", choices=PARTS, help="one part")
    args = parser.parse_args()
    folder = copied(args.o, (CASE,))
    results = {name: part(folder) for name, part in PARTS.items() if args.only in (None, name)}
    print("\n" + ", ".join(f"{name}: {'accepted' if good else 'rejected'}" for name, good in results.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
