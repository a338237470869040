"""A bag of the demo in Rerun's own MCAP loader, without a window."""

from collections import Counter
import re

import pytest

from hmsa_ros.bag.reader import BagReader, read_messages

chunks = pytest.importorskip(
    'rerun.chunk', reason='rerun-sdk is not installed (extra "viewers", some 500 MB)')

pytestmark = [pytest.mark.ros, pytest.mark.slow]
DEMO_SECONDS = 120.0


@pytest.fixture
def bag(start, tmp_path):
    """Return the bag of a demo."""
    demo = start.hmsa('demo', '--out', tmp_path / 'out', '--json')
    assert demo.wait(DEMO_SECONDS) == 0, demo.output
    return tmp_path / 'out' / 'run'


def test_every_topic_arrives_with_every_message_and_the_values(bag, capfd):
    reader = BagReader(bag)
    path, = reader.files
    mcap = chunks.McapReader(path)
    info = mcap.info()
    assert (info.profile, info.summary_source) == ('ros2', 'embedded')
    assert {x.topic: x.message_count for x in info.channels} == reader.counts()
    rows, stretches = Counter(), []
    for chunk in mcap.stream():
        if not chunk.is_static:
            rows[str(chunk.entity_path)] += chunk.num_rows
            if chunk.entity_path == '/stretch':
                batch = chunk.to_record_batch()
                column, = (x for x in batch.schema.names if re.search(r'Float64:message$', x))
                stretches += [x[0]['data'] for x in batch.column(column).to_pylist()]
    assert {topic: rows[topic] for topic in reader.topics} == reader.counts()
    # Taken apart by Rerun, which knows joint states.
    assert rows['/joint_states/position'] == rows['/joint_states']
    assert stretches == [x.message.data for x in read_messages(bag, ['/stretch'])]
    # Notes that are there twice are warned of, one by one.
    warned = re.findall(r"Key '([^']+)' appears in multiple", capfd.readouterr().err)
    assert set(warned) <= {'serialized_metadata', 'lost', 'setpoints'}
