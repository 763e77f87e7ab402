"""The command line: thin covers of the Python interface, loaded only when asked for."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn, Protocol

from jaxid import _cache
from jaxid.errors import InputError, suggest

METHODS = (
    "output_error",
    "inverse_dynamics",
    "algebraic",
    "instrumental_variable",
    "didim",
    "power",
    "recursive",
    "algebraic_single_time",
    "algebraic_ratio",
    "algebraic_sign_changed",
    "algebraic_sign_unchanged",
    "minimal_model",
    "minimal_model_printed",
)
OUTPUTS = ("position", "force", "both")
SOLVERS = ("tsit5", "dopri5", "dopri8", "bosh3", "kvaerno3", "kvaerno5")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 done, whatever the verdict; 2 bad input; 1 anything else, no convergence included.
    """
    try:
        args = _parser().parse_args(argv)
        status = args.run(args)
        sys.stdout.flush()
        return status
    except InputError as error:
        print(f"jaxid: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxid: interrupted", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # Whoever read the output has gone; Python would complain once more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"jaxid: {error}", file=sys.stderr)
        return 1


def entry() -> None:
    """Entry point of the installed command."""
    _cache.configure()
    sys.exit(main())


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line too, with exit status 2."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message, hint=f"see {self.prog} --help")


class _Version(argparse.Action):
    """The option `--version`, which looks the version up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from jaxid import __version__

        print(f"jaxid {__version__}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="jaxid",
        description="Identify machines with friction, and find the physics that a simulation is missing.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _demo(commands)
    for name, what, run in (
        ("plants", "the plants there are, with parameters and units", _run_plants),
        ("effects", "the effects there are, with parameters and units", _run_effects),
    ):
        commands.add_parser(name, help=what, description=what).set_defaults(run=run)
    _simulate(commands)
    _design(commands)
    _check(commands)
    _identify(commands)
    _discover(commands)
    _study(commands)
    return parser


def _add(
    commands: argparse._SubParsersAction, name: str, what: str, run: Callable
) -> argparse.ArgumentParser:
    parser = commands.add_parser(name, help=what, description=what)
    parser.set_defaults(run=run)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--force", action="store_true", help="overwrite what jaxid did not make")
    return parser


def _demo(commands: argparse._SubParsersAction) -> None:
    what = "the whole way, check to report, on a log that ships with jaxid"
    parser = _add(commands, "demo", what, _run_demo)
    parser.add_argument("-o", metavar="DIR", default="jaxid-demo", help="default: jaxid-demo")


def _simulate(commands: argparse._SubParsersAction) -> None:
    parser = _add(commands, "simulate", "the log that a case would give", _run_simulate)
    parser.add_argument("case", metavar="CASE.toml")
    parser.add_argument("-o", metavar="LOG.csv", required=True)
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the sensors' noise")


def _design(commands: argparse._SubParsersAction) -> None:
    what = "the reference, or input, within [limits] whose log would tell the unknowns best"
    parser = _add(commands, "design", what, _run_design)
    parser.add_argument("case", metavar="CASE.toml")
    parser.add_argument("-o", metavar="SIGNAL.csv", required=True)


def _logs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("case", metavar="CASE.toml")
    parser.add_argument("log", metavar="LOG")
    parser.add_argument("-o", metavar="DIR", help="where results go; absent: only printed")


def _validate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--validate",
        metavar="LOG2",
        action="append",
        default=[],
        help="a log to validate on, beside the case's own; may be repeated",
    )


def _check(commands: argparse._SubParsersAction) -> None:
    what = "before any fit: is the log sound, does it excite what is asked, what can be told apart"
    _logs(_add(commands, "check", what, _run_check))


def _identify(commands: argparse._SubParsersAction) -> None:
    parser = _add(commands, "identify", "identify the unknowns of a case from a log", _run_identify)
    _logs(parser)
    parser.add_argument("--method", metavar="M", default="output_error", help=", ".join(METHODS))
    parser.add_argument(
        "--on",
        metavar="WHAT",
        help=f"what output_error fits in a closed loop: {', '.join(OUTPUTS)}; absent: as the case says, "
        "or position",
    )
    parser.add_argument(
        "--solver",
        metavar="NAME",
        help="let diffrax integrate in output_error, dry friction smoothed: "
        f"{', '.join(SOLVERS)}; absent: fixed steps, dry friction exact",
    )
    _validate(parser)


def _discover(commands: argparse._SubParsersAction) -> None:
    what = "find the effects that a case's model is missing, add them, show the gap shrink"
    parser = _add(commands, "discover", what, _run_discover)
    _logs(parser)
    _validate(parser)
    parser.add_argument("--max-effects", metavar="N", type=int, default=5, help="default: 5")
    parser.add_argument(
        "--experiments",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="design experiments that tell rivals apart; default: not of arms, where it takes minutes",
    )


def _study(commands: argparse._SubParsersAction) -> None:
    what = "simulate and identify a case over and over: bias, spread, and whether intervals hold the truth"
    parser = _add(commands, "study", what, _run_study)
    parser.add_argument("case", metavar="CASE.toml")
    parser.add_argument("-o", metavar="DIR", help="where chunks and results go; absent: only printed")
    parser.add_argument(
        "--runs", metavar="N", type=int, help="under each setting; absent: the case's, or 100"
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of everything drawn; default: 0")
    parser.add_argument("--resume", action="store_true", help="go on with what was interrupted")
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask scheduler, whose workers share the work"
    )


class Savable(Protocol):
    """A result that writes itself to a folder."""

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path: ...


@contextmanager
def _progress(args: argparse.Namespace, stages: int):
    """A bar on a terminal, nothing when piped or quiet."""
    from tqdm import tqdm

    with tqdm(
        total=stages,
        disable=args.quiet or not sys.stderr.isatty(),
        leave=False,
        unit="stage",
        bar_format="{desc:42.42s} |{bar}| {elapsed}",
    ) as bar:

        def tell(text: str) -> None:
            bar.set_description_str(text)
            if bar.n < stages - 1:
                bar.update()

        yield tell


def _ready(args: argparse.Namespace, *files: str) -> None:
    """Refuse before the work what could not be written after it."""
    if args.o is not None:
        from jaxid.files import check_folder

        check_folder(Path(args.o), files, overwrite=args.force)


def _run_plants(args: argparse.Namespace) -> int:
    from jaxid.results.catalogue import plants_table

    print(plants_table())
    return 0


def _run_effects(args: argparse.Namespace) -> int:
    from jaxid.results.catalogue import effects_table

    print(effects_table())
    return 0


def _run_simulate(args: argparse.Namespace) -> int:
    from jaxid.files import ready_file

    if args.seed < 0:
        raise InputError(f"--seed is {args.seed}", hint="give zero or more")
    path = ready_file(Path(args.o), overwrite=args.force)
    with _progress(args, 2) as tell:
        tell("simulating")
        from jaxid.commands.simulate import simulate

        simulated_log = simulate(args.case, seed=args.seed)
    simulated_log.save(path)
    print(f"{simulated_log.log.samples} samples at {simulated_log.log.rate_hz:g} Hz in {path}")
    return 0


def _run_design(args: argparse.Namespace) -> int:
    from jaxid.files import ready_file

    path = ready_file(Path(args.o), overwrite=args.force)
    with _progress(args, 4) as tell:
        from jaxid.commands.design import design

        found = design(args.case, progress=tell)
    found.save(path)
    print(f"{found}\n{len(found.time)} ticks of the {found.signal} in {path}")
    return 0


def _run_check(args: argparse.Namespace) -> int:
    _ready(args, "check.json")
    with _progress(args, 2) as tell:
        tell("checking")
        from jaxid.commands.check import check

        result = check(args.case, args.log)
    print(result)
    return _finish(args, result, "check.json")


def _run_identify(args: argparse.Namespace) -> int:
    if args.method not in METHODS:
        raise InputError(f"method {args.method!r} is not known", hint=f"choose one of {', '.join(METHODS)}")
    if args.solver is not None and args.solver not in SOLVERS:
        raise InputError(f"solver {args.solver!r} is not known", hint=suggest(args.solver, SOLVERS))
    if args.on is not None and args.on not in OUTPUTS:
        raise InputError(f"on {args.on!r} is not known", hint=suggest(args.on, OUTPUTS))
    _ready(args, "result.json", "report.html")
    with _progress(args, 4) as tell:
        tell("starting")
        from jaxid.commands.identify import identify

        result = identify(
            args.case,
            args.log,
            method=args.method,
            solver=args.solver,
            on=args.on,
            validate=args.validate,
            progress=tell,
        )
    print(result)
    return _finish(args, result, "result.json", "report.html")


def _run_discover(args: argparse.Namespace) -> int:
    if args.max_effects < 0:
        raise InputError(f"--max-effects is {args.max_effects}", hint="give zero or more")
    # An experiment's name follows from the effects found: any that exists already may be meant.
    if args.o is not None:
        from jaxid.files import found_case_file

        folder = Path(args.o)
        experiments = [p.name for p in folder.glob("separate_*.csv")]
        corrected = found_case_file(Path(args.case), folder)
        _ready(args, "discovery.json", "report.html", corrected, *experiments)
    with _progress(args, 40) as tell:
        tell("starting")
        from jaxid.commands.discover import discover

        result = discover(
            args.case,
            args.log,
            validate=args.validate,
            max_effects=args.max_effects,
            experiments=args.experiments,
            progress=tell,
        )
    print(result)
    from jaxid.results.as_json import discovery_files

    return _finish(args, result, *discovery_files(result, Path(args.o or ".")))


def _run_study(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    from jaxid.commands.study import study

    with tqdm(disable=args.quiet or not sys.stderr.isatty(), leave=False, unit="run") as bar:

        def tell(done: int, runs: int) -> None:
            if bar.total is None:
                bar.reset(total=runs)
                bar.initial = done
            bar.update(done - bar.n)

        result = study(
            args.case,
            runs=args.runs,
            seed=args.seed,
            folder=args.o,
            resume=args.resume,
            overwrite=args.force,
            scheduler=args.scheduler,
            progress=tell,
        )
    print(result)
    if args.o is not None:
        from jaxid.studies.result import FILES

        print(f"\nwrote {', '.join(str(Path(args.o) / f) for f in FILES)}")
    return 0


def _run_demo(args: argparse.Namespace) -> int:
    from jaxid.demo import run_demo

    with _progress(args, 40) as tell:
        tell("starting")
        text, converged = run_demo(Path(args.o), overwrite=args.force, progress=tell)
    print(text)
    return 0 if converged else 1


def _finish(args: argparse.Namespace, result: Savable, *files: str) -> int:
    """Save a result where the user wants it, and return the exit status."""
    if args.o is not None:
        result.save(args.o, overwrite=args.force)
        print(f"\nwrote {', '.join(str(Path(args.o) / f) for f in files)}")
    return 0 if getattr(result, "converged", True) else 1


if __name__ == "__main__":
    entry()
