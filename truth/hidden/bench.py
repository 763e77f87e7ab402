"""Hidden cases on both exact machines, the axis and the chain: their files, and their oracle."""

import re
from pathlib import Path

from truth.axis import stepper as axis_stepper
from truth.axis.cases import case_text, write_case
from truth.chain import stepper as chain_stepper
from truth.hidden import chain_oracle, chains
from truth.hidden import oracle as axis_oracle
from truth.hidden.cases import HiddenCase
from truth.hidden.chains import ChainCase

Case = HiddenCase | ChainCase


def oracle(case: Case) -> dict[str, dict]:
    """Return visibility, evidence, share and ties of each hidden effect."""
    seen = (chain_oracle if isinstance(case, ChainCase) else axis_oracle).sights(case)
    return {
        kind: {"visible": s.visible, "evidence": s.evidence, "share": s.share, "ties": s.ties}
        for kind, s in seen.items()
    }


def text_of(case: Case) -> str:
    """Return the case file that does not declare the hidden effects."""
    if isinstance(case, ChainCase):
        return chains.text_of_chain(case)
    declared = [(kind, case.values[kind]) for kind in case.declared]
    return case_text(
        case.setup(), declared, off=case.off, inertia_known=case.inertia_known,
        motion=case.size.motion, sensor=case.sensor,
    )  # fmt: skip


def known_text(case: Case) -> str:
    """Return the case file at the truth, with every effect declared and known."""
    if isinstance(case, ChainCase):
        return chains.text_of_chain(case, known=True)
    declared = [*case.values.items()]
    text = case_text(case.setup(), declared, off=1.0, motion=case.size.motion, sensor=case.sensor)
    return re.sub(r"\{ guess = ([^}]+) \}", r"\1", text)


def write_files(case: Case, folder: Path) -> list[str]:
    """Write case, log and validation to files; return the arguments of `jaxid discover`."""
    names = ["log.csv", "validation.csv"] if case.validated else ["log.csv"]
    for k, name in enumerate(names):
        write = (chain_stepper if isinstance(case, ChainCase) else axis_stepper).write_csv
        write(case.setup(validation=bool(k)).run(), Path(folder) / name)
    words = [str(write_case(folder, text_of(case))), str(Path(folder) / "log.csv")]
    return words + (["--validate", str(Path(folder) / names[1])] if case.validated else [])
