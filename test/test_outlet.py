"""Publishing while other threads are running."""

from itertools import count
from threading import Event, Thread

import pytest
from rclpy.exceptions import InvalidHandle
from rclpy.serialization import serialize_message
from std_msgs.msg import Float64, UInt8MultiArray

from hmsa_ros.nodes.capture import FastPublisher

_LARGE = 30_000_000
_TIMES = 50


@pytest.mark.ros
def test_what_is_published_arrives_and_other_threads_run_meanwhile(ros):
    received = ros.collect(Float64, 'small')
    small = FastPublisher(ros.publisher(Float64, 'small'))
    small.publish(Float64(data=1.5))
    small.publish(serialize_message(Float64(data=2.5)))
    ros.spin_until(lambda: len(received) == 2, 'both messages')
    assert [x.data for x in received] == [1.5, 2.5]

    ticks, ended = count(), Event()
    ros.node.create_subscription(UInt8MultiArray, 'large', lambda _: None, 1)
    large = FastPublisher(ros.publisher(UInt8MultiArray, 'large', 1))
    message = serialize_message(UInt8MultiArray(data=bytes(_LARGE)))

    def run():
        while not ended.wait(1e-4):
            next(ticks)

    Thread(target=run).start()
    ran = tried = 0
    # On a busy machine the other thread may have no core at times.
    while ran < 3 and tried < _TIMES:
        before = next(ticks)
        large.publish(message)
        # More than a switch of threads before or after the call.
        ran += next(ticks) - before > 5
        tried += 1
    ended.set()
    assert ran == 3


@pytest.mark.ros
def test_a_publisher_that_is_gone_is_told(ros):
    publisher = ros.node.create_publisher(Float64, 'gone', 1)
    fast = FastPublisher(publisher)
    ros.node.destroy_publisher(publisher)
    with pytest.raises(InvalidHandle):
        fast.publish(Float64())
