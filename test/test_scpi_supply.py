"""A bench supply with SCPI commands: in memory, and over TCP with line faults."""

import socket
from threading import Thread

from extras import needs
import pytest

from hmsa_lab.bench.scpi_supply import ScpiSupply, SimulatedSupply, Supply, SupplyError
from hmsa_ros.device.watchdog import Fallback, Kind
from hmsa_ros.device.worker import HardwareDevice, HardwareJoint

START = 10**18


def serve(supply, server, spoil):
    """Serve one host at a time; `spoil` may change an answer."""
    while True:
        try:
            line, _ = server.accept()
        except OSError:
            return
        with line:
            while text := line.recv(1000):
                supply.write(text)
                line.sendall(spoil(supply.read(10_000)))


@pytest.fixture
def tcp():
    """Return a supply, its port, and a list whose entries each modify one answer."""
    supply, faults = SimulatedSupply(), []
    server = socket.create_server(('127.0.0.1', 0))
    thread = Thread(daemon=True, target=serve, args=(
        supply, server, lambda x: faults.pop()(x) if faults else x))
    thread.start()
    yield supply, f'socket://127.0.0.1:{server.getsockname()[1]}', faults
    server.shutdown(socket.SHUT_RDWR)
    server.close()


def test_a_supply_sets_currents_that_its_driver_confirms_and_is_off_in_the_end(tcp):
    needs('serial')
    simulated, port, faults = tcp
    simulated.on, simulated.current = True, 3.0
    hardware = ScpiSupply('a', port, **{'coil.tesla_per_ampere': 0.05})
    assert (simulated.mode, simulated.current, simulated.on) == ('CURR', 0.0, True)
    device = HardwareDevice([HardwareJoint(hardware, 1.0, Fallback(0.0))], time=START)
    assert device.switch_off(START) == ''
    assert device.coils[0].limit == pytest.approx(0.5)
    # An answer that is damaged is asked for again.
    faults += [lambda x: b'\xff' + x[:3] + b'\n']
    device.receive(0, 0, 0.2)
    device.advance(START + 1)
    assert device.coils[0].level == pytest.approx(0.2, abs=1e-4)
    assert simulated.current == pytest.approx(4.0, abs=1e-3)
    assert device.counts['saturated'] == 0
    assert device.switch_off(START + 2) == device.close() == ''
    again = Supply(port)
    assert simulated.current == 0.0
    again.close()


def test_a_supply_that_was_switched_off_is_put_on_again_without_a_current():
    hardware = ScpiSupply('a', 'sim', **{'coil.tesla_per_ampere': 0.05})
    device = HardwareDevice([HardwareJoint(hardware, 1.0, Fallback(0.0))], time=START)
    assert device.switch_off(START) == ''
    hardware.source._line.restart()
    device.receive(0, 0, 0.2)
    device.advance(START + 1)
    (notice,) = [x for x in device.notices() if x.kind == Kind.LOST]
    assert 'the output of the supply on sim was off' in notice.text
    simulated = hardware.source._line
    assert (simulated.mode, simulated.current, simulated.on) == ('CURR', 0.0, True)


def test_what_a_supply_refuses_or_does_not_understand_is_said(tcp, monkeypatch):
    needs('serial')
    simulated, port, faults = tcp
    supply = Supply(port)
    with pytest.raises(SupplyError, match='refuses CURR 11 .error -222 "Data out of range"'):
        supply.write(11.0, 0)
    monkeypatch.setattr('hmsa_lab.bench.scpi_supply._PATIENCE', 0.05)
    faults += [lambda x: b'hello\n'] * 100_000
    with pytest.raises(SupplyError, match="answers 'hello' to CURR 1;:CURR"):
        supply.write(1.0, 0)
    supply.close()
