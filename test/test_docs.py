"""The pages: built with warnings as errors, with every block run or checked."""

import json
from pathlib import Path
import re
import runpy
import subprocess
import sys

from documents import (
    alike,
    Block,
    blocks,
    check,
    check_named,
    commands,
    console,
    Failure,
    fault,
    INSTALLATION,
    pages,
    REPOSITORY,
    ROOT,
    run_page,
    Session,
)
from extras import needs
import pytest

from hmsa.plugins import NODES, registered

PAGES = pages()
# Without parsing them all when tests are collected.
RUNNING = [page for page in PAGES if re.search(
    r'^ *`{3,}(bash|sh|shell|console|python|py) *$', page.read_text(encoding='utf-8'), re.M)]


def name_of(page: Path) -> str:
    """Return the path of a page from the root of the repository."""
    return str(page.relative_to(ROOT))


def a_block(language: str, text: str, marker: str = '') -> Block:
    """Return a block of an arbitrary page."""
    return Block(ROOT / 'README.md', 1, language, marker, text)


@pytest.mark.parametrize('page', PAGES, ids=name_of)
def test_every_block_of_the_page_is_run_or_checked(page):
    found = blocks(page)
    assert any(block.runs for block in found) == (page in RUNNING)
    before = [None, *found]
    assert [f'{block.place} {reason}' for block, previous in zip(found, before, strict=False)
            if (reason := fault(block, previous))] == []
    for block in found:
        if not block.runs:
            check(block)


@pytest.mark.parametrize('page', PAGES, ids=name_of)
def test_commands_and_options_in_the_text_of_the_page_exist(page):
    check_named(page.read_text(encoding='utf-8'))


@pytest.mark.parametrize(('text', 'reason'), [
    ('see `hmsa plann`', "command of 'hmsa plann'"), ('`hmsa bag inof`', 'no command of'),
    ('with `hmsa plan 1.1:10\n--shapr zvd`', "hmsa plan has no option '--shapr'"),
    ('`hmsa init --beam --lenght=3`', "hmsa init has no option '--lenght'")])
def test_a_wrong_name_in_the_text_is_found(text, reason):
    with pytest.raises(Failure, match=reason):
        check_named(text)


@pytest.mark.ros
@pytest.mark.long
@pytest.mark.timeout(600)
# One after the other: a page with nodes takes both cores.
@pytest.mark.xdist_group('heavy')
@pytest.mark.parametrize('page', [
    pytest.param(
        x, marks=[] if x.name == 'README.md' else pytest.mark.slow, id=name_of(x))
    for x in RUNNING])
def test_page_does_what_it_says(page, ros_env, tmp_path):
    # How long each block took: shown if it fails, or by pytest -rP.
    print(*run_page(page, tmp_path, ros_env), sep='\n')


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.xdist_group('sphinx')
def test_pages_are_built_without_a_warning(tmp_path):
    needs('sphinx')
    built = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-W', '--keep-going', '-q', '-b', 'html',
         '-d', str(tmp_path / 'doctrees'), str(ROOT / 'docs'), str(tmp_path / 'html')],
        capture_output=True, text=True, check=False)
    assert (built.returncode, built.stderr) == (0, '')
    topics = (tmp_path / 'html' / 'reference' / 'topics.html').read_text(encoding='utf-8')
    assert 'flux_density_command' in topics
    assert '~/split_bagfile' in topics
    parameters = (tmp_path / 'html' / 'reference' / 'parameters.html').read_text(encoding='utf-8')
    for node in ('planner', 'plant', 'recorder', 'player'):
        for spec in registered(NODES)[node].load().PARAMETERS:
            assert f'>{spec.name}<' in parameters
    theory = (tmp_path / 'html' / 'explanation' / 'theory.html').read_text(encoding='utf-8')
    assert '<math' in theory
    assert '<script src="http' not in theory
    index = (tmp_path / 'html' / 'searchindex.js').read_text(encoding='utf-8')
    check_searched(json.loads(index[index.index('(') + 1:index.rindex(')')]))


def check_searched(index):
    """Check that the search leads from a student's words to their page."""
    words = runpy.run_path(str(ROOT / 'docs' / '_ext' / 'words.py'))['WORDS']
    for page, word in ((x, word) for x, each in words.items() for word in each):
        # A main entry, which is listed before the pages that contain the words.
        found = [(index['docnames'][x], main)
                 for x, _, main in index['indexentries'][word.lower()]]
        assert found == [(page, True)], word
        # The page is about it, too.
        text = (ROOT / 'docs' / f'{page}.md').read_text(encoding='utf-8')
        assert any(re.search(rf'\b{x}', text, re.I) for x in re.split('[ -]', word)), word
    for word, page in (
            ('emergency stop', 'explanation/faults'), ('gait', 'guides/without-ros'),
            ('camera', 'guides/sensors'), ('millimetres', 'guides/sensors'),
            ('field to current', 'guides/calibration'), ('Matlab', 'guides/recording'),
            ('two actuators', 'guides/several-actuators'),
            ('own driver', 'tutorials/your-own-driver'),
            ('choose a shaper', 'explanation/which-shaper'), ('beam', 'explanation/beam')):
        assert word in words[page]


def test_sidebar_has_groups_of_at_most_seven_pages_and_each_page_once():
    text = (ROOT / 'docs' / 'index.md').read_text(encoding='utf-8')
    groups = re.findall(r'```{toctree}\n:caption: (.*)\n:maxdepth: 1\n\n((?:.+\n)+?)```', text)
    assert len(groups) == text.count('{toctree}')
    entries = [entries.split() for _, entries in groups]
    assert max(map(len, entries)) <= 7
    found = {str(x.relative_to(ROOT / 'docs').with_suffix(''))
             for x in (ROOT / 'docs').rglob('*.md') if '_build' not in x.parts} - {'index'}
    assert sorted(sum(entries, [])) == sorted(found)


def test_landing_page_begins_with_the_moving_picture():
    title, _, first = (ROOT / 'docs' / 'index.md').read_text(encoding='utf-8').splitlines()[:3]
    assert title == '# hmsa_ros'
    assert re.fullmatch(r'!\[.+\]\(images/moving\.gif\)', first)


def test_graph_shows_the_topics_as_they_are():
    drawn = subprocess.run(
        [sys.executable, str(ROOT / 'scripts' / 'draw_graph.py'), '--check'],
        capture_output=True, text=True, check=False)
    assert drawn.stderr == ''


def test_a_block_that_fails_is_told_with_what_it_printed(tmp_path):
    session = Session(tmp_path, {})
    try:
        assert session.run('bash', 'x=3; echo $x', 'here') == '3\n'
        assert session.run('bash', 'echo $((x + 1))', 'here') == '4\n'
        assert session.run('python', 'y = 1\nprint(y)', 'here') == '1\n'
        with pytest.raises(Failure, match=r'there: status 1(?s:.)*ZeroDivisionError'):
            session.run('python', 'y / 0', 'there')
        with pytest.raises(Failure, match='there: status 7'):
            session.run('bash', '(exit 7)\necho not reached', 'there')
    finally:
        session.close()


def test_a_background_process_that_fails_is_told_at_the_end_of_the_page(tmp_path):
    session = Session(tmp_path, {})
    session.run('bash', '(exit 3) &\nwhile [ -n "$(jobs -r)" ]; do :; done', 'here')
    with pytest.raises(Failure, match='ended with status 3'):
        session.close()


def test_output_is_compared_word_by_word_and_number_by_number():
    assert alike('a 1.3157 5e-08 yes', 'a 1.31575 9.1e-08 yes')
    assert not alike('a 1.31 yes', 'a 1.35 yes')
    assert not alike('a 1 yes', 'a 1 no')
    assert not alike('a', 'a b')
    assert alike('a ... d', 'a b c d')
    assert not alike('a ... e', 'a b c d')


def test_commands_are_found_behind_pipes_variables_and_continued_lines():
    assert commands('A=1 ros2 topic list | grep x &\nros2 run a \\\n  b # c') == [
        ['ros2', 'topic', 'list'], ['grep', 'x'], ['ros2', 'run', 'a', 'b']]
    assert commands('x=$(ros2 pkg list)/a\nfor i in a b; do\n  ros2 run c\ndone') == [
        ['ros2', 'pkg', 'list'], ['ros2', 'run', 'c']]


def test_console_blocks_are_commands_with_their_output():
    assert console(a_block('console', '$ a \\\n  b\nout\n$ c\n')) == [
        ('a \\\n  b', 'out'), ('c', '')]


@pytest.mark.parametrize(('text', 'reason'), [
    ('ros2 run hmsa_ros plnner', 'no executable'),
    ('ros2 run hmsa_ros plant --ros-args -p publish_clk:=true', "'publish_clk' is not declared"),
    ('ros2 run hmsa_ros hmsa send 1.1', 'hmsa does not understand'),
    ('ros2 launch hmsa_ros demo.launch.py recrd:=true', "no argument 'recrd'"),
    ('ros2 launch hmsa_ros demo.launch.py record:=maybe', "record cannot be 'maybe'"),
    ('ros2 launch hmsa_ros nothing.launch.py', 'no launch file'),
    ("ros2 topic pub --once /planner/setpoint std_msgs/msg/Float64 '{dta: 1}'", "no field 'dta'"),
    ("ros2 topic pub /planner/setpoint std_msgs/msg/Float32 '{data: 1}'", 'has type Float64'),
    ("ros2 topic pub /planner/setpont std_msgs/msg/Float64 '{data: 1}'", 'no topic'),
    ('ros2 topic echo /stretsh', 'no topic'),
    ('ros2 service call /planner/stp std_srvs/srv/Trigger', 'no service'),
    ('ros2 param set /planner shapr zvd', "'shapr' is not declared"),
    ('ros2 param set /plnner shaper zvd', 'no node'), ('frobnicate', 'no program'),
    ('echo "', 'unexpected EOF')])
def test_a_wrong_name_in_a_block_for_an_installation_is_found(text, reason):
    with pytest.raises(Failure, match=reason):
        check(a_block('bash', text, INSTALLATION))


@pytest.mark.parametrize(('language', 'marker', 'text', 'reason'), [
    ('bash', REPOSITORY, 'make tset', "no target 'tset'"),
    ('bash', REPOSITORY, "pip install '.[rso]'", "no extra 'rso'"),
    ('bash', REPOSITORY, '.ci/rn', 'no file'),
    ('bash', REPOSITORY, 'python -m benchmark faults', 'no module'),
    ('yaml', '', '/**:\n  ros__parameters:\n    lead_tme: 1.0\n', "'lead_tme' is not declared"),
    ('yaml', '', 'a: [', 'expected'), ('json', '', '{', 'Expecting')])
def test_a_wrong_name_in_any_other_block_is_found(language, marker, text, reason):
    with pytest.raises(Failure, match=reason):
        check(a_block(language, text, marker))


@pytest.mark.parametrize(('language', 'marker', 'reason'), [
    ('', '', 'no language'), ('bash', 'skip', "marked 'skip'"), ('python', 'skip', 'marked'),
    ('ini', '', "is in 'ini'"), ('{code-block}', '', 'is in')])
def test_a_block_cannot_be_left_out(language, marker, reason):
    assert reason in fault(a_block(language, 'x', marker), None)


@pytest.mark.ros
def test_topics_and_services_are_those_that_the_nodes_have(start, ros, ros_env):
    from hmsa.interfaces import topics

    # By parameter only, or only while it is needed.
    sometimes = {'/clock', '/planner/markers', '/plant/markers', '/temperature'}
    declared = [x for x in vars(topics).values() if isinstance(x, topics.Topic)]
    services = [x for x in vars(topics).values() if isinstance(x, topics.Service)]

    def full(name: str, node: str) -> str:
        return '/' + topics.from_outside(name, node).lstrip('/')

    for name in (topics.PLANNER, topics.PLANT):
        start.hmsa(name)
    for name in (topics.PLANNER, topics.PLANT):
        sent = {full(x.name, name) for x in declared if name in x.publishers}
        taken = {full(x.name, name) for x in declared if name in x.subscribers}
        served = {full(x.name, name) for x in services if name in x.meaning}
        ros.spin_until(lambda name=name: name in ros.node.get_node_names(), f'the {name}')
        ros.spin_until(
            lambda name=name, sent=sent: sent - sometimes <= {
                topic for topic, _ in ros.node.get_publisher_names_and_types_by_node(name, '/')},
            f'the topics of the {name}: {sent}')
        ros.spin_until(
            lambda name=name, served=served: served <= {
                service for service, _ in ros.node.get_service_names_and_types_by_node(name, '/')},
            f'the services of the {name}: {served}')
        ours = ('std_msgs/', 'sensor_msgs/', 'trajectory_msgs/', 'diagnostic_msgs/', 'std_srvs/',
                'geometry_msgs/', 'visualization_msgs/')

        def of_ours(found, ours=ours):
            return {thing for thing, types in found if types[0].startswith(ours)}

        assert of_ours(ros.node.get_publisher_names_and_types_by_node(name, '/')) <= sent
        assert of_ours(ros.node.get_subscriber_names_and_types_by_node(name, '/')) <= taken
        assert of_ours(ros.node.get_service_names_and_types_by_node(name, '/')) <= served
