"""Chunks of a study on the workers of a Dask scheduler."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxid.case.case import load_case, read_case
from jaxid.errors import InputError
from jaxid.studies.plan import Plan, digest_of, fingerprint, named_files
from jaxid.studies.rows import Arrays
from jaxid.studies.runs import Runner

# Seconds to wait for a scheduler, and for a first worker.
_PATIENCE = 20


@dataclass(frozen=True)
class Bundle:
    """A study as it is sent to workers: a case with the files that it names, and the options of the plan.

    Args:
        case: Name of the case file; of a case that was given as a dict, its tables.
        files: Contents by path, relative to the case's folder.
        runs, chunk, seed: Numbers of the plan.
        manifest: Manifest of the plan.
    """

    case: str | Mapping[str, Any]
    files: dict[str, bytes]
    runs: int
    chunk: int
    seed: int
    manifest: dict

    @classmethod
    def of(cls, plan: Plan) -> Bundle:
        """Build the bundle of a plan.

        Raises:
            InputError: If the case differs from its file, or names a file outside its folder, which a
                worker would not find.
        """
        case, files = plan.case, {}
        given = load_case(case.path) if case.path else read_case(case.tables, None, case.folder)
        if fingerprint(given) != fingerprint(case):
            raise InputError(
                "is not the case that was given",
                where=case.where,
                hint="write the changes made in Python to the file, which workers read",
            )
        for path in (*([case.path] if case.path else []), *named_files(case)):
            try:
                relative = path.resolve().relative_to(case.folder.resolve())
            except ValueError:
                raise InputError(
                    f"names {path}, which other machines do not have",
                    where=case.where,
                    hint="put it beside the case, and name it without its folder",
                ) from None
            files[relative.as_posix()] = path.read_bytes()
        name = case.path.name if case.path else case.tables
        return cls(name, files, plan.runs, plan.chunk, plan.seed, plan.manifest)

    def plan(self) -> Plan:
        """Rebuild the plan on a worker.

        Raises:
            InputError: If this machine has other versions of the libraries that the numbers depend on.
        """
        with tempfile.TemporaryDirectory(prefix="jaxid-study-") as name:
            folder = Path(name)
            for file, content in self.files.items():
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / file).write_bytes(content)
            case = self.case
            case = load_case(folder / case) if isinstance(case, str) else read_case(case, None, folder)
            plan = Plan.of(case, runs=self.runs, seed=self.seed)
            plan = replace(plan, chunk=self.chunk)
            present, wanted = plan.manifest["versions"], self.manifest["versions"]
        if present != wanted:
            raise InputError(
                f"a worker has {present} in place of {wanted}", hint="install the same on every machine"
            )
        return plan


# The runners of this process by manifest, so that a worker loads a case and compiles it once.
_RUNNERS: dict[str, Runner] = {}
_LOCK = threading.Lock()


def run_chunk(bundle: Bundle, number: int) -> Arrays:
    """Run one chunk of a bundle on this worker."""
    key = digest_of(bundle.manifest)
    with _LOCK:
        if key not in _RUNNERS:
            _RUNNERS[key] = Runner(bundle.plan())
    return _RUNNERS[key].chunk(number)


class Remote:
    """The workers of a Dask scheduler, while a study lasts.

    Args:
        address: Address of the scheduler, such as `tcp://host:8786`.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        # A client of Dask, whose methods answer at once or later by its mode: no type says which.
        self.client: Any = None

    def __enter__(self) -> Remote:
        try:
            from distributed import Client
        except ImportError:
            raise InputError(
                "--scheduler needs Dask's distributed", hint="install jaxid with its extra: jaxid[scheduler]"
            ) from None
        client: Any = None
        try:
            client = self.client = Client(self.address, timeout=_PATIENCE, set_as_default=False)
            client.wait_for_workers(1, timeout=_PATIENCE)
        except (OSError, ValueError, TimeoutError) as error:
            what = "no scheduler answers" if client is None else "there is no worker"
            self.__exit__()
            raise InputError(
                f"{what} at {self.address}: {error}", hint="give its address, as it prints it"
            ) from error
        return self

    def __exit__(self, *_: object) -> None:
        if self.client is not None:
            self.client.close()

    @property
    def threads(self) -> int:
        """Number of chunks that run at once."""
        return max(1, sum(self.client.nthreads().values()))

    def run(self, bundle: Bundle, numbers: list[int]) -> Iterator[tuple[int, Arrays]]:
        """Yield chunks as they come back; Dask gives those of a lost worker to another.

        Raises:
            InputError: If a chunk ended several workers, or the scheduler is lost.
        """
        from distributed import CancelledError, KilledWorker, as_completed
        from distributed.comm.core import CommClosedError

        pending = {self.client.submit(run_chunk, bundle, k, pure=False): k for k in numbers}
        try:
            for future in as_completed(list(pending), loop=self.client.loop):
                yield pending[future], future.result()
                future.release()
        except (KilledWorker, CancelledError, CommClosedError) as error:
            raise InputError(
                f"the workers at {self.address} are lost: {error}",
                hint="finished chunks are kept: see the workers' logs, then --resume",
            ) from error
