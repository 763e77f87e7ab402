"""The numbers of a result as Python objects: parameters, their covariance, residuals, and tables of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError, suggest
from jaxid.results.report.numbers import pretty_unit, usual_unit, with_std

if TYPE_CHECKING:
    import pandas

    from jaxid.estimators.estimate import Estimate
    from jaxid.model.unknowns import Parameters


@dataclass(frozen=True)
class Parameter:
    """One unknown of a case and its estimate.

    Args:
        name: Name in results, such as "inertia" or "coulomb_friction[2].level".
        value: Estimate in `unit`; NaN if the log does not determine it.
        std: Standard deviation in `unit`; NaN if the log does not determine the parameter.
        unit: Label of the unit.
        identifiable: Whether the log determines the parameter.
        guess: Value at which the fit started; None for an effect that a search added.
    """

    name: str
    value: float
    std: float
    unit: str
    identifiable: bool = True
    guess: float | None = None

    def __str__(self) -> str:
        if not self.identifiable:
            return f"not identifiable [{self.unit}]"
        scale, unit = usual_unit(self.unit, self.value, self.std)
        return f"{' ± '.join(with_std(self.value / scale, self.std / scale))} {unit}".rstrip()


class ParameterTable(Mapping[str, Parameter]):
    """The parameters of a result by name, in the order of the estimate.

    Args:
        parameters: The entries in their order; each has a unique name.
    """

    def __init__(self, parameters: Sequence[Parameter]):
        self._by_name = {p.name: p for p in parameters}

    @classmethod
    def of(cls, estimate: Estimate, start: Parameters) -> ParameterTable:
        """Return the table of an estimate.

        Args:
            estimate: The estimate.
            start: Unknowns of the case, with the values at which the fit started.
        """
        guesses = {f.name: f.guess for f in start.free}
        free = estimate.machine.parameters.free
        rows = zip(free, estimate.theta, estimate.std, estimate.identifiable, strict=True)
        return cls(
            [
                Parameter(
                    name=f.name,
                    value=float(value) if ok else np.nan,
                    std=float(std) if ok else np.nan,
                    unit=f.unit,
                    identifiable=bool(ok),
                    guess=guesses.get(f.name),
                )
                for f, value, std, ok in rows
            ]
        )

    def __getitem__(self, name: str) -> Parameter:
        if name not in self._by_name:
            entries = [n for n in self._by_name if n.startswith(f"{name}[")]
            hint = f"it is a list: ask for {', '.join(entries)}" if entries else suggest(name, self._by_name)
            raise KeyError(f"{name!r} is not among the parameters; {hint}")
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)

    def rows(self) -> list[list[str]]:
        """Return a header and a row of text for each parameter."""
        shown = [
            with_std(p.value, p.std) if p.identifiable else ("-", "not identifiable") for p in self.values()
        ]
        rows = [[p.name, *s, p.unit] for p, s in zip(self.values(), shown, strict=True)]
        return [["parameter", "value", "std", "unit"], *rows]

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with a row for each parameter; needs pandas."""
        columns = ("value", "std", "unit", "identifiable", "guess")
        content = {column: [getattr(p, column) for p in self.values()] for column in columns}
        content["guess"] = [np.nan if g is None else g for g in content["guess"]]
        return frame(content, index=list(self), index_name="parameter")

    def __repr__(self) -> str:
        return "\n".join(lines_of(self, most=len(self)))

    def _repr_html_(self) -> str:
        return html_table(self.rows())


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the parameters of a result.

    Args:
        names: Names of the parameters, one an entry.
        matrix: Covariance in the units of the parameters, (p, p); NaN in rows and columns of
            parameters that are not identifiable.
        kind: Kind of the covariance, one of `jaxid.numerics.precision.KINDS`; empty if the method has one of
            its own.
    """

    names: tuple[str, ...]
    matrix: Float[np.ndarray, "p p"]
    kind: str = ""

    @property
    def std(self) -> Float[np.ndarray, " p"]:
        """Standard deviations in the units of the parameters."""
        return np.sqrt(np.diag(self.matrix))

    @property
    def correlation(self) -> Float[np.ndarray, "p p"]:
        """Correlation coefficients, from -1 to 1; NaN if the covariance is NaN, or a deviation is zero."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.matrix / np.outer(self.std, self.std)

    def json(self) -> dict[str, Any]:
        """Return the object `covariance` of result.json."""
        kind = {"kind": self.kind} if self.kind else {}
        return {"names": list(self.names), "matrix": self.matrix, **kind}

    def to_pandas(self) -> pandas.DataFrame:
        """Return the matrix with names on both sides; needs pandas."""
        return frame(self.matrix, index=list(self.names), columns=list(self.names))

    def __repr__(self) -> str:
        return f"Covariance of {_some(self.names)}"

    def _repr_html_(self) -> str:
        rows = zip(self.names, self.matrix, strict=True)
        return html_table([["", *self.names], *([name, *(f"{x:.3g}" for x in row)] for name, row in rows)])


@dataclass(frozen=True, eq=False)
class Residuals:
    """Measurement minus model on one log, by joint.

    Args:
        name: Name of the log in results.
        time: Time of the log's samples [s], (N,).
        position: Measured minus simulated position, (N, n); NaN for a joint without an encoder; None if
            the simulation diverges.
        force_time: Time of the samples that the force balance uses [s], (K,); they are some of `time`.
        force: Measured force minus force by inverse dynamics behind the recipe's filter, (K, n); NaN at rest.
        units: Labels of "time", "position" and "force".
    """

    name: str
    time: Float[np.ndarray, " N"]
    position: Float[np.ndarray, "N n"] | None
    force_time: Float[np.ndarray, " K"]
    force: Float[np.ndarray, "K n"]
    units: Mapping[str, str]

    def to_pandas(self) -> pandas.DataFrame:
        """Return both residuals over time, NaN at samples that the force balance leaves out; needs pandas."""
        joints = self.force.shape[1]
        force = np.full((len(self.time), joints), np.nan)
        force[np.searchsorted(self.time, self.force_time)] = self.force
        position = np.full_like(force, np.nan) if self.position is None else self.position
        content = {}
        for what, values in (("position", position), ("force", force)):
            for k in range(joints):
                content[what if joints == 1 else f"{what}[{k + 1}]"] = values[:, k]
        return frame(content, index=self.time, index_name="time")

    def __repr__(self) -> str:
        def words(what: str, values: np.ndarray | None) -> str:
            if values is None:
                return f"{what}: the simulation diverges"
            rms = np.sqrt(np.nanmean(np.square(values), axis=0))
            return (
                f"{what}: {len(values)} samples, RMS {', '.join(f'{x:.3g}' for x in rms)} {self.units[what]}"
            )

        return (
            f"Residuals of log {self.name!r}\n  {words('position', self.position)}\n"
            f"  {words('force', self.force)}"
        )


def frame(content: Any, *, index: Any = None, index_name: str = "", **options: Any) -> pandas.DataFrame:
    """Return a pandas table.

    Args:
        content: Columns by name, rows, or a matrix.
        index: Label of each row; absent: its number.
        index_name: Name of the index; empty: none.
        options: Further arguments of `pandas.DataFrame`.

    Raises:
        InputError: If pandas is not installed.
    """
    try:
        import pandas
    except ImportError as error:
        raise InputError("to_pandas needs pandas", hint="pip install 'jaxid[pandas]'") from error
    table = pandas.DataFrame(content, index=index, **options)
    if index_name:
        table.index.name = index_name
    return table


def lines_of(parameters: Mapping[str, Parameter], most: int = 8) -> list[str]:
    """Return a line for each parameter, the last of which counts those beyond `most`."""
    width = max((len(name) for name in [*parameters][:most]), default=0)
    lines = [f"  {name:<{width}}  {p}" for name, p in [*parameters.items()][:most]]
    return lines + ([f"  and {len(parameters) - most} more"] if len(parameters) > most else [])


def html_table(rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """Return a plain HTML table.

    Args:
        rows: Text of each cell, the header first; in a column "unit" powers are raised.
        caption: Line above the table; empty: none.
    """
    heads = rows[0]

    def line(cells: Sequence[str], tag: str) -> str:
        shown = [pretty_unit(c) if h == "unit" else c for h, c in zip(heads, cells, strict=True)]
        inner = "".join(f'<{tag} style="text-align: left">{escape(cell)}</{tag}>' for cell in shown)
        return f"<tr>{inner}</tr>"

    head = f'<caption style="text-align: left">{escape(caption)}</caption>' if caption else ""
    body = "".join(line(row, "td") for row in rows[1:])
    return f"<table>{head}<thead>{line(heads, 'th')}</thead><tbody>{body}</tbody></table>"


def _some(names: Sequence[str], most: int = 6) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
