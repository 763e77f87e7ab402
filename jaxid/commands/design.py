"""The command `design`: the experiment whose log identifies the unknowns of a case best."""

from __future__ import annotations

from collections.abc import Callable

from jaxid.build import build_machine
from jaxid.case.case import Case, CaseLike, load_case
from jaxid.case.user_faults import named_faults
from jaxid.commands.identify import Identification, identify
from jaxid.errors import InputError
from jaxid.experiment_design.along_reference import Excitation, excite
from jaxid.experiment_design.in_loop import Design, design_in_loop
from jaxid.experiment_design.unforced import designed_unforced
from jaxid.experiment_design.unforced_design import UnforcedDesign
from jaxid.scene import sampling_of
from jaxid.session import Logs


@named_faults()
def design(
    case: CaseLike, log: Logs = None, *, progress: Callable[[str], None] = lambda text: None
) -> Design | Excitation | UnforcedDesign:
    """Find the reference, or in open loop the input, that identifies the unknowns of a case best.

    For an arm whose force is logged, and for any such case with a key in [design], the machine is assumed to
    follow the reference: see `jaxid.experiment_design.along_reference.excite`. Otherwise gradients through
    the simulation maximise the logarithm of the determinant of the information matrix at the guesses
    (D-optimal; Bayesian: each guess is a prior of the relative width `[within_prior] prior`, by default 0.5).
    Candidates are sums of sines and a tour from end to end, within [limits].

    If the case has a controller and its [log] no force, the information is that of the position of the
    simulated loop, beside that of a log which is given: see `jaxid.experiment_design.unforced`.

    Args:
        case: The case, its file, or a dict with its tables; it needs [simulation] duration and sample_rate,
            [limits] stroke and speed (in open loop force), and in [sensor] the noise of the signal that
            `[output_error] on` compares.
        log: Log, or several, of a case without a force: they are fitted first, and the experiment adds to
            what they tell. None: those of [[fit]], or none.
        progress: Function called with a line of text at every stage.

    Raises:
        InputError: If the case lacks any of these, a log is given for a case with a force, or no experiment
            keeps within the limits.

    Source:
        Chaloner and Verdinelli (1995), "Bayesian experimental design: a review".
    """
    case = load_case(case)
    _check(case)
    if case.without_force:
        return designed_unforced(case, _fit_of(case, log, progress), progress)
    if log is not None:
        what = "an experiment beside a log is designed for a case without a force"
        raise InputError(
            what, where=case.where, hint="leave the log out, and put its estimates into the case"
        )
    if case.plant.cls.linked or case.design is not None:
        return excite(case, progress)
    return design_in_loop(case, progress)


def _fit_of(case: Case, log: Logs, progress: Callable[[str], None]) -> Identification | None:
    """Fit the logs that there are, by the position of the loop; None if there are none."""
    if log is None and not case.fits:
        return None
    progress("fitting the present logs")
    return identify(case, log, progress=progress)


def _check(case: Case) -> None:
    """Refuse a case that lacks a key which every design needs."""
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
        raise InputError("no parameter is unknown", where=where, hint="give a parameter as { guess = ... }")
