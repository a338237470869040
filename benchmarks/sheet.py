"""A table of figures, to be printed, put on a page, or written as JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from rich.console import Console
from rich.table import Table

# Headings of columns without numbers, besides the first one.
_TEXT = ('setting', 'remark', 'how', 'expected', 'residual or loss')


@dataclass(frozen=True)
class Sheet:
    """A table with its own headings; without headings, its legend alone."""

    key: str  # name in the JSON file and in the marks of a page
    title: str
    head: Sequence[str]  # of a first column of text and further columns, most of numbers
    rows: Sequence[Sequence[str]]
    figures: Mapping[str, Any] = field(default_factory=dict)  # the same in full, for JSON
    passed: bool = True  # whether the goals are met
    legend: Sequence[str] = ()  # what the columns mean, one each
    remarks: Sequence[str] = ()  # what follows, beside the machine on a page

    @property
    def _texts(self) -> list[bool]:
        """Whether each column is one of text."""
        return [i == 0 or name in _TEXT for i, name in enumerate(self.head)]

    def show(self, console: Console) -> None:
        """Print the table."""
        if self.head:
            table = Table(title=self.title, title_justify='left')
            for name, is_text in zip(self.head, self._texts, strict=True):
                table.add_column(name, justify='left' if is_text else 'right')
            for cells in self.rows:
                table.add_row(*cells)
            console.print(table)
        for text in self.legend:
            console.print(f'* {text}', markup=False, highlight=False)
        for text in self.remarks:
            console.print(text)

    def markdown(self) -> str:
        """Return the table for a page of the documentation."""
        legend = [f'* {x}' for x in self.legend]
        if not self.head:
            return '\n'.join([*legend, ''])
        rule = ['---' if x else '--:' for x in self._texts]
        lines = ['| ' + ' | '.join(x.replace('|', '\\|') for x in cells) + ' |'
                 for cells in (self.head, rule, *self.rows)]
        return '\n'.join([
            f'**{self.title}**', '', *legend, *[''] * bool(legend), *lines, ''])

    def record(self) -> dict[str, Any]:
        """Return the table for a JSON file."""
        return asdict(self)
