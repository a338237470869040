"""Options of commands, as rows of tables."""

from typing import Any

#: Name, metavar, type, help and, where there are any, other settings of argparse; of a flag name
#: and help.
Row = tuple[Any, ...]

JSON: Row = ('--json', 'print one JSON object')
NAMESPACE: Row = ('--namespace', 'NS', str, 'namespace of the planner', {'default': ''})
#: Dimensionless parameters of a block: option, metavar and meaning.
MATERIAL = (
    ('--zeta', 'Z', 'dimensionless damping, at least 0 (default 0.2)'),
    ('--j-lim', 'J', 'Gent limiting extensibility J_lim, above 0 (default 5)'),
    ('--c1', 'C', 'shape 2 H^2/L^2, above 0 (default 2)'))


def add_options(parser: Any, *rows: Row) -> None:
    """Add options in the order of the help."""
    for name, *texts in rows:
        if len(texts) == 1:
            parser.add_argument(name, action='store_true', help=texts[0])
        else:
            metavar, kind, text, *settings = texts
            parser.add_argument(
                name, metavar=metavar, type=kind, help=text, **(settings[0] if settings else {}))
