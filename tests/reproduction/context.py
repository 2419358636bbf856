"""Arms of the tables (`Bench`), and builders of tables of estimates and of figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from tests.reproduction.cached_estimates import Case, Laboratory, Method, Run
from tests.reproduction.emps_derivatives import Row, table_5_2
from tests.reproduction.recordings import Recorded
from tests.reproduction.reference import reference_tables
from tests.reproduction.tables import Cell, Column, Source, Table

SIMULATIONS, SIMULATIONS_QUICK = 100, 3
"""Noise realisations of table 5.2: as in the thesis, and enough for two digits."""


@dataclass(frozen=True)
class Bench:
    """Arms whose recordings the tables use.

    Parameters
    ----------
    virtual
        Virtual TX40; its drives act on the tracking error alone.
    feedback
        Virtual TX40 with velocity feedback in its drives.
    measured
        Measured TX40, without reference and controller; ``None``: not available.
    emps
        Measured EMPS; ``None``: not available.
    axis
        Virtual EMPS; ``None``: not needed.
    simulations
        Noise realisations of the simulated EMPS.
    """

    virtual: Laboratory
    feedback: Laboratory
    measured: Laboratory | None = None
    emps: Recorded | None = None
    simulations: int = SIMULATIONS
    axis: Laboratory | None = None

    def emps_derivatives(self) -> list[Row]:
        """Return the errors of the derivatives on the simulated EMPS by method."""
        return self.virtual.once(("EMPS", self.simulations), lambda: table_5_2(self.simulations))

    def arms(self, method: Method) -> list[tuple[Source, Laboratory]]:
        """Return the arms whose recordings suffice for a method."""
        arms: list[tuple[Source, Laboratory]] = [("virtual", self.virtual)]
        if self.measured is not None and method == "idim-ls":
            arms.append(("measured", self.measured))
        return arms


TableFunction = Callable[[Bench], Table]


def estimates(
    bench: Bench, number: str, columns: Sequence[tuple[str, Method, Case]], notes: Sequence[str] = ()
) -> Table:
    """Return a table of estimates: columns of the thesis, ours, and the true parameters of the virtual arm.

    ``bench``: arms with their cached estimates; ``notes``: notes below the table.
    """
    printed = reference_tables()[number]
    ours = [
        lab.column(name, lab.run(method, case), source)
        for name, method, case in columns
        for source, lab in bench.arms(method)
    ]
    return Table(number, printed.title, printed.labels, (*printed.printed(), *ours, bench.virtual.own()), tuple(notes))


def figures(
    number: str,
    values: Mapping[str, Sequence[float | None]],
    notes: Sequence[str] = (),
    *,
    names: Sequence[str] | None = None,
    measured: Mapping[str, Sequence[float | None]] | None = None,
) -> Table:
    """Return a table of figures.

    ``values``: our figures by row label, one per column. ``notes``: notes below the table. ``names``: names of our
    columns; by default those of the thesis. ``measured``: figures from the measured arm, like ``values``.
    """
    printed = reference_tables()[number]
    columns = list(printed.printed())
    sources: list[tuple[Source, Mapping[str, Sequence[float | None]]]] = [("virtual", values)]
    if measured is not None:
        sources.append(("measured", measured))
    for source, rows in sources:
        for k, name in enumerate(names or printed.columns):
            columns.append(Column(source, name, {label: Cell(row[k]) for label, row in rows.items()}))
    labels = (*printed.labels, *(label for label in values if label not in printed.labels))
    return Table(number, printed.title, labels, tuple(columns), tuple(notes))


def iterations(run: Run) -> float | None:
    """Return the iterations of a run; ``None`` if it did not converge."""
    return run.estimate.iterations if run.estimate.converged else None
