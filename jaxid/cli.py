"""The command line: a thin layer over the Python interface, which is loaded when a command needs it."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from jaxid import _cache
from jaxid.errors import InputError, suggest
from jaxid.names import (
    FIRST_CASE,
    LIKELIHOOD_METHODS,
    METHODS,
    MINIMISERS,
    OUTPUTS,
    PICTURES,
    ROBOT_FILES,
    SEVERAL_LOGS,
    SIGNALS,
    SOLVERS,
    TARGETS,
    WHEN,
)

if TYPE_CHECKING:
    from jaxid.commands.robot_case import RobotCase

_GREETING = """\
jaxid identifies machines with friction from their logs, and finds the physics that a simulation is missing.

  jaxid demo                                  the whole way, on a log that ships with jaxid
  jaxid init log.csv                          a first case, case.toml, from a log of your own
  jaxid identify case.toml log.csv -o out     its unknowns, and a report: out/report.html

jaxid --help lists all commands, and jaxid COMMAND --help the options of one, with examples."""
# Examples below the help text of each command.
_EXAMPLES = {
    "demo": "jaxid demo\njaxid demo -o my-demo",
    "methods": "jaxid methods",
    "plants": "jaxid plants",
    "effects": "jaxid effects\njaxid effects cogging\njaxid effects stribeck_friction -o stribeck.png",
    "schema": "jaxid schema case > case.schema.json\njaxid schema comparison",
    "init": "jaxid init log.csv\njaxid init joint_states.csv --urdf arm.urdf -o arm.toml\n"
    "jaxid init log.csv --mjcf robot.xml -o arm.toml",
    "simulate": "jaxid simulate case.toml -o log.csv\njaxid simulate case.toml -o log.csv --seed 3",
    "design": "jaxid design case.toml -o reference.csv",
    "check": "jaxid check case.toml log.csv\njaxid check case.toml log.csv -o out",
    "identify": "jaxid identify case.toml log.csv -o out\n"
    "jaxid identify robot.xml log.csv -o out\n"
    "jaxid identify case.toml a.csv b.csv --validate c.csv\n"
    "jaxid identify case.toml log.csv --method inverse_dynamics",
    "discover": "jaxid discover case.toml log.csv -o out\n"
    "jaxid discover case.toml log.csv --validate other.csv --max-effects 2",
    "compare": "jaxid compare axis.toml monday.csv friday.csv -o friday\n"
    "jaxid compare axis.toml machine_1.csv machine_2.csv machine_3.csv\n"
    "jaxid compare axis.toml",
    "study": "jaxid study case.toml -o study --runs 50\njaxid study case.toml -o study --resume",
    "export": "jaxid export out/result.json --to mjcf -o found.xml --check log.csv\n"
    "jaxid export out/result.json --to urdf --model robot.urdf -o found.urdf\n"
    "jaxid export out/discovery.json --to c -o feed_forward.h",
    "report": "jaxid report out\njaxid report out/result.json -o fit.html",
    "plot": "jaxid plot out friction -o friction.png\n"
    "jaxid plot out/result.json scatter --against position -o ripple.svg\n"
    "jaxid plot out signals -o signals.csv",
}
# Suffixes of logs, by which arguments in the wrong order are noticed.
_LOGS = (
    ".csv",
    ".txt",
    ".tsv",
    ".mat",
    ".npz",
    ".h5",
    ".hdf5",
    ".parquet",
    ".xlsx",
    ".tdms",
    ".mcap",
    ".bag",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 done, whatever the verdict; 2 bad input; 1 anything else, no convergence included.
    """
    try:
        given = sys.argv[1:] if argv is None else argv
        if not given:
            print(_GREETING)
            return 0
        args = _parser().parse_args(given)
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

    def __init__(self, *args: Any, **options: Any):
        """Keep the lines of the examples below a help text as they are."""
        super().__init__(*args, formatter_class=argparse.RawDescriptionHelpFormatter, **options)

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
    ):
        _plain(commands, name, purpose, run)
    _effects(commands)
    _schema(commands)
    _init(commands)
    _simulate(commands)
    _design(commands)
    _check(commands)
    _identify(commands)
    _discover(commands)
    _compare(commands)
    _study(commands)
    _export(commands)
    _report(commands)
    _plot(commands)
    return parser


def _plain(
    commands: argparse._SubParsersAction, name: str, purpose: str, run: Callable, more: str = ""
) -> argparse.ArgumentParser:
    """Add a command, with its examples below its help text."""
    examples = "\n".join(f"  {line}" for line in _EXAMPLES[name].splitlines())
    end = f"{more}\n\nexamples:\n{examples}".strip()
    parser = commands.add_parser(name, help=purpose, description=purpose, epilog=end)
    parser.set_defaults(run=run, command=name)
    return parser


def _effects(commands: argparse._SubParsersAction) -> None:
    purpose = "list the effects, or show one: formula, curve, and a snippet for a case"
    parser = _plain(commands, "effects", purpose, _run_effects)
    parser.add_argument("kind", metavar="KIND", nargs="?", help="the effect to show; absent: all are listed")
    parser.add_argument("-o", metavar="FILE", help="picture of its curve: .png, .svg or .pdf")
    parser.add_argument("--force", action="store_true", help="overwrite a file that is there")


def _report(commands: argparse._SubParsersAction) -> None:
    purpose = "write the report of a result again, such as after an update of jaxid"
    parser = _plain(commands, "report", purpose, _run_report)
    _result(parser)
    parser.add_argument(
        "-o", metavar="FILE.html", help="file to write; default: report.html beside the result"
    )
    parser.add_argument("--force", action="store_true", help="overwrite a file that jaxid did not make")


def _plot(commands: argparse._SubParsersAction) -> None:
    purpose = "draw one picture of a result"
    parser = _plain(commands, "plot", purpose, _run_plot)
    _result(parser)
    parser.add_argument(
        "kind",
        metavar="KIND",
        help=f"{', '.join(PICTURES)}; forces: measured and model over each other; or {SIGNALS}: measured and "
        "simulated signals as a table for PlotJuggler (.csv)",
    )
    parser.add_argument("-o", metavar="FILE", help="file to write: .png, .svg, .pdf; default: KIND.png")
    parser.add_argument(
        "--log", metavar="NAME", default="0", help="name or number of the log; default: 0, the first"
    )
    parser.add_argument("--joint", metavar="N", type=int, default=1, help="joint of several; default: 1")
    parser.add_argument(
        "--against",
        metavar="QUANTITY",
        help="abscissa of scatter: velocity, position or time; default: that which the residual follows",
    )
    parser.add_argument("--force", action="store_true", help="overwrite a file that is there")


def _result(parser: argparse.ArgumentParser) -> None:
    what = "result.json, discovery.json, or the folder that holds one"
    parser.add_argument("result", metavar="RESULT", help=what)


def _schema(commands: argparse._SubParsersAction) -> None:
    what = "the JSON Schema of a file, for editors that complete and check by it"
    parser = _plain(commands, "schema", what, _run_schema)
    choices = ("case", "comparison")
    help_text = "case: the case file; comparison: what compare writes"
    parser.add_argument("file", metavar="FILE", choices=choices, help=help_text)


def _add(
    commands: argparse._SubParsersAction, name: str, purpose: str, run: Callable, more: str = ""
) -> argparse.ArgumentParser:
    parser = _plain(commands, name, purpose, run, more)
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
    parser.add_argument("log", metavar="LOG", help="the log, as the drive or the robot wrote it")
    parser.add_argument("--urdf", metavar="FILE", help="file that describes the arm of the log")
    parser.add_argument("--tip", metavar="LINK", help="its last link; needed only where the chain branches")
    parser.add_argument("--mjcf", metavar="FILE", help="MuJoCo model of the robot of the log")
    parser.add_argument(
        "-o", metavar="CASE.toml", default="case.toml", help="file to write the case to; default: case.toml"
    )


def _simulate(commands: argparse._SubParsersAction) -> None:
    parser = _add(commands, "simulate", "simulate the log that a case describes", _run_simulate)
    parser.add_argument(
        "case", metavar="CASE.toml", help="the case; or a robot's MJCF or URDF, which is let go at zero"
    )
    parser.add_argument("-o", metavar="LOG.csv", required=True, help="file to write the log to")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="seed of the noise; default: 0")


def _design(commands: argparse._SubParsersAction) -> None:
    purpose = "find the reference or input within [limits] whose log identifies the unknowns best"
    parser = _add(commands, "design", purpose, _run_design)
    parser.add_argument("case", metavar="CASE.toml", help="the case, with [simulation]")
    parser.add_argument("-o", metavar="SIGNAL.csv", required=True, help="file to write the signal to")


def _logs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "case",
        metavar="CASE.toml",
        help="the case; or a robot's MJCF or URDF, with the columns of the log named after its joints",
    )
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


def _case(args: argparse.Namespace, *, search: bool = False) -> tuple[Any, RobotCase | None]:
    """Return the case of a command; if it is given a robot's file, the one that this and the log imply."""
    if Path(args.case).suffix.lower() not in ROBOT_FILES:
        _sound(args)
        return args.case, None
    from jaxid.commands.robot_case import RobotCase

    made = RobotCase.of(args.case, args.log, search=search)
    return made.tables, made


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
    width = max(map(len, METHODS))
    when = "\n".join(f"  {name.ljust(width)}  {WHEN[name]}" for name in METHODS)
    purpose = "identify the unknowns of a case from a log"
    parser = _add(commands, "identify", purpose, _run_identify, f"which method when:\n{when}")
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


def _compare(commands: argparse._SubParsersAction) -> None:
    purpose = "find what differs between logs: a parameter, or an effect in one of them only"
    parser = _add(commands, "compare", purpose, _run_compare)
    parser.add_argument("case", metavar="CASE.toml", help="the case of the machine")
    parser.add_argument(
        "log", metavar="LOG", nargs="*", help="the logs, the base first; absent: those of [[fit]]"
    )
    parser.add_argument("-o", metavar="DIR", help="folder for the results; default: only print them")
    parser.add_argument(
        "--max-changes", metavar="N", type=int, default=5, help="most changes of the model; default: 5"
    )


def _study(commands: argparse._SubParsersAction) -> None:
    purpose = "simulate and identify a case many times: bias, spread and coverage of the intervals"
    parser = _add(commands, "study", purpose, _run_study)
    parser.add_argument("case", metavar="CASE.toml", help="the case, with [simulation]")
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
    purpose = "put the values of a result into the robot's file, or into one of another program"
    parser = _plain(commands, "export", purpose, _run_export)
    parser.add_argument("result", metavar="RESULT.json", help="result.json or discovery.json of a tree")
    parser.add_argument("--to", metavar="TARGET", required=True, help=f"one of {', '.join(TARGETS)}")
    parser.add_argument(
        "--model",
        metavar="ROBOT.xml",
        help="for mjcf and urdf, the file that the case names; default: the path in the case",
    )
    parser.add_argument("-o", metavar="FILE", required=True, help="file to write")
    parser.add_argument(
        "--check",
        metavar="LOG",
        help="replay a log by the file in MuJoCo: how far it is from jaxid's simulation, by joint, and "
        "what each thing that the file lacks is worth",
    )
    parser.add_argument(
        "--samples",
        metavar="N",
        type=int,
        help="also write N models drawn from the posterior, FILE_1 to FILE_N",
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="seed of these draws; default: 0")
    parser.add_argument("--force", action="store_true", help="overwrite a file that jaxid did not make")


class Savable(Protocol):
    """A result that writes itself to a folder."""

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path: ...


def _progress(args: argparse.Namespace) -> AbstractContextManager[Callable[[str], None]]:
    """Show progress on a terminal, and nothing when piped or quiet."""
    from jaxid._progress import progress

    # Results elsewhere, and what may be overwritten, take no time.
    told = {k: v for k, v in vars(args).items() if k not in ("run", "o", "quiet", "force")}
    files = [str(Path(name).resolve()) for name in (told.get("case"), *(told.get("log") or ())) if name]
    words = [f"{k}={v}" for k, v in sorted(told.items()) if k not in ("case", "log")]
    quiet = getattr(args, "quiet", False)
    return progress([*words, *files], shown=not quiet and sys.stderr.isatty())


def _ready(args: argparse.Namespace, *files: str) -> None:
    """Refuse a folder before the work if the results could not be written to it."""
    if args.o is not None:
        from jaxid.files import check_folder

        check_folder(Path(args.o), files, overwrite=args.force)


def _sound(args: argparse.Namespace) -> None:
    """Refuse an unsound case before JAX is loaded, which takes longer than all that is checked here."""
    _in_order(args)
    from jaxid.case.case import refuse_unsound

    refuse_unsound(Path(args.case))


def _in_order(args: argparse.Namespace) -> None:
    """Refuse a log in the place of the case."""
    if Path(args.case).suffix.lower() not in _LOGS:
        return
    logs = getattr(args, "log", [])
    case = next((name for name in logs if Path(name).suffix.lower() == ".toml"), None)
    if case is not None:
        rest = [args.case if name == case else name for name in logs]
        hint = f"the case comes first: jaxid {args.command} {' '.join([case, *rest])}"
    else:
        hint = f"the case comes first; jaxid init {args.case} writes one"
    raise InputError("is a log, in the place of the case", where=args.case, hint=hint)


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
    if args.kind is None:
        if args.o is not None:
            raise InputError(
                "-o draws the curve of one effect", hint="name it: jaxid effects cogging -o cogging.png"
            )
        from jaxid.results.catalogue import effects_table

        print(effects_table())
        return 0
    from jaxid.results.effect_page import curve_of, effect_page, plot_curve

    path = None if args.o is None else _picture_file(args.o, overwrite=args.force)
    print(effect_page(args.kind))
    if path is not None:
        curve = curve_of(args.kind)
        if curve is None:
            raise InputError(f"{args.kind} has no curve of its own", hint="leave out -o")
        plot_curve(args.kind, curve).savefig(path, dpi=160)
        print(f"\nwrote {path}")
    return 0


def _picture_file(name: str, *, overwrite: bool) -> Path:
    """Return the path of a picture after a check that it may be written."""
    path = Path(name)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".svg", ".pdf"):
        raise InputError(
            f"suffix {path.suffix!r} is no picture", where=name, hint="end it in .png, .svg or .pdf"
        )
    from jaxid.files import ready_file

    return ready_file(path, overwrite=overwrite, suffix=suffix)


def _run_report(args: argparse.Namespace) -> int:
    from jaxid.commands.report import report
    from jaxid.files import check_folder, ready_file, write_whole

    result = Path(args.result)
    if args.o is None:
        folder = result if result.is_dir() else result.parent
        check_folder(folder, ["report.html"], overwrite=args.force)
        path = folder / "report.html"
    else:
        path = ready_file(Path(args.o), overwrite=args.force, suffix=".html")
    with _progress(args) as show:
        show("drawing")
        page = report(result)
    write_whole(path, page)
    print(f"wrote {path}")
    return 0


def _run_plot(args: argparse.Namespace) -> int:
    if args.kind == SIGNALS:
        return _write_signals(args)
    if args.kind not in PICTURES:
        raise InputError(f"plot {args.kind!r} is not known", hint=suggest(args.kind, (*PICTURES, SIGNALS)))
    path = _picture_file(args.o or f"{args.kind}.png", overwrite=args.force)
    from jaxid.commands.report import read_content
    from jaxid.results.stored_plots import picture

    figure = picture(
        read_content(args.result), args.kind, log=args.log, joint=args.joint, against=args.against
    )
    figure.savefig(path, dpi=160)
    print(f"wrote {path}")
    return 0


def _run_schema(args: argparse.Namespace) -> int:
    import json

    if args.file == "comparison":
        from jaxid.results.comparison_schema import comparison_schema as schema
    else:
        from jaxid.case.json_schema import case_schema as schema

    print(json.dumps(schema(), indent=2, ensure_ascii=False))
    return 0


def _write_signals(args: argparse.Namespace) -> int:
    from jaxid.commands.report import read_content
    from jaxid.files import ready_file, write_whole
    from jaxid.results.stored_plots import signals_csv

    path = ready_file(Path(args.o or f"{SIGNALS}.csv"), overwrite=args.force)
    write_whole(path, signals_csv(read_content(args.result)))
    print(f"wrote {path}")
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
    path, case = ready_file(Path(args.o), overwrite=args.force), args.case
    if Path(case).suffix.lower() in ROBOT_FILES:
        from jaxid.commands.robot_case import let_go

        case = let_go(case)
    else:
        _sound(args)
    with _progress(args) as show:
        show("simulating")
        from jaxid.commands.simulate import simulate

        simulated_log = simulate(case, seed=args.seed)
    simulated_log.save(path)
    print(f"{simulated_log.log.samples} samples at {simulated_log.log.rate_hz:g} Hz in {path}")
    return 0


def _run_design(args: argparse.Namespace) -> int:
    from jaxid.files import ready_file

    path = ready_file(Path(args.o), overwrite=args.force)
    _sound(args)
    with _progress(args) as show:
        from jaxid.commands.design import design

        found = design(args.case, progress=show)
    found.save(path)
    print(f"{found}\n{len(found.time)} ticks of the {found.signal} in {path}")
    return 0


def _run_check(args: argparse.Namespace) -> int:
    _ready(args, "check.json", *_first_of(args))
    case, made = _case(args)
    with _progress(args) as show:
        show("checking")
        from jaxid.commands.check import check

        result = check(case, _given(args))
    print(result)
    return _finish(args, result, "check.json", made=made)


def _run_identify(args: argparse.Namespace) -> int:
    if args.method is not None and args.method not in METHODS:
        raise InputError(f"method {args.method!r} is not known", hint=f"choose one of {', '.join(METHODS)}")
    _need_numerics(args)
    if args.on is not None and args.on not in OUTPUTS:
        raise InputError(f"on {args.on!r} is not known", hint=suggest(args.on, OUTPUTS))
    _ready(args, "result.json", "report.html", *_first_of(args))
    case, made = _case(args)
    with _progress(args) as show:
        show("starting")
        from jaxid.commands.identify import identify

        result = identify(
            case,
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
    return _finish(args, result, "result.json", "report.html", made=made)


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
        _ready(args, "discovery.json", "report.html", corrected, *experiments, *_first_of(args))
    case, made = _case(args, search=True)
    with _progress(args) as show:
        show("starting")
        from jaxid.commands.discover import discover

        result = discover(
            case,
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

    return _finish(args, result, *discovery_files(result, Path(args.o or ".")), made=made)


def _run_compare(args: argparse.Namespace) -> int:
    if args.max_changes < 1:
        raise InputError(f"--max-changes is {args.max_changes}", hint="give one or more")
    _ready(args, "comparison.json", "report.html")
    _sound(args)
    with _progress(args) as show:
        show("starting")
        from jaxid.commands.compare import compare

        result = compare(args.case, args.log or None, max_changes=args.max_changes, progress=show)
    print(result)
    return _finish(args, result, "comparison.json", "report.html")


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
    if args.to not in TARGETS:
        raise InputError(f"target {args.to!r} is not known", hint=suggest(args.to, TARGETS))
    if args.samples is not None and not 1 <= args.samples <= 10_000:
        raise InputError(f"--samples is {args.samples}", hint="give 1 to 10000")
    if args.seed < 0:
        raise InputError(f"--seed is {args.seed}", hint="give zero or more")
    from jaxid.commands.export import check_export, draw_exports, export
    from jaxid.files import ready_file, write_together

    suffix, *also = TARGETS[args.to]
    path, count = Path(args.o), args.samples or 0
    drawn_paths = [path.with_stem(f"{path.stem}_{k:0{len(str(count))}}") for k in range(1, count + 1)]
    for one in (path, *drawn_paths):
        ready_file(one, overwrite=args.force, suffix=suffix, also=also)
    exported = export(args.result, args.to, args.model, name=path.stem)
    lines = [f"not exported: {note}" for note in exported.notes]
    files = {path: exported.content}
    drawn = None
    if count:
        drawn = draw_exports(args.result, args.to, count, args.model, seed=args.seed)
        files |= {one: file.content for one, file in zip(drawn_paths, drawn.files, strict=True)}
    checked = None
    if args.check is not None:
        checked = check_export(args.result, args.to, exported, args.check, args.model)
    write_together(files)
    changed = ", ".join(exported.changed) or "nothing"
    lines.append(f"{'changed' if args.to in ('mjcf', 'urdf') else 'wrote'} {changed} in {path}")
    if drawn is not None:
        lines.append(f"drew {count} models, {drawn_paths[0].name} to {drawn_paths[-1].name}; {drawn}")
    print("\n".join([*lines, *([] if checked is None else ["", str(checked)])]))
    return 0


def _run_demo(args: argparse.Namespace) -> int:
    from jaxid.demo import run_demo

    with _progress(args) as show:
        show("starting")
        text, converged = run_demo(Path(args.o), overwrite=args.force, progress=show)
    print(text)
    return 0 if converged else 1


def _first_of(args: argparse.Namespace) -> list[str]:
    """Return the name of the case that is written beside the results, if a robot's file is given for one."""
    return [FIRST_CASE] if Path(args.case).suffix.lower() in ROBOT_FILES else []


def _finish(args: argparse.Namespace, result: Savable, *files: str, made: RobotCase | None = None) -> int:
    """Save a result where the user wants it, and return the exit status."""
    if args.o is not None:
        result.save(args.o, overwrite=args.force)
        written = [str(Path(args.o) / f) for f in files]
        if made is not None:
            written.append(str(made.save(Path(args.o))))
        print(f"\nwrote {', '.join(written)}")
    return 0 if getattr(result, "converged", True) else 1


if __name__ == "__main__":
    entry()
