"""Who may find our nodes."""

import os

import pytest

from hmsa_ros.discovery import keep_to_host, RANGE

OTHERS = ('ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY')


@pytest.fixture(autouse=True)
def undecided(monkeypatch):
    for name in (RANGE, *OTHERS):
        monkeypatch.setenv(name, '')
    return monkeypatch


def test_nodes_stay_on_the_host_where_nothing_else_is_said(monkeypatch):
    keep_to_host()
    assert os.environ[RANGE] == 'LOCALHOST'


def test_who_asks_for_the_subnet_gets_it(monkeypatch):
    monkeypatch.setenv(RANGE, 'SUBNET')
    keep_to_host()
    assert os.environ[RANGE] == 'SUBNET'


@pytest.mark.parametrize('name', OTHERS)
def test_who_names_others_is_left_alone(monkeypatch, name):
    monkeypatch.setenv(name, '1')
    keep_to_host()
    assert not os.environ[RANGE]
