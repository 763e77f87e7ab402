"""`jaxid effects`."""

from __future__ import annotations

import argparse

from jaxid.command_line.outputs import picture_file
from jaxid.command_line.parser import Commands, add_command
from jaxid.errors import InputError

_EXAMPLES = """\
jaxid effects
jaxid effects cogging
jaxid effects stribeck_friction -o stribeck.png"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "list the effects, or show one: formula, curve, and a snippet for a case"
    parser = add_command(commands, "effects", purpose, run, examples=_EXAMPLES)
    parser.add_argument("kind", metavar="KIND", nargs="?", help="the effect to show; absent: all are listed")
    parser.add_argument("-o", metavar="FILE", help="picture of its curve: .png, .svg or .pdf")
    parser.add_argument("--force", action="store_true", help="overwrite a file that is there")


def run(args: argparse.Namespace) -> int:
    """Print all effects or one, and return the exit status."""
    if args.kind is not None:
        return _show(args)
    if args.o is not None:
        raise InputError(
            "-o draws the curve of one effect", hint="name it: jaxid effects cogging -o cogging.png"
        )
    from jaxid.results.catalogue import effects_table

    print(effects_table())
    return 0


def _show(args: argparse.Namespace) -> int:
    """Print the page of one effect, and draw its curve to a file that is asked for."""
    from jaxid.results.effect_page import curve_of, effect_page, plot_curve

    path = None if args.o is None else picture_file(args.o, overwrite=args.force)
    print(effect_page(args.kind))
    if path is not None:
        curve = curve_of(args.kind)
        if curve is None:
            raise InputError(f"{args.kind} has no curve of its own", hint="leave out -o")
        plot_curve(args.kind, curve).savefig(path, dpi=160)
        print(f"\nwrote {path}")
    return 0
