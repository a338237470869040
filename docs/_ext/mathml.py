"""Formulas as MathML, which browsers draw themselves: no script, no network, no LaTeX."""

from typing import Any

from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util.math import get_node_equation_number


def _inline(translator: Any, node: Any) -> None:
    """Write a formula in a line of text."""
    translator.body.append(tex2mathml(node.astext()))


def _display(translator: Any, node: Any) -> None:
    """Write a formula in a paragraph of its own, with its number if it has a label."""
    translator.body.append(translator.starttag(node, 'div', CLASS='math'))
    if node['number']:
        number = get_node_equation_number(translator, node)
        translator.body.append(f'<span class="eqno">({number})')
        translator.add_permalink_ref(node, 'Link to this equation')
        translator.body.append('</span>')
    translator.body.append(tex2mathml(node.astext(), as_block=True))
    translator.body.append('</div>')


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer."""

    def leave(function: Any) -> Any:
        def visit(translator: Any, node: Any) -> None:
            from docutils.nodes import SkipNode

            function(translator, node)
            raise SkipNode
        return visit

    app.add_html_math_renderer('mathml', (leave(_inline), None), (leave(_display), None))
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
