"""
Draw docs/images/graph.svg, the graph of nodes and topics, from hmsa.interfaces.topics.

Used by ``make graph``. With ``--check`` nothing is written; the exit status is 1 if the file is
not what would be drawn.
"""

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
import sys

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / 'docs' / 'images' / 'graph.svg'
WIDTH = 640
LINE = 19
BOX_LEFT, BOX_RIGHT = 186, 406
DOWN, UP = 226, 366
# Readable on a light and on a dark page, whatever shows it: it brings its own ground.
STYLE = """
    .ground { fill: #ffffff; stroke: #d0d7de; }
    .node { fill: #e8f1f8; stroke: #0072b2; stroke-width: 1.5; }
    .arrow { stroke: #57606a; stroke-width: 1.5; fill: none; marker-end: url(#head); }
    .head { fill: #57606a; }
    text { font: 14px system-ui, 'DejaVu Sans', sans-serif; fill: #1f2328; }
    .name { font-weight: 600; font-size: 16px; }
    .small { font-size: 12px; fill: #57606a; }
    .topic { font-family: ui-monospace, 'DejaVu Sans Mono', monospace; font-size: 13px; }
    @media (prefers-color-scheme: dark) {
      .ground { fill: #14181d; stroke: #3d444d; }
      .node { fill: #16324a; stroke: #56b4e9; }
      .arrow { stroke: #9198a1; }
      .head { fill: #9198a1; }
      text { fill: #e6edf3; }
      .small { fill: #9198a1; }
    }
"""


class Drawing:
    """Shapes and texts, written one below the other."""

    def __init__(self) -> None:
        """Begin empty."""
        self.parts: list[str] = []

    def box(self, top: float, height: float, left: float = BOX_LEFT,
            right: float = BOX_RIGHT) -> None:
        """Draw the box of a node."""
        self.parts.append(
            f'<rect class="node" x="{left}" y="{top}" width="{right - left}" '
            f'height="{height}" rx="8"/>')

    def text(self, x: float, y: float, text: str, kind: str = '', anchor: str = 'start') -> None:
        """Write a line of text; y is its base line."""
        self.parts.append(
            f'<text class="{kind}" x="{x}" y="{y}" text-anchor="{anchor}">{escape(text)}</text>')

    def arrow(self, x: float, y: float, to_x: float, to_y: float) -> None:
        """Draw an arrow."""
        self.parts.append(f'<path class="arrow" d="M{x} {y} L{to_x} {to_y}"/>')

    def names(self, x: float, top: float, names: Iterable[str], anchor: str = 'start') -> None:
        """Write names of topics below each other."""
        for i, name in enumerate(names):
            self.text(x, top + 14 + i * LINE, name, 'topic', anchor)


def draw() -> str:
    """Return the graph as SVG."""
    from hmsa.interfaces import topics
    from hmsa.interfaces.topics import PLANNER, PLANT, PLAYER, RECORDER

    declared = [x for x in vars(topics).values() if isinstance(x, topics.Topic)]
    own = [x for x in declared if not x.name.startswith('/')]
    absolute = [x.name for x in declared if x.name.startswith('/')]

    def between(sender: str, taker: str) -> list[str]:
        return [topics.from_outside(x.name, sender) for x in own
                if sender in x.publishers and taker in x.subscribers]

    def open_ended(sender: str) -> list[str]:
        return [topics.from_outside(x.name, sender) for x in own
                if sender in x.publishers and not {PLANNER, PLANT} & set(x.subscribers)]

    def services(node: str) -> str:
        return ', '.join(x.name.removeprefix('~/') for x in vars(topics).values()
                         if isinstance(x, topics.Service) and node in x.meaning)

    def from_you(taker: str) -> list[str]:
        return [topics.from_outside(x.name, taker) for x in own
                if taker in x.subscribers and not x.publishers]

    requests = from_you(PLANNER)
    down, up = between(PLANNER, PLANT), between(PLANT, PLANNER)

    drawing = Drawing()
    middle = (BOX_LEFT + BOX_RIGHT) / 2

    def node(top: float, name: str, note: str) -> float:
        sent = open_ended(name)
        height = max(64, LINE * len(sent) + 16)
        drawing.box(top, height)
        drawing.text(middle, top + height / 2 - 4, name, 'name', 'middle')
        drawing.text(middle, top + height / 2 + 15, note, 'small', 'middle')
        if sent:
            drawing.arrow(BOX_RIGHT, top + height / 2, BOX_RIGHT + 34, top + height / 2)
            drawing.names(
                BOX_RIGHT + 42, top + height / 2 - LINE * len(sent) / 2 + 1, sent)
        taken = from_you(name) if name == PLANT else []
        if taken:
            drawing.arrow(BOX_LEFT - 24, top + height / 2, BOX_LEFT - 4, top + height / 2)
            drawing.names(
                BOX_LEFT - 28, top + height / 2 - LINE * len(taken) / 2 + 1, taken, 'end')
        return top + height

    y = 14.0
    drawing.text(middle, y + 12, 'your setpoints', 'small', 'middle')
    drawing.names(middle, y + 16, requests, 'middle')
    y += 22 + LINE * len(requests)
    drawing.arrow(middle, y, middle, y + 24)
    y = node(y + 28, PLANNER, 'shapes the commands')
    gap = LINE * max(len(down), len(up)) + 20
    drawing.arrow(DOWN, y, DOWN, y + gap)
    drawing.names(DOWN - 10, y + (gap - LINE * len(down)) / 2 - 2, down, 'end')
    if up:
        drawing.arrow(UP, y + gap + 4, UP, y + 4)
        drawing.names(UP + 10, y + (gap - LINE * len(up)) / 2 - 2, up)
    y = node(y + gap + 4, PLANT, 'or a driver of your own')
    y += 24
    drawing.text(
        middle, y, f'services of the planner: {services(PLANNER)}', 'small', 'middle')
    y += 16
    drawing.text(
        middle, y, f'services of the plant: {services(PLANT)}; for all: '
        + ', '.join(absolute), 'small', 'middle')
    y += 18
    for name, left, right in ((RECORDER, 24, 164), (PLAYER, 476, 616)):
        drawing.box(y, 44, left, right)
        drawing.text((left + right) / 2, y + 27, name, 'name', 'middle')
    drawing.box(y, 44, 250, 390)
    drawing.text(320, y + 20, 'bag', 'name', 'middle')
    drawing.text(320, y + 36, 'MCAP, as rosbag2', 'small', 'middle')
    drawing.arrow(164, y + 22, 244, y + 22)
    drawing.arrow(390, y + 22, 470, y + 22)
    drawing.text(94, y + 62, 'any topics', 'small', 'middle')
    drawing.text(546, y + 62, 'the same topics', 'small', 'middle')
    height = y + 76
    return '\n'.join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:g}" '
        f'width="{WIDTH}" height="{height:g}" role="img" aria-labelledby="title">',
        '<title id="title">Nodes of hmsa_ros and the topics between them</title>',
        f'<style>{STYLE}</style>',
        '<defs><marker id="head" viewBox="0 0 10 10" refX="8" refY="5" markerWidth="7" '
        'markerHeight="7" orient="auto"><path class="head" d="M0 0 L10 5 L0 10 z"/></marker>'
        '</defs>',
        f'<rect class="ground" x="0.5" y="0.5" width="{WIDTH - 1}" height="{height - 1:g}" '
        'rx="10"/>',
        *drawing.parts, '</svg>', ''])


def main(words: Sequence[str]) -> int:
    """Write or check the file; return the exit status."""
    drawn = draw()
    if '--check' not in words:
        FILE.write_text(drawn, encoding='utf-8')
    elif not FILE.exists() or FILE.read_text(encoding='utf-8') != drawn:
        print(f'{FILE} is not what hmsa.interfaces.topics says: expected it drawn anew, '
              'run make graph', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.path.insert(0, str(ROOT))
    sys.exit(main(sys.argv[1:]))
