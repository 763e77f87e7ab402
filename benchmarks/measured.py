"""Folder of the measured logs that some benchmarks need."""

import argparse
import os
from pathlib import Path


def measured_folder(parser: argparse.ArgumentParser, name: str = "") -> Path:
    """Return a folder of the measured logs; end the command in one line if JAXID_DATA does not say where.

    Args:
        parser: Parser of the command.
        name: Name of the folder within them; empty for all.
    """
    if "JAXID_DATA" not in os.environ:
        parser.error("set JAXID_DATA to the folder of the measured data")
    return Path(os.environ["JAXID_DATA"]) / name
