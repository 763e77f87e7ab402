"""The micropositioning stage: what a hundred noisy samples of its current tell, and what they do not.

Bogdan & Abba, "Identification of mechanical parameters at low velocities for a micropositioning stage using a
velocity hysteresis model". Its Table 1, read in SI as `truth/chain/stages.py` says, is the truth here, in an
exact simulator that shares no code with jaxid (set-valued friction, 5 us).

    python -m experiments.bogdan_micropositioning [-o FOLDER] [--only NAME] [--runs N]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import jaxid
from experiments import bogdan_figures
from experiments.bogdan_logs import ON_FORCE, case_of, logs_of, noise_of, off_in_sigma, studied
from experiments.bogdan_scatter import calibrated, elastic, nearest, scatter, within
from experiments.common import Table, parser_of
from jaxid.commands.identify import identify_many
from jaxid.logs.log import Log
from truth.chain import stages

# Of the published table: relative precision of data 1 and 2 [%].
PUBLISHED = {
    "motor_inertia": (2.02, 2.00),
    "viscous_friction[1].coefficient": (2.37, 6.43),
    "coulomb_friction[1].level": (1.27, 1.08),
    "table_mass": (1.64, 2.63),
    "viscous_friction[2].coefficient": (2.01, 2.13),
    "coulomb_friction[2].level": (1.90, 1.77),
    "velocity_hysteresis[2].level": (3.51, 7.29),
    "velocity_hysteresis[2].level_negative": (1.75, 3.14),
    "velocity_hysteresis[2].velocity": (3.12, 4.05),
    "cogging[2].amplitude": (1.58, 3.51),
    "cogging[2].phase": (2.17, 2.98),
}
RUNS = 48


def published(folder: Path, runs: int) -> None:
    """(a) as published: one log of each, guesses up to 50 % off."""
    for data in (1, 2):
        start = time.perf_counter()
        case = case_of(folder, f"data{data}", data, guess=data, more=ON_FORCE + "starts = 256\n")
        (log,), (begin,) = logs_of(data, 1)
        try:
            found = jaxid.identify(case, log)
        except jaxid.InputError as error:
            print(f"\ndata {data}: refused: {error}", flush=True)
            continue
        found.save(folder / f"data{data}", overwrite=True)
        estimate = found.estimate
        truth = np.array([stages.TRUTH[data][n] for n in estimate.names])
        table = Table(
            f"Data {data}: criterion {estimate.details['criterion_percent']:.2f} % "
            f"(published {stages.CRITERION[data]} %), {estimate.steps} evaluations, starts alike: "
            "{same_optimum} of {count}, {flat} of which stick at first".format(**estimate.details["starts"]),
            ["parameter", "truth", "guess", "found", "sigma %", "published P %"],
        )
        guesses = stages.drawn(data, data=data)
        for name, true, value, std in zip(estimate.names, truth, estimate.theta, estimate.std, strict=True):
            told = f"{100 * std / abs(value):.1f}" if np.isfinite(std) else "not identified"
            table.row(
                name, f"{true:.3g}", f"{guesses[name]:.3g}", f"{value:.3g}", told, PUBLISHED[name][data - 1]
            )
        table.show(time.perf_counter() - start)
        sigmas = off_in_sigma(estimate, case, log, begin, stages.TRUTH[data])
        for d, off in zip(estimate.details["directions"], sigmas, strict=True):
            parts = " ".join(f"{v:+.2f} {n}" for n, v in d["combination"].items() if abs(v) > 0.15)
            print(f"  {0.5 * d['value']:+.3f} +- {0.5 * d['std']:.3f} ({off:+.1f} sigma): {parts}")
        bogdan_figures.fit(folder / f"data{data}.png", found, data)


def begun(folder: Path, runs: int) -> None:
    """Data 1 with the fit begun elsewhere than at the guesses."""
    (log,), (begin,) = logs_of(1, 1)
    table = Table(
        "Data 1, the fit begun from", ["start", "criterion %", "evaluations", "combinations, in sigma off"]
    )
    start = time.perf_counter()
    for name in ("guess", "inverse_dynamics", "recursive"):
        case = case_of(folder, f"from_{name}", 1, guess=1, more=f'{ON_FORCE}start = "{name}"\n')
        estimate = jaxid.identify(case, log).estimate
        off = off_in_sigma(estimate, case, log, begin, stages.TRUTH[1])
        table.row(
            name,
            f"{estimate.details['criterion_percent']:.2f}",
            estimate.steps,
            ", ".join(f"{o:+.1f}" for o in off),
        )
    table.show(time.perf_counter() - start)


# Guesses of what the reference was, over the truth.
REFERENCE_OFF = {"onset": 1.4, "speed": 0.8, "acceleration": 1.3}


def unrecorded(folder: Path, runs: int) -> None:
    """Data 1 without its reference: onset, speed and ramp are fitted with the machine."""
    start = time.perf_counter()
    move = stages.MOVES[1]
    speed = move["speed"] / stages.R
    true = {"onset": move["onset"], "speed": speed, "acceleration": speed / stages.RAMP}
    stated = f'[reference]\nkind = "trapezoid"\ntargets = [{move["distance"] / stages.R!r}]\nrepeat = false\n'
    stated += "".join(f"{k} = {{ guess = {v * REFERENCE_OFF[k]!r} }}\n" for k, v in true.items())
    case = case_of(folder, "unrecorded", 1, guess=1, more=ON_FORCE + stated, reference="")
    (log,), _ = logs_of(1, 1)
    found = jaxid.identify(case, replace(log, reference=None))
    found.save(folder / "unrecorded", overwrite=True)
    table = Table(
        f"Data 1 without its reference: criterion {found.estimate.details['criterion_percent']:.2f} %",
        ["of the reference", "true", "guess", "found", "sigma"],
    )
    for name, std in zip(found.estimate.names, found.estimate.std, strict=True):
        where, _, key = name.partition(".")
        if where == "reference":
            table.row(
                key,
                f"{true[key]:.4g}",
                f"{true[key] * REFERENCE_OFF[key]:.4g}",
                f"{found.value(name):.4g}",
                f"{std:.2g}" if np.isfinite(std) else "not identified",
            )
    table.show(time.perf_counter() - start)


def position(folder: Path, runs: int) -> None:
    """Fit the position in place of the current, which the paper says goes wrong, and show the cause."""
    table = Table(
        f"Output error on current and on position: {runs // 2} runs of data 1, and 64 starts 50 % off",
        [
            "fitted",
            "encoder",
            "directions",
            "off, of 1st and 2nd",
            "their sigma",
            "in 1.96 sigma",
            "over truth's",
            "starts alike",
        ],
    )
    start = time.perf_counter()
    for on in ("force", "position"):
        for name, resolution in (("exact", 0.0), ("500 counts", stages.COUNT)):
            stated = ON_FORCE.replace('"force"', f'"{on}"')
            case = case_of(folder, "position", 1, resolution=resolution, more=stated)
            logs, starts = logs_of(1, runs // 2, resolution=resolution)
            found, rows = studied(case, logs, starts, stages.TRUTH[1], on)
            off = [r["off"] for r in rows]
            # Of a log that tells one only there is no second.
            two = lambda values: np.resize([*values[:2], np.nan, np.nan], 2)
            std = np.array([two([d["std"] for d in e.details["directions"]]) for e in found])
            stated += "starts = 64\n"
            far = case_of(folder, "position", 1, guess=1, resolution=resolution, more=stated)
            alike = jaxid.identify(far, logs[0]).estimate.details["starts"]
            wrong = np.sqrt(np.nanmean((std * np.array([two(o) for o in off])) ** 2, axis=0))
            share = lambda x: ", ".join(f"{50 * v:.2g} %" for v in x)
            table.row(
                "current" if on == "force" else on,
                name,
                f"{np.mean([len(o) for o in off]):.1f}",
                share(wrong),
                share(np.nanmedian(std, axis=0)),
                f"{np.mean(np.abs(np.concatenate(off)) < 1.96):.0%}",
                f"{np.mean([r['ratio'] for r in rows]):.3f}",
                f"{alike['same_optimum']} of {alike['count']}",
            )
    table.show(time.perf_counter() - start)


DESIGN = """
[limits]
stroke = [0.0, 6.3]
speed = 6.3
[simulation]
duration = 10.0
sample_rate = 200.0
"""


# Logs of either screw, and the part of its prior below which a parameter counts as visible.
DESIGNED, VISIBLE = 8, 0.5


def designed(folder: Path, runs: int) -> None:
    """(b) Logs of 2000 samples out and back, found by its information; both screws; one with 32 starts."""
    start = time.perf_counter()
    # Who designs knows his guesses only.
    text = stages.text(1, guess=stages.drawn(1, data=1), reference="", more=ON_FORCE + DESIGN)
    noise = noise_of(1, stages.COUNT)
    (folder / "design.toml").write_text(text.replace("[sensor]\n", f"[sensor]\nforce_noise = {noise!r}\n"))
    plan = jaxid.design(folder / "design.toml")
    plan.save(folder / "design.csv")
    print(f"\n{plan}\n({time.perf_counter() - start:.0f} s)", flush=True)
    names, reference = plan.machine.parameters.names, plan.values[:, 0]
    visible = plan.std < VISIBLE * 0.5
    case = case_of(folder, "designed", 1, guess=1)
    many = case_of(folder, "designed_starts", 1, guess=1, more=ON_FORCE + "starts = 32\n")
    table = Table(
        f"{DESIGNED} designed logs of either screw: in how many each parameter is told, and how far off",
        [
            "parameter",
            "expected",
            "visible",
            "rigid: told",
            "sigma off at most",
            "elastic: told",
            "sigma off at most",
        ],
    )
    cells: dict[str, list[str]] = {n: [] for n in names}
    for rigid in (True, False):
        screw = "rigid" if rigid else "elastic"
        logs, begins = logs_of(1, DESIGNED, rigid=rigid, reference=reference)
        found = identify_many(case, logs)
        fits = zip(found, logs, begins, strict=True)
        off = [off_in_sigma(e, case, log, b, stages.TRUTH[1]) for e, log, b in fits]
        each = np.concatenate(off)
        inside = f"{np.mean(np.abs(each) < 3):.0%} within 3 sigma, at most {np.abs(each).max():.1f}"
        print(f"  {screw}: {', '.join(str(len(o)) for o in off)} combinations, {inside}", flush=True)
        estimate = jaxid.identify(many, logs[0]).estimate
        alike = "of {count} starts {same_optimum} end at one cost"
        alike = alike.format(**estimate.details["starts"])
        print(f"  {screw}: {alike} ({time.perf_counter() - start:.0f} s)", flush=True)
        for k, name in enumerate(names):
            true = stages.TRUTH[1][name]
            z = np.array([(e.theta[k] - true) / e.std[k] for e in found if np.isfinite(e.std[k])])
            cells[name] += [f"{z.size} of {DESIGNED}", f"{np.abs(z).max():.1f}" if z.size else ""]
    for name, std, seen in zip(names, plan.std, visible, strict=True):
        table.row(name, f"{std:.1%}", "yes" if seen else "no", *cells[name])
    table.show(time.perf_counter() - start)


# Of the scale that reads the table, where one does [m].
SCALE = 1e-7


def load(folder: Path, runs: int) -> None:
    """(b) What `designed` wrote, run again: the table's position logged, the elastic screw in the model."""
    start = time.perf_counter()
    reference, begin = np.loadtxt(folder / "design.csv", delimiter=",", skiprows=1)[:, 1], 0.3 * stages.COUNT
    first = np.round(reference[0] / stages.COUNT) * stages.COUNT
    made = stages.record(
        stages.machine(1), reference, noise=noise_of(1, stages.COUNT), step=2e-6, start=first + begin
    )
    scale = np.round(made["x"] / SCALE) * SCALE
    log = Log(
        time=made["t"],
        position=made["q"][:, None],
        force=made["i"][:, None],
        reference=reference[:, None],
        load_position=scale[:, None],
        source="the designed log",
    )
    stated = ON_FORCE.replace('"force"', '"both"')
    case = case_of(folder, "load", 1, guess=1, coupling="elastic", more=stated)
    counts = f"position_resolution = {stages.COUNT!r}"
    case.write_text(case.read_text().replace(counts, f"position_resolution = [{stages.COUNT!r}, {SCALE!r}]"))
    found = jaxid.identify(case, log)
    found.save(folder / "load", overwrite=True)
    off = ", ".join(f"{o:+.1f}" for o in off_in_sigma(found.estimate, case, log, begin, stages.TRUTH[1]))
    table = 1e6 * found.gaps[0].simulation.rms[1]
    e, seconds = found.estimate, time.perf_counter() - start
    print(f"\nload: {e.message} in {e.steps} evaluations ({seconds:.0f} s)")
    print(f"combinations off by {off} sigma; the simulated table by {table:.1f} um\n{found}", flush=True)


def needles(folder: Path, runs: int) -> None:
    """Draw the cost with and without simulated rounding of the encoder: it has many narrow minima."""
    start = time.perf_counter()
    case = case_of(folder, "needles", 1, more=bogdan_figures.SIMULATED)
    bogdan_figures.needles(folder / "needles.png", jaxid.load_case(case))
    print(f"\nneedles.png: the cost with and without rounding ({time.perf_counter() - start:.1f} s)")


def frictions(folder: Path, runs: int) -> None:
    """Figures 3 and 6 redrawn: friction against velocity of both data sets, and its hysteresis."""
    bogdan_figures.frictions(folder / "frictions.png")
    print("\nfrictions.png: friction torque against velocity, both data sets")


def hidden(folder: Path, runs: int) -> None:
    """Search a log for friction that a case with Coulomb and viscous friction only lacks."""
    start = time.perf_counter()
    case, log = stages.long_case(folder, stages.to_and_fro())
    found = jaxid.discover(case, log)
    found.save(folder / "hidden", overwrite=True)
    print(f"\nhidden: {found.verdict} ({time.perf_counter() - start:.1f} s)\n{found}")


def one_way(folder: Path, runs: int) -> None:
    """Search a log without reversals, by its forces and in the simulated loop."""
    case, log = stages.long_case(folder, stages.one_way())
    stated = case.read_text()
    for name, more in (("one_way", ""), ("one_way_in_the_loop", ON_FORCE)):
        start = time.perf_counter()
        case.write_text(stated + more)
        found = jaxid.discover(case, log)
        found.save(folder / name, overwrite=True)
        print(f"\n{name}: {found.verdict} ({time.perf_counter() - start:.1f} s)\n{found}", flush=True)


def named(case: Path, log: Log) -> str:
    """Return the effects that `discover` names, or its verdict."""
    found = jaxid.discover(case, log)
    return " + ".join(e.label for e in found.effects) or found.verdict


# Of the current, where the encoder is exact: beside the published one, such as shows the friction [A].
QUIET = 2e-3


def short(folder: Path, runs: int) -> None:
    """Compare models on a hundred samples: the gain of the true one, and the result of `discover`."""
    table = Table(
        f"Plain friction fitted to {runs} logs of 100 samples: nats by which the true model is likelier",
        ["data", "encoder", "noise [mA]", "median", "most", "verdicts of discover on the first 8"],
    )
    start = time.perf_counter()
    for data in (1, 2):
        for name, resolution, noise in (
            ("exact", 0.0, None),
            ("500 counts", stages.COUNT, None),
            ("exact", 0.0, QUIET),
        ):
            logs, _ = logs_of(data, runs, resolution=resolution, noise=noise)
            whole = case_of(folder, f"short{data}", data, resolution=resolution)
            text = whole.read_text()
            hidden = text[text.index('[[effects]]\nkind = "velocity_hysteresis"') : text.index("[actuator]")]
            plain = folder / f"short{data}_plain.toml"
            plain.write_text(text.replace(hidden, ""))
            # The whole model's guesses are the truth: an oracle's.
            criteria = [
                np.array([e.details["criterion_percent"] for e in identify_many(case, logs)])
                for case in (plain, whole)
            ]
            nats = 0.5 * logs[0].samples * np.log(criteria[0] / criteria[1])
            said = [named(plain, log) for log in logs[:8]]
            verdicts = ", ".join(f"{said.count(v)} {v}" for v in dict.fromkeys(said))
            size = 1e3 * (noise_of(data, resolution) if noise is None else noise)
            table.row(data, name, f"{size:.1f}", f"{np.median(nats):.1f}", f"{np.max(nats):.1f}", verdicts)
            took = f"{np.median(nats):.1f} nats, {verdicts} ({time.perf_counter() - start:.0f} s)"
            print(f"  data {data}, {name}: {took}", flush=True)
    table.show(time.perf_counter() - start)


STUDIES: dict[str, Callable[[Path, int], None]] = {
    f.__name__: f
    for f in (
        published,
        begun,
        unrecorded,
        scatter,
        within,
        nearest,
        elastic,
        calibrated,
        position,
        designed,
        load,
        needles,
        frictions,
        hidden,
        one_way,
        short,
    )
}


def main() -> None:
    parser = parser_of(__doc__, "results/bogdan_micropositioning")
    parser.add_argument("--only", choices=STUDIES, help="one of the studies")
    parser.add_argument("--runs", type=int, default=RUNS, help="of Monte-Carlo, a row (default: %(default)s)")
    args = parser.parse_args()
    args.o.mkdir(parents=True, exist_ok=True)
    for name, study in STUDIES.items():
        if args.only in (None, name):
            study(args.o, args.runs)


if __name__ == "__main__":
    main()
