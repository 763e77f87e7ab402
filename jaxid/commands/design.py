"""The command `design`: the experiment whose log would identify a case's unknowns best."""

from __future__ import annotations

from collections.abc import Callable

from jaxid.build import build_machine
from jaxid.case.case import Case, CaseLike, load_case
from jaxid.errors import InputError
from jaxid.experiment_design.along_reference import Excitation, excite
from jaxid.experiment_design.in_loop import Design, design_in_loop
from jaxid.scene import sampling_of


def design(case: CaseLike, *, progress: Callable[[str], None] = lambda text: None) -> Design | Excitation:
    """Find the reference (in a loop) or the input that tells a case's unknowns best, at its guesses.

    Of an arm, and of any case with a key in [design], the reference is taken to be followed: see
    `jaxid.experiment_design.along_reference.excite`. Else:

    The logarithm of the information's determinant is raised through the simulation by gradients (D-optimal;
    Bayesian: each guess is a prior of the relative width `[within_prior] prior`, 0.5 where absent), over sums
    of sines and a tour from end to end, within [limits].

    Args:
        case: The case, its file, or a dict with its tables; it needs [simulation] duration and sample_rate,
            [limits] stroke and speed (in open loop force), and in [sensor] the noise of what
            `[output_error] on` compares.
        progress: Called with a line at every stage.

    Raises:
        InputError: If the case lacks any of these, or no experiment keeps within the limits.

    Source:
        Chaloner and Verdinelli (1995), "Bayesian experimental design: a review".
    """
    case = load_case(case)
    _check(case)
    if case.plant.cls.linked or case.design is not None:
        return excite(case, progress)
    return design_in_loop(case, progress)


def _check(case: Case) -> None:
    """Refuse a case without what any design needs."""
    where = case.where
    for table, key in (
        ("simulation", "duration"),
        ("simulation", "sample_rate"),
        ("limits", "stroke"),
        ("limits", "speed"),
    ):
        if getattr(getattr(case, table), key) is None:
            raise InputError(f"[{table}] has no {key}", where=where, hint=f"add {key} = ... to [{table}]")
    if not build_machine(case, period=1 / sampling_of(case)[0]).parameters.free:
        raise InputError("nothing is unknown", where=where, hint="give a parameter as { guess = ... }")
