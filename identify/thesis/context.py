"""What a table function is given, and the shapes that most tables have."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from armident.identify.thesis.cached_estimates import Case, Laboratory, Method, Run
from armident.identify.thesis.emps_derivatives import Row, table_5_2
from armident.identify.thesis.recordings import Recorded
from armident.identify.thesis.reference import reference_tables
from armident.identify.thesis.tables import Cell, Column, Source, Table

SIMULATIONS, SIMULATIONS_QUICK = 100, 3
"""Noise realisations of table 5.2, the thesis's number and what is enough for two digits."""


@dataclass(frozen=True)
class Bench:
    """The arms.

    Parameters
    ----------
    virtual
        The virtual TX40, whose drives act on the tracking error alone.
    feedback
        The same arm with drives that feed back the velocity.
    measured
        The measured one, without reference and controller; ``None``: not at hand.
    emps
        The measured EMPS; ``None``: not at hand.
    axis
        The virtual one; ``None``: not asked for.
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
        """Errors of the derivatives on the simulated EMPS, by method."""
        return self.virtual.once(("EMPS", self.simulations), lambda: table_5_2(self.simulations))

    def arms(self, method: Method) -> list[tuple[Source, Laboratory]]:
        """The arms whose recordings let a method run."""
        arms: list[tuple[Source, Laboratory]] = [("virtual", self.virtual)]
        if self.measured is not None and method == "idim-ls":
            arms.append(("measured", self.measured))
        return arms


TableFunction = Callable[[Bench], Table]


def estimates(
    bench: Bench, number: str, columns: Sequence[tuple[str, Method, Case]], notes: Sequence[str] = ()
) -> Table:
    """A table of estimates: the thesis's columns, ours by method and case, and the virtual arm's own parameters."""
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
    """A table of figures by row label, one per column of the thesis (or of ``names``)."""
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
    """Iterations of a run; ``None`` where it did not converge."""
    return run.estimate.iterations if run.estimate.converged else None
