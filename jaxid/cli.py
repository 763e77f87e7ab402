"""The command line: a thin layer over the Python interface, which is loaded when a command needs it."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn, Protocol

from jaxid import _cache
from jaxid.errors import InputError, suggest
from jaxid.names import (
    LIKELIHOOD_METHODS,
    METHODS,
    MINIMISERS,
    OUTPUTS,
    SEVERAL_LOGS,
    SOLVERS,
    TARGETS,
    WHEN,
)


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
        # The reader of the output has ended; Python would report that once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"jaxid: {error}", file=sys.stderr)
        return 1


def entry() -> None:
    """Entry point of the installed command."""
    # Imports make many objects that stay: looking for garbage after every 700 takes a tenth of their time.
    gc.set_threshold(100_000, 50, 50)
    _cache.configure()
    sys.exit(main())


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, with exit status 2."""

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
    for name, purpose, run in (
        ("methods", "list the methods of identify, and when to take which", _run_methods),
        ("plants", "list the plants with their parameters and units", _run_plants),
        ("effects", "list the effects with their parameters and units", _run_effects),
    ):
        commands.add_parser(name, help=purpose, description=purpose).set_defaults(run=run)
    _schema(commands)
    _init(commands)
    _simulate(commands)
    _design(commands)
    _check(commands)
    _identify(commands)
    _discover(commands)
    _study(commands)
    _export(commands)
    return parser


def _schema(commands: argparse._SubParsersAction) -> None:
    what = "the JSON Schema of a file, for editors that complete and check by it"
    parser = commands.add_parser("schema", help=what, description=what)
    parser.set_defaults(run=_run_schema)
    parser.add_argument("file", metavar="FILE", choices=("case",), help="case: the case file")


def _add(
    commands: argparse._SubParsersAction, name: str, purpose: str, run: Callable
) -> argparse.ArgumentParser:
    parser = commands.add_parser(name, help=purpose, description=purpose)
    parser.set_defaults(run=run)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--force", action="store_true", help="overwrite files that jaxid did not make")
    return parser


def _demo(commands: argparse._SubParsersAction) -> None:
    purpose = "run check, identify and discover on a log that ships with jaxid"
    parser = _add(commands, "demo", purpose, _run_demo)
    parser.add_argument(
        "-o", metavar="DIR", default="jaxid-demo", help="folder for the results; default: jaxid-demo"
    )


def _init(commands: argparse._SubParsersAction) -> None:
    parser = _add(commands, "init", "write a first case from a raw log", _run_init)
    parser.add_argument("log", metavar="LOG")
    parser.add_argument("--urdf", metavar="FILE", help="file that describes the arm of the log")
    parser.add_argument("--tip", metavar="LINK", help="its last link; needed only where the chain branches")
    parser.add_argument("--mjcf", metavar="FILE", help="MuJoCo model of the machine; not built yet")
    parser.add_argument(
        "-o", metavar="CASE.toml", default="case.toml", help="file to write the case to; default: case.toml"
    )


def _simulate(commands: argparse._SubParsersAction) -> None:
    parser = _add(commands, "simulate", "simulate the log that a case describes", _run_simulate)
    parser.add_argument("case", metavar="CASE.toml")
    parser.add_argument("-o", metavar="LOG.csv", required=True, help="file to write the log to")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="seed of the noise; default: 0")


def _design(commands: argparse._SubParsersAction) -> None:
    purpose = "find the reference or input within [limits] whose log identifies the unknowns best"
    parser = _add(commands, "design", purpose, _run_design)
    parser.add_argument("case", metavar="CASE.toml")
    parser.add_argument("-o", metavar="SIGNAL.csv", required=True, help="file to write the signal to")


def _logs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("case", metavar="CASE.toml")
    parser.add_argument(
        "log",
        metavar="LOG",
        nargs="*",
        help="the log, or several that are fitted together; absent: those of [[fit]]",
    )
    parser.add_argument("-o", metavar="DIR", help="folder for the results; default: only print them")


def _given(args: argparse.Namespace) -> str | list[str] | None:
    """Return the logs of a command: one, several, or none."""
    return args.log[0] if len(args.log) == 1 else args.log or None


def _validate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--validate",
        metavar="LOG2",
        action="append",
        default=[],
        help="a log to validate on, beside those of the case; may be repeated",
    )


def _numerics(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--solver",
        metavar="NAME",
        help="let diffrax integrate in output_error, dry friction smoothed: "
        f"{', '.join(SOLVERS)}; absent: as the case says, or fixed steps, dry friction exact",
    )
    parser.add_argument(
        "--minimiser",
        metavar="NAME",
        help=f"minimiser of output_error: {', '.join(MINIMISERS)}; absent: as the case says, or the first",
    )


def _need_numerics(args: argparse.Namespace) -> None:
    """Refuse a solver or a minimiser of another name before JAX is loaded."""
    if args.solver is not None and args.solver not in SOLVERS:
        raise InputError(f"solver {args.solver!r} is not known", hint=suggest(args.solver, SOLVERS))
    if args.minimiser is not None and args.minimiser not in MINIMISERS:
        raise InputError(
            f"minimiser {args.minimiser!r} is not known", hint=suggest(args.minimiser, MINIMISERS)
        )


def _check(commands: argparse._SubParsersAction) -> None:
    purpose = "check before any fit whether a log is sound and excites the unknowns of a case"
    _logs(_add(commands, "check", purpose, _run_check))


def _identify(commands: argparse._SubParsersAction) -> None:
    parser = _add(commands, "identify", "identify the unknowns of a case from a log", _run_identify)
    _logs(parser)
    parser.add_argument(
        "--method",
        metavar="M",
        help=f"{', '.join(METHODS)}; absent: chosen from case and log, and the "
        "reason is printed; `jaxid methods` says when to take which",
    )
    parser.add_argument(
        "--on",
        metavar="OUTPUT",
        help=f"output of the loop that output_error fits: {', '.join(OUTPUTS)}; default: that of the case, "
        "or position",
    )
    _numerics(parser)
    parser.add_argument(
        "--hessian",
        action="store_true",
        default=None,
        help="covariance by the full Hessian in place of Gauss-Newton's, for a method that maximises a "
        f"likelihood: {', '.join(LIKELIHOOD_METHODS)}",
    )
    parser.add_argument(
        "--profile",
        metavar="NAME",
        action="append",
        default=[],
        help="compute the profile likelihood of an unknown, for such a method; may be repeated",
    )
    _validate(parser)


def _discover(commands: argparse._SubParsersAction) -> None:
    purpose = "find the effects that a case's model lacks, and write the case with them"
    parser = _add(commands, "discover", purpose, _run_discover)
    _logs(parser)
    _validate(parser)
    parser.add_argument(
        "--max-effects", metavar="N", type=int, default=5, help="most effects to add; default: 5"
    )
    _numerics(parser)
    parser.add_argument(
        "--experiments",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="design experiments that separate rival effects; default: except for arms (minutes)",
    )


def _study(commands: argparse._SubParsersAction) -> None:
    purpose = "simulate and identify a case many times: bias, spread and coverage of the intervals"
    parser = _add(commands, "study", purpose, _run_study)
    parser.add_argument("case", metavar="CASE.toml")
    parser.add_argument("-o", metavar="DIR", help="folder for chunks and results; default: only print them")
    parser.add_argument(
        "--runs", metavar="N", type=int, help="runs under each setting; default: those of the case, or 100"
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="seed of all draws; default: 0")
    parser.add_argument("--resume", action="store_true", help="continue an interrupted study")
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of a Dask scheduler, whose workers run the chunks"
    )


def _export(commands: argparse._SubParsersAction) -> None:
    purpose = "put the values of a result into the robot's own file"
    parser = commands.add_parser("export", help=purpose, description=purpose)
    parser.set_defaults(run=_run_export)
    parser.add_argument("result", metavar="RESULT.json", help="result.json or discovery.json of a tree")
    parser.add_argument("--to", metavar="TARGET", required=True, help=f"one of {', '.join(TARGETS)}")
    parser.add_argument("--model", metavar="ROBOT.xml", required=True, help="the file that the case names")
    parser.add_argument("-o", metavar="FILE", required=True, help="file to write")
    parser.add_argument("--force", action="store_true", help="overwrite a file that jaxid did not make")


class Savable(Protocol):
    """A result that writes itself to a folder."""

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path: ...


@contextmanager
def _progress(args: argparse.Namespace, stages: int):
    """Show a progress bar on a terminal, and nothing when piped or quiet."""
    from tqdm import tqdm

    with tqdm(
        total=stages,
        disable=args.quiet or not sys.stderr.isatty(),
        leave=False,
        unit="stage",
        bar_format="{desc:42.42s} |{bar}| {elapsed}",
    ) as bar:

        def show(text: str) -> None:
            bar.set_description_str(text)
            if bar.n < stages - 1:
                bar.update()

        yield show


def _ready(args: argparse.Namespace, *files: str) -> None:
    """Refuse a folder before the work if the results could not be written to it."""
    if args.o is not None:
        from jaxid.files import check_folder

        check_folder(Path(args.o), files, overwrite=args.force)


def _sound(args: argparse.Namespace) -> None:
    """Refuse an unsound case before JAX is loaded, which takes longer than all that is checked here."""
    from jaxid.case.case import refuse_unsound

    refuse_unsound(Path(args.case))


def _run_methods(args: argparse.Namespace) -> int:
    width = max(len(name) for name in METHODS)
    print("\n".join(f"{name.ljust(width)}  {WHEN[name]}" for name in METHODS))
    print(f"\nSeveral logs in one fit: {', '.join(SEVERAL_LOGS)}. The other methods fit one log.")
    return 0


def _run_plants(args: argparse.Namespace) -> int:
    from jaxid.results.catalogue import plants_table

    print(plants_table())
    return 0


def _run_effects(args: argparse.Namespace) -> int:
    from jaxid.results.catalogue import effects_table

    print(effects_table())
    return 0


def _run_schema(args: argparse.Namespace) -> int:
    import json

    from jaxid.case.json_schema import case_schema

    print(json.dumps(case_schema(), indent=2, ensure_ascii=False))
    return 0


def _run_init(args: argparse.Namespace) -> int:
    from jaxid.commands.init import check_target, init

    path = check_target(Path(args.o), overwrite=args.force)
    first = init(args.log, urdf=args.urdf, tip=args.tip, mjcf=args.mjcf, folder=path.parent)
    first.save(path, overwrite=args.force)
    print(f"{first}\n\nwrote {path}; next: jaxid check {path} {args.log}")
    return 0


def _run_simulate(args: argparse.Namespace) -> int:
    from jaxid.files import ready_file

    if args.seed < 0:
        raise InputError(f"--seed is {args.seed}", hint="give zero or more")
    path = ready_file(Path(args.o), overwrite=args.force)
    _sound(args)
    with _progress(args, 2) as show:
        show("simulating")
        from jaxid.commands.simulate import simulate

        simulated_log = simulate(args.case, seed=args.seed)
    simulated_log.save(path)
    print(f"{simulated_log.log.samples} samples at {simulated_log.log.rate_hz:g} Hz in {path}")
    return 0


def _run_design(args: argparse.Namespace) -> int:
    from jaxid.files import ready_file

    path = ready_file(Path(args.o), overwrite=args.force)
    _sound(args)
    with _progress(args, 4) as show:
        from jaxid.commands.design import design

        found = design(args.case, progress=show)
    found.save(path)
    print(f"{found}\n{len(found.time)} ticks of the {found.signal} in {path}")
    return 0


def _run_check(args: argparse.Namespace) -> int:
    _ready(args, "check.json")
    _sound(args)
    with _progress(args, 2) as show:
        show("checking")
        from jaxid.commands.check import check

        result = check(args.case, _given(args))
    print(result)
    return _finish(args, result, "check.json")


def _run_identify(args: argparse.Namespace) -> int:
    if args.method is not None and args.method not in METHODS:
        raise InputError(f"method {args.method!r} is not known", hint=f"choose one of {', '.join(METHODS)}")
    _need_numerics(args)
    if args.on is not None and args.on not in OUTPUTS:
        raise InputError(f"on {args.on!r} is not known", hint=suggest(args.on, OUTPUTS))
    _ready(args, "result.json", "report.html")
    _sound(args)
    with _progress(args, 4) as show:
        show("starting")
        from jaxid.commands.identify import identify

        result = identify(
            args.case,
            _given(args),
            method=args.method,
            solver=args.solver,
            minimiser=args.minimiser,
            on=args.on,
            hessian=args.hessian,
            profile=args.profile,
            validate=args.validate,
            progress=show,
        )
    print(result)
    return _finish(args, result, "result.json", "report.html")


def _run_discover(args: argparse.Namespace) -> int:
    if args.max_effects < 0:
        raise InputError(f"--max-effects is {args.max_effects}", hint="give zero or more")
    _need_numerics(args)
    # An experiment's name follows from the effects found: any that exists already may be meant.
    if args.o is not None:
        from jaxid.files import found_case_file

        folder = Path(args.o)
        experiments = [p.name for p in folder.glob("separate_*.csv")]
        corrected = found_case_file(Path(args.case), folder)
        _ready(args, "discovery.json", "report.html", corrected, *experiments)
    _sound(args)
    with _progress(args, 40) as show:
        show("starting")
        from jaxid.commands.discover import discover

        result = discover(
            args.case,
            _given(args),
            validate=args.validate,
            max_effects=args.max_effects,
            solver=args.solver,
            minimiser=args.minimiser,
            experiments=args.experiments,
            progress=show,
        )
    print(result)
    from jaxid.results.as_json import discovery_files

    return _finish(args, result, *discovery_files(result, Path(args.o or ".")))


def _run_study(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    _sound(args)
    from jaxid.commands.study import study

    with tqdm(disable=args.quiet or not sys.stderr.isatty(), leave=False, unit="run") as bar:

        def show(done: int, runs: int) -> None:
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
            progress=show,
        )
    print(result)
    if args.o is not None:
        from jaxid.studies.result import FILES

        print(f"\nwrote {', '.join(str(Path(args.o) / f) for f in FILES)}")
    return 0


def _run_export(args: argparse.Namespace) -> int:
    from jaxid.commands.export import export
    from jaxid.files import ready_file, write_whole

    path = ready_file(Path(args.o), overwrite=args.force, suffix=".xml")
    exported = export(args.result, args.to, args.model)
    write_whole(path, exported.content)
    lines = [f"not exported: {note}" for note in exported.notes]
    changed = ", ".join(exported.changed) or "nothing"
    print("\n".join([*lines, f"changed {changed} in {path}"]))
    return 0


def _run_demo(args: argparse.Namespace) -> int:
    from jaxid.demo import run_demo

    with _progress(args, 40) as show:
        show("starting")
        text, converged = run_demo(Path(args.o), overwrite=args.force, progress=show)
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
