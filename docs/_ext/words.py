"""
Words that readers search for and the page that answers each, entered into its index.

Sphinx's search lists a page whose main index entry is searched for before those that contain the
words, and pages with other entries after all of them.
"""

from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx

WORDS = {
    'explanation/beam': ('beam', 'cantilever', 'strip'),
    'explanation/compressibility': ('bulk modulus', 'pores'),
    'explanation/creep': ('viscoelastic', 'relaxation'),
    'explanation/faults': ('emergency stop', 'interlock', 'watchdog'),
    'explanation/modes': ('mode shapes',),
    'explanation/robustness': ('compare shapers', 'robustness'),
    'explanation/temperature': ('temperature', 'warming'),
    'explanation/which-shaper': ('choose a shaper', 'input shaping', 'ZV'),
    'guides/calibration': ('field to current', 'current', 'ampere', 'coil constant'),
    'guides/hyperelastic-models': ('Gent', 'Ogden', 'Yeoh', 'own material', 'stress-strain curve'),
    'guides/recording': ('Matlab', 'CSV', 'rosbag', 'export', 'replay'),
    'guides/report': ('report', 'figure', 'plot', 'paper figure'),
    'guides/sensors': ('camera', 'laser', 'millimetres', 'motion capture'),
    'guides/serial-board': ('Arduino', 'microcontroller'),
    'guides/several-actuators': ('several actuators', 'two actuators', 'joints'),
    'guides/setpoints': ('send', 'stop', 'joystick', 'MoveIt', 'trajectory', 'publish a sequence'),
    'guides/sweeps': ('sweep', 'parameter study'),
    'guides/viewers': ('RViz', 'Foxglove', 'PlotJuggler'),
    'guides/without-ros': ('plan', 'simulate', 'gait', 'sine wave', 'periodic motion'),
    'reference/driver': ('bench supply',),
    'tutorials/first-run': ('demo', 'install'),
    'tutorials/identify': ('identify', 'system identification', 'fit parameters'),
    'tutorials/notebook': ('Python', 'notebook', 'pandas', 'xarray', 'pint'),
    'tutorials/your-own-actuator': ('limits of the coil', 'parameter file'),
    'tutorials/your-own-driver': ('own driver', 'amplifier'),
}


def enter(app: Sphinx, document: nodes.document) -> None:
    """Enter the words of a page, with its beginning as their target."""
    words = WORDS.get(app.env.docname, ())
    if words:
        entry = addnodes.index(entries=[('single', x, 'searched', 'main', None) for x in words])
        document.insert(0, [entry, nodes.target(ids=['searched'])])


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the entries."""
    app.connect('doctree-read', enter)
    # The index of the search has the entries only of pages that are written anew.
    app.connect('env-get-outdated', lambda *_: list(WORDS))
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
