"""The twin of a bench supply: the SCPI commands that a source of current needs."""

from collections import deque

from hmsa_ros.device.line import SimulatedLine


class SimulatedSupply(SimulatedLine):
    """A bipolar supply of 10 A and its line."""

    limit, step = 10.0, 10.0 / 2**15

    def __init__(self, rest: str = '') -> None:
        super().__init__()
        self.restart()
        self._text = ''

    def restart(self) -> None:
        """Switch it on: as a source of voltage, with its output off."""
        self.current, self.on, self.mode = 0.0, False, 'VOLT'
        self._errors: deque[str] = deque()

    def _obey(self, command: str) -> str | None:
        """Carry a command out; return its answer, if it has one."""
        verb, _, value = command.strip().lstrip(':').upper().partition(' ')
        if verb == '*IDN?':
            return 'hmsa_ros, simulated supply, 0, 1'
        if verb == 'CURR?':
            return f'{self.limit if value == "MAX" else self.current:.6g}'
        if verb == 'OUTP?':
            return str(int(self.on))
        if verb == 'SYST:ERR?':
            return self._errors.popleft() if self._errors else '0,"No error"'
        if verb == '*CLS':
            self._errors.clear()
        elif verb == 'OUTP':
            self.on = value in ('ON', '1')
        elif verb == 'FUNC:MODE' and value in ('CURR', 'VOLT'):
            self.mode = value
        elif verb in ('CURR', 'VOLT'):
            self._set(verb, value)
        else:
            self._errors.append('-113,"Undefined header"')
        return None

    def _set(self, verb: str, value: str) -> None:
        try:
            number = float(value)
        except ValueError:
            self._errors.append('-104,"Data type error"')
            return
        if verb == 'CURR' and not abs(number) <= self.limit:
            self._errors.append('-222,"Data out of range"')
        elif verb == 'CURR':
            self.current = round(number / self.step) * self.step

    # -- the port ------------------------------------------------------------------------------

    def write(self, text: bytes) -> None:
        """Take bytes from the host."""
        *lines, self._text = (self._text + text.decode('ascii', 'replace')).split('\n')
        for line in lines:
            answers = [x for x in map(self._obey, line.split(';')) if x is not None]
            if answers:
                self._answer += f'{";".join(answers)}\n'.encode()

    def close(self) -> None:
        """Leave the line."""
