"""Where the error comes from, as a table of the terminal."""

from collections.abc import Sequence

from rich.table import Table

from stitch.diagnosis.variance_budget import BudgetLine
from stitch.units import length_text
from stitch.writing.error_sources import largest_error_sources, share_text


def budget_table(budget: Sequence[BudgetLine], length_unit: str) -> Table | None:
    """Source, share of the variance and size (rms) of all that the poses leave; None where there is no budget."""
    told = largest_error_sources(budget)
    if not told:
        return None
    table = Table(title="Where the error comes from (of whole views, against one hand-eye)", title_justify="left")
    for heading in ("source", "share", "size (rms)"):
        table.add_column(heading, justify="left" if heading == "source" else "right", no_wrap=True)
    for line in told:
        table.add_row(line.source, share_text(line), length_text(line.sigma, length_unit, 2))
    return table
