"""Chunks of a study on the workers of a Dask scheduler."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from jaxid.errors import InputError
from jaxid.io.case import load_case
from jaxid.studies.plan import Plan, named_files
from jaxid.studies.runs import Arrays, Runner

# A chunk is tried so often: a worker may die under it.
_TRIES = 5
# Seconds to wait for a scheduler.
_PATIENCE = 20


@dataclass(frozen=True)
class Bundle:
    """A study as it travels: a case with the files that it names, and what was asked of it.

    Args:
        case: Name of the case file.
        files: Contents by path, relative to the case's folder.
        runs, chunk, seed: Of the plan.
        fingerprint: Of the files.
    """

    case: str
    files: dict[str, bytes]
    runs: int
    chunk: int
    seed: int
    fingerprint: str

    @classmethod
    def of(cls, plan: Plan) -> Bundle:
        """Of a plan.

        Raises:
            InputError: If the case names a file outside its folder, which a worker would not find.
        """
        case, files = plan.case, {}
        for path in (case.path, *named_files(case)):
            try:
                name = path.resolve().relative_to(case.folder.resolve())
            except ValueError:
                raise InputError(
                    f"names {path}, which other machines do not have", where=str(case.path),
                    mend="put it beside the case, and name it without its folder",
                ) from None
            files[name.as_posix()] = path.read_bytes()
        own = plan.manifest
        return cls(case.path.name, files, plan.runs, plan.chunk, plan.seed, own["fingerprint"])

    def plan(self) -> Plan:
        """The plan again, where it has arrived."""
        folder = Path(tempfile.mkdtemp(prefix="jaxid-study-"))
        for name, content in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        plan = Plan.of(load_case(folder / self.case), runs=self.runs, seed=self.seed)
        return replace(plan, chunk=self.chunk)


# Of this process, by what was asked: a worker loads a case and compiles once.
_RUNNERS: dict[tuple, Runner] = {}


def run_chunk(bundle: Bundle, number: int) -> Arrays:
    """One chunk of a bundle, on the worker that this runs on."""
    key = (bundle.fingerprint, bundle.runs, bundle.chunk, bundle.seed)
    if key not in _RUNNERS:
        _RUNNERS[key] = Runner(bundle.plan())
    return _RUNNERS[key].chunk(number)


def solved_by(plan: Plan, numbers: list[int], address: str) -> Iterator[tuple[int, Arrays]]:
    """Chunks as they come back from a scheduler's workers.

    Args:
        plan: The study.
        numbers: Chunks that are still to be run.
        address: Of the scheduler, such as `tcp://host:8786`.

    Raises:
        InputError: If Dask is not installed, or no scheduler answers there.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise InputError(
            "--scheduler needs Dask's distributed", mend="install jaxid with its extra: jaxid[scheduler]"
        ) from None
    bundle = Bundle.of(plan)
    try:
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"no scheduler answers at {address}: {error}", mend="give its address, as it prints it"
        ) from error
    with client:
        left = {
            client.submit(run_chunk, bundle, number, pure=False, retries=_TRIES): number
            for number in numbers
        }
        for future in as_completed(list(left), loop=client.loop):
            yield left[future], future.result()
            future.release()
