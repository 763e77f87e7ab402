"""Logs that cannot tell effects apart, and the state of a search that has just found that out."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import stepper_machines as machines
from search_setup import Declared, case_text, log_of, write_case
from stepper import Loop
from stepper_machines import Setup

from jaxid.commands.discover import start_search
from jaxid.discovery import candidates as cand
from jaxid.discovery.score import Score
from jaxid.discovery.search import Model, Search
from jaxid.discovery.separating.propose import Proposal, propose
from jaxid.session import open_session

VISCOUS = ("viscous_friction", {"coefficient": 203.5})
COULOMB = ("coulomb_friction", {"level": 20.39})
OFFSET = ("constant_force", {"level": 3.0})
SPRING = ("linear_stiffness", {"coefficient": 3000.0})
WIDER = "[limits]\nstroke = [0.0, 0.25]\nspeed = 0.15\n"


def hidden(
    kind: str, values: Mapping[str, float], declared: Declared, reference: np.ndarray, noise: float
) -> Setup:
    """An axis with one effect that its case does not know, under a reference."""
    own = machines.emps_like(0, noise, len(reference) / 1000.0)
    effects = {name: dict(v) for name, v in declared} | {kind: dict(values)}
    machine = dataclasses.replace(own.machine, effects=effects)
    return dataclasses.replace(own, machine=machine, loop=dataclasses.replace(own.loop, reference=reference))


def curved(seconds: float = 8.0) -> tuple[Setup, Declared]:
    """A progressive spring seen over 2 cm only, where any curvature looks alike.

    Two degrees of polynomial differ by 400 N/m^2 times (1 cm)^2, a tenth of the noise.
    """
    declared = (VISCOUS, COULOMB, OFFSET)
    t = np.arange(round(seconds * 1000.0)) / 1000.0
    reference = machines.moves(t, (0.19, 0.21), (0.04, 0.03, 0.02, 0.04), 0.4)
    return hidden("quadratic_stiffness", {"coefficient": 400.0}, declared, reference, 30.0), declared


def one_speed(seconds: float = 8.0) -> tuple[Setup, Declared]:
    """Friction that differs by direction, seen at one speed, where it is a constant force."""
    declared = (VISCOUS, COULOMB)
    t = np.arange(round(seconds * 1000.0)) / 1000.0
    reference = machines.moves(t, (0.1, 0.2), (0.05, 0.05), 2.0)
    return hidden("asymmetric_viscous", {"coefficient": 20.0}, declared, reference, 30.0), declared


def heavier(seconds: float = 4.0) -> tuple[Setup, Declared]:
    """A load that the case does not know: a mass, or a drive that is weaker than it says."""
    declared = (VISCOUS, COULOMB)
    t = np.arange(round(seconds * 1000.0)) / 1000.0
    reference = machines.moves(t, machines.EMPS_WAYPOINTS, machines.EMPS_SPEEDS, 0.8424)
    return hidden("added_mass", {"mass": 15.0}, declared, reference, 1.0), declared


def sprung(seconds: float = 4.0) -> tuple[Setup, Declared]:
    """An axis on a spring in open loop, shaken at one frequency."""
    t = np.arange(round(seconds * 1000.0)) / 1000.0
    loop = Loop(kind="open_loop", input=2.0 * np.sin(2 * np.pi * 1.0 * t))
    own = hidden("quadratic_drag", {"coefficient": 3000.0}, (VISCOUS, SPRING), t, 10.0)
    return dataclasses.replace(own, loop=loop), (VISCOUS, SPRING)


def again(setup: Setup, proposal: Proposal, seed: int = 5) -> dict[str, np.ndarray]:
    """What the true machine makes of a proposed experiment."""
    values, start = proposal.values[:, 0], float(proposal.start[0])
    changed = {"input" if setup.loop.kind == "open_loop" else "reference": values}
    loop = dataclasses.replace(setup.loop, **changed)
    moved = dataclasses.replace(setup, loop=loop, seed=seed, duration=len(values) / setup.rate)
    return moved.run(initial_position=start)


def started(setup: Setup) -> float:
    """Where its reference starts."""
    return 0.0 if setup.loop.reference is None else float(setup.loop.reference[0])


def proposed(
    setup: Setup, declared: Declared, kinds: tuple[str, str], folder: Path, *, more: str = "", **options
) -> Proposal:
    """The experiment for a pair of effects, without the search that would find the pair."""
    case = write_case(folder, case_text(setup, declared, **options) + more)
    session = open_session(case, log_of(setup, initial_position=started(setup)), align_hold=True)
    _, search = start_search(session)
    own, rival = (next(c for c in search.superset.candidates if c.kind == kind) for kind in kinds)
    search.model = Model((own,), _fitted(search, own))
    score = Score(rival, 0, rival.starts[0], 0.0, theta=_fitted(search, rival))
    return propose(session, search, own, score)


def _fitted(search: Search, c: cand.Candidate) -> np.ndarray:
    theta = search.superset.neutral.copy()
    # A tenth of what would explain all of the force.
    theta[c.index] = np.where(c.amplitude, 0.1, 1.0) * c.starts[0]
    active = np.concatenate([search.superset.base, c.index]).astype(int)
    return cand.refine(search.superset, search.samples, theta, active)[0]
