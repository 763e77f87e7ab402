"""Two effects that a log cannot tell apart, and the experiment that tells them.

Hypothesis: where a progressive spring is seen over 2 cm only, `discover` names one of several
springs and lists the true one with it; the experiment that it proposes, run on the machine, leaves
the true one alone. Accepted where the two rivals are within 3 nats on the first log and more than
100 nats apart on the second, the true spring (400 N/m^2, quadratic) is named there without rivals,
its coefficient is within 5 %, and the machine kept within the limits of the case.

The machine is the exact simulator of `truth/`, which shares no code with jaxid.

    python -m experiments.separate [-o results/separate]
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import jaxid
from experiments.common import Table, arguments, copied
from jaxid.references import make_reference
from truth.axis.ambiguous import curved, started
from truth.axis.stepper import write_csv

TRUE, COEFFICIENT = "quadratic_stiffness", 400.0


def scores(found) -> dict[str, float]:
    """Evidence of every effect beside the baseline [nats]."""
    return {s.candidate.kind: s.evidence for s in found.rounds[1].step.scores}


def second_log(folder: Path, proposal) -> tuple[Path, dict]:
    """Run the machine on the proposed reference."""
    setup, _ = curved()
    table = {"kind": "csv", "file": proposal.file, "time": "t", "column": "reference"}
    reference = make_reference(table, setup.rate, len(proposal.time) / setup.rate, folder / "first")
    moved = replace(setup, loop=replace(setup.loop, reference=reference[:, 0]), seed=5)
    ran = moved.run(initial_position=float(proposal.start[0]))
    write_csv(ran, folder / "second.csv")
    return folder / "second.csv", ran


def main() -> int:
    args = arguments(__doc__, "results/separate")
    folder = copied(args.o, ("separate.toml",))
    case, first = folder / "separate.toml", folder / "first.csv"
    setup, _ = curved()
    write_csv(setup.run(initial_position=started(setup)), first)
    begin = time.perf_counter()
    before = jaxid.discover(case, first)
    before.save(folder / "first")
    seconds = time.perf_counter() - begin
    proposal = before.proposals[0]
    print(before)
    second, ran = second_log(folder, proposal)
    begin = time.perf_counter()
    after = jaxid.discover(case, second, validate=[first])
    after.save(folder / "second")
    print(f"\n{after}")
    old, new = scores(before), scores(after)
    table = Table("evidence over the true spring's [nats]", ["", "first log", "proposed experiment"])
    rivals = [k for k in ("linear_stiffness", "quadratic_stiffness", "cubic_stiffness") if k != TRUE]
    for kind in rivals:
        table.row(kind, f"{old[kind] - old[TRUE]:+.1f}", f"{new[kind] - new[TRUE]:+.1f}")
    table.row("expected (the nearest rival)", f"{-abs(proposal.present):+.1f}", f"{-proposal.expected:+.1f}")
    table.show(seconds + time.perf_counter() - begin)
    value = after.after.value(f"{TRUE}.coefficient") if after.kinds == [TRUE] else float("nan")
    low, high = ran["true_position"].min(), ran["true_position"].max()
    speed = abs(ran["true_velocity"]).max()
    print(f"moved from {low:.4f} to {high:.4f} m at up to {speed:.4f} m/s; coefficient {value:.1f} N/m^2")
    accepted = (
        abs(old[proposal.named] - old[proposal.rival]) < 3.0
        and abs(new[proposal.named] - new[proposal.rival]) > 100.0
        and after.kinds == [TRUE]
        and not after.effects[0].alternatives
        and abs(value / COEFFICIENT - 1) < 0.05
        and low >= 0.0
        and high <= 0.25
        and speed <= 0.15
    )
    print("accepted" if accepted else "NOT accepted")
    return 0 if accepted else 1


if __name__ == "__main__":
    sys.exit(main())
