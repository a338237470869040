"""Consistency of the parameter files of recorder and player with the nodes."""

from pathlib import Path

import pytest
import yaml

from hmsa.errors import BadInputError
from hmsa_ros.nodes import player, recorder
from hmsa_ros.nodes.selection import Filter, Selection

CONFIG = Path(__file__).resolve().parent.parent / 'config'


@pytest.mark.parametrize(('name', 'module'), [('recorder', recorder), ('player', player)])
def test_the_file_lists_every_parameter_with_its_default(name, module):
    content = yaml.safe_load((CONFIG / f'{name}.yaml').read_text())['/**']['ros__parameters']
    assert list(content.items()) == [(spec.name, spec.default) for spec in module.PARAMETERS]
    for spec in module.PARAMETERS:
        assert type(content[spec.name]) is type(spec.default)


def test_topics_are_selected_by_name_expression_and_exclusion():
    everything = Selection()
    assert everything.wants('/a')
    assert not everything.wants('/_hidden')
    some = Selection(
        topics=('/a', '/_b'), regex='^/x', exclude_topics=('/x1',), exclude_regex='2$')
    assert [name for name in ('/a', '/_b', '/b', '/x', '/x1', '/x2', '/_x') if some.wants(name)
            ] == ['/a', '/_b', '/x']
    with pytest.raises(BadInputError, match='expected a regular expression'):
        Selection(regex='(')


def test_commands_pass_only_by_name():
    free = Filter()
    assert free.selects('/left/flux_density_command')
    for topic in ('/left/flux_density_command', '/planner/joint_trajectory',
                  '/planner/setpoint'):
        for chosen, withheld in (
                (free, True), (Filter(regex='.*'), True), (Filter(topics=(topic,)), False)):
            assert chosen.withholds(topic, topic, '') is withheld
    assert not free.withholds('/joint_states', '/joint_states', '')
    with pytest.raises(BadInputError, match='expected a regular expression'):
        Filter(exclude_regex='(')
