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

import itertools
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
from jaxid.estimators.online import Online, window_rows
from jaxid.estimators.result import Estimate
from jaxid.estimators.steps import alone
from jaxid.machine import build_machine

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from chain_stepper import ChainMachine, name_of, simulate_under
from stepper import Sensor

SECONDS, TRACKED_FROM, FIRST, RUNS = 10.0, 0.2, 0.1, 1000
# The law with measured velocity, and the one with a reconstructed one and the error's integral.
LAWS = {"(4)-(5)": "[-60.0, -60.0]", "(9)-(12)": "[-60.0, -60.0, -60.0]"}
AIMS = {"mass": 1.0, "stiffness": 1.0, "damping": 5.0, "coulomb_friction": 5.0}  # %
FORMS = [name for name in METHODS if name.startswith("algebraic")]


def variant(
    folder: Path, name: str, *, rate: float = 1e3, friction: bool = True, window: float = FIRST,
    poles: str | None = None,
) -> Path:
    """The case at another rate, without friction, or with other poles, as a file of its own."""
    text = (folder / "chain6.toml").read_text()
    text = re.sub(r"period = [\d.]+", f"period = {1 / rate}", text)
    text = re.sub(r"sample_rate = [\d.]+", f"sample_rate = {rate}", text)
    if not friction:
        text = without_effects(text)
    if poles is not None:
        text = text.replace("poles = [-60.0, -60.0]", f"poles = {poles}")
    return written(folder / f"{name}.toml", text, window)


def without_effects(text: str) -> str:
    """The case of a chain without friction."""
    return re.sub(r"# mu m g.*?\n\n(?=\[controller\])", "", text, flags=re.S)


def written(path: Path, text: str, window: float) -> Path:
    """A case that identifies from its first instants."""
    path.write_text(text + f"\n[algebraic]\nwindow = [0.0, {window}]\n")
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


def run(
    case: Path, seconds: float, *, identify: bool = False, actuated: list[int] | None = None
) -> tuple[dict, jaxid.Live, list]:
    """The case's controller on the independent machine; and what was told at every tick."""
    live, told = jaxid.Live(case, identify=identify), []

    def law(_: int, reading: np.ndarray) -> np.ndarray:
        u = live.command(reading)
        told.append(live.told)
        return u

    machine, rate = chain(case, actuated), 1 / live.period
    log = simulate_under(machine, law, Sensor(0.0, 0.0), rate=rate, duration=seconds)
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
    head = ["friction", "law", "it knows", "x2", "worst mass", "switched at [ms]"]
    table = Table("tracking from 0.2 s on, RMS error [mm]", head)
    for friction, law, identify in itertools.product((False, True), LAWS, (False, True)):
        case = variant(folder, f"track_{len(LAWS[law])}_{friction}", friction=friction, poles=LAWS[law])
        log, live, told = run(case, SECONDS, identify=identify)
        late = log["t"] >= TRACKED_FROM
        rms = 1e3 * np.sqrt(np.mean((log["true_position"] - log["reference"])[late] ** 2, axis=0))
        switched = "never" if live.switched is None else f"{1e3 * live.switched * live.period:.0f}"
        who = "what was found" if identify else "the paper's wrong values"
        shown = f"{rms[1]:.3f}", f"{rms.max():.3f}", switched if identify else "-"
        table.row("yes" if friction else "no", law, who, *shown)
        if identify:
            good &= bool(rms[1] <= 0.5)
        if identify and law == "(4)-(5)":
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
    axes[kinds.index("stiffness")].legend(ncols=7, fontsize="small", title="mass or spring; dotted: true")
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
    axes[0].legend(ncols=2, title="mass", fontsize="small", loc="upper right")
    axes[-1].set_xlabel("time [s]")
    figure.savefig(folder / f"tracking_{suffix}_friction.png", dpi=130)
    plt.close("all")


def partial(folder: Path) -> bool:
    """Only mass 2 driven, every position measured: what can be told as the others begin to slide."""
    begin = time.perf_counter()
    text = (folder / "chain6.toml").read_text().replace('kind = "chain"', 'kind = "chain"\nactuated = [2]')
    text = re.sub(r"level = \[0.03.*?\]\nrise_time = \[.*?\]", "level = 0.05\nrise_time = 0.1", text)
    case = written(folder / "partial.toml", text, 1.0)
    log = run(case, 1.0, actuated=[2])[0]
    true, slid = truth(case), np.abs(log["true_velocity"]) > 1e-3
    first = [f"{1e3 * log['t'][np.argmax(s)]:.0f}" if s.any() else "never" for s in slid.T]
    print(f"\nonly mass 2 driven: the masses first slide at {', '.join(first)} ms")
    head = ["until [s]", *AIMS, "not told"]
    table = Table("told from the first instants: largest error [%] (how many)", head)
    good = True
    for until in (0.05, 0.1, 0.2, 0.3, 0.5, 1.0):
        case = written(folder / "partial.toml", text, until)
        n = round(until * 1e3) + 1
        part = as_log({k: v[:n] for k, v in log.items()}, "exact simulator")
        found = jaxid.identify(case, part, method="algebraic").estimate
        errors = worst(found, true)
        blind = [n for n, told in zip(found.names, found.identifiable, strict=True) if not told]
        short = [n.replace("coulomb_friction", "friction").replace(".level", "") for n in blind]
        table.row(f"{until:g}", *(words(errors.get(k)) for k in AIMS), " ".join(short) or "none")
        good &= until < FIRST or all(most <= AIMS[k] for k, (most, _, _) in errors.items())
    table.show(time.perf_counter() - begin)
    return good


def noise(folder: Path, runs: int = RUNS) -> bool:
    """What the paper leaves out: every form, inverse dynamics and output error against noise."""
    text = (folder / "chain6.toml").read_text().replace("duration = 10.0", f"duration = {FIRST}")
    names = ", ".join(f'"{m}"' for m in (*FORMS, "inverse_dynamics", "output_error"))
    levels = ", ".join(f"{10.0**k:g}" for k in range(5))
    text += f"\n[sensor]\nposition_noise = 1e-9\n\n[study]\nestimators = [{names}]\nnoise = [{levels}]\n"
    case, out, begin = written(folder / "noise.toml", text, FIRST), folder / "noise", time.perf_counter()
    rows = jaxid.study(case, runs=runs, folder=out, resume=(out / "study.json").exists()).summary
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), sharex=True, layout="constrained")
    table = Table(
        "RMS error, median over the parameters of a kind [%]; failed [%]",
        ["method", "noise [m]", *AIMS, "failed"],
    )
    estimators, at = list(dict.fromkeys(r["estimator"] for r in rows)), sorted({r["noise"] for r in rows})
    for ax, kind in zip(axes.flat, AIMS, strict=True):
        bound = [_median(rows, estimators[0], level, kind, "bound") for level in at]
        ax.loglog(1e-9 * np.array(at), bound, "k:", label="Cramer-Rao")
        for colour, name in enumerate(estimators):
            spread = [_median(rows, name, level, kind, "spread") for level in at]
            bias = [_median(rows, name, level, kind, "bias") for level in at]
            if not np.isfinite(spread).any():
                continue
            ax.loglog(1e-9 * np.array(at), spread, f"C{colour}-o", ms=3, label=name)
            ax.loglog(1e-9 * np.array(at), bias, f"C{colour}--", lw=0.8)
        ax.set(title=kind.replace("_", " "), ylabel="relative error [%]", ylim=(1e-4, 1e4))
        ax.grid(alpha=0.3)
    axes[1, 0].set_xlabel("position noise [m]")
    axes[1, 1].set_xlabel("position noise [m]; solid: spread, dashed: bias")
    axes[0, 0].legend(fontsize="x-small")
    figure.savefig(folder / "noise.png", dpi=130)
    plt.close("all")
    for name in estimators:
        for level in at:
            cells = [f"{_median(rows, name, level, kind, 'rmse'):.2g}" for kind in AIMS]
            own = [r["failed"] for r in rows if (r["estimator"], r["noise"]) == (name, level)]
            table.row(name, f"{1e-9 * level:g}", *cells, f"{100 * np.mean(own):.0f}")
    table.show(time.perf_counter() - begin)
    return True


def _median(rows: list[dict], estimator: str, level: float, kind: str, what: str) -> float:
    own = [
        100 * abs(r[what] / r["true"]) for r in rows
        if (r["estimator"], r["noise"]) == (estimator, level) and r["parameter"].startswith(kind)
    ]
    return float(np.median(own)) if own else np.nan


def cost(folder: Path) -> bool:
    """Seconds against the number of masses."""
    head = ["masses", "unknowns", "identify, first [s]", "again [ms]", "the fit alone [ms]", "a sample [us]"]
    table = Table("cost against masses, 0.1 s at 1 kHz", head)
    begin, times = time.perf_counter(), []
    for n in (2, 5, 10, 20, 50):
        case = written(folder / f"chain_{n}.toml", long_chain(n), FIRST)
        log = jaxid.simulate(case).log
        whole, own, session = [], [], jaxid.open_session(case, log)
        for _ in range(4):
            start = time.perf_counter()
            found = jaxid.identify(case, log, method="algebraic").estimate
            middle = time.perf_counter()
            alone(METHODS["algebraic"](session))
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


def long_chain(n: int) -> str:
    """A chain of n masses like the six, every one driven and following."""
    many = lambda make, count: "[" + ", ".join(make(k) for k in range(count)) + "]"
    value = lambda guess, true: f"{{ guess = {guess}, true = {true} }}"
    return f"""
[plant]
kind = "chain"
[plant.parameters]
mass = {many(lambda k: value(2.5, 2.0 + 0.5 * (k % 6)), n)}
damping = {many(lambda k: value(5.0, 5.5 - 0.5 * (k % 6)), n)}
stiffness = {many(lambda k: value(700.0, 1000.0 - 100.0 * (k % 7)), n + 1)}
[[effects]]
kind = "coulomb_friction"
joint = {many(lambda k: str(k + 1), n)}
level = {many(lambda k: value(4.905, 4.0 + 0.2 * (k % 5)), n)}
[controller]
kind = "flatness"
poles = [-60.0, -60.0]
epsilon = 1e-3
period = 0.001
[reference]
kind = "quarter_sine"
level = {many(lambda k: f"{0.03 + 0.01 * ((3 * k) % 4)}", n)}
rise_time = {many(lambda k: f"{0.07 + 0.01 * ((2 * k) % 5)}", n)}
hold_until = 5.0
return_until = 10.0
[simulation]
duration = {FIRST}
sample_rate = 1000.0
"""


def hidden(folder: Path) -> bool:
    """Friction that the case leaves out at one mass, and a cubic spring at one place: named with it."""
    begin, good = time.perf_counter(), True
    table = Table("hidden in the six masses, nothing declared", ["true", "verdict", "named", "evidence"])
    for kind, place, values in (
        ("coulomb_friction", 3, {"level": 4.7}), ("cubic_stiffness", 4, {"coefficient": 4e5}),
    ):
        case = folder / f"hidden_{kind}.toml"
        text = without_effects((folder / "chain6.toml").read_text())
        text = re.sub(r"\[reference\].*?(?=\[simulation\])", SWEEP, text, flags=re.S)
        case.write_text(text + "\n[sensor]\nposition_noise = 1e-6\n")
        plain = chain(case)
        live = jaxid.Live(case)
        log = simulate_under(
            plain.with_effect(kind, place, **values), lambda k, reading, live=live: live.command(reading),
            Sensor(0.0, 1e-6), rate=1 / live.period, duration=SECONDS,
        )
        found = jaxid.discover(case, as_log(log | {"reference": live.reference}, "exact simulator"))
        named = ", ".join(e.label for e in found.effects) or "-"
        evidence = ", ".join(f"{e.score.evidence:.0f}" for e in found.effects)
        table.row(name_of(kind, place), found.verdict, named, evidence)
        good &= [e.label for e in found.effects] == [name_of(kind, place)]
    table.show(time.perf_counter() - begin)
    return good


# Every mass to and fro on its own beat, so that springs and frictions are told apart.
SWEEP = """[reference]
kind = "trapezoid"
start = 0.0
targets = [0.02, -0.015, 0.03, 0.005, -0.025, 0.0]
speed = [0.05, 0.08, 0.11, 0.06, 0.09, 0.07]
acceleration = [1.0, 1.6, 2.2, 1.2, 1.8, 1.4]

"""


PARTS: dict[str, Callable[[Path], bool]] = {
    "first_instants": first_instants, "tracking": tracking, "partial": partial, "noise": noise,
    "cost": cost, "hidden": hidden,
}


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
