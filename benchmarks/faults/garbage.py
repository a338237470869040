"""Garbage for topics and services: valid messages with wild values, and broken encodings."""

from importlib import import_module
import math
import random
from typing import Any

from rclpy.serialization import serialize_message
from rosidl_parser.definition import (
    AbstractNestedType,
    AbstractString,
    Array,
    BasicType,
    NamespacedType,
)

_NUMBERS = (
    0.0, -0.0, 1.0, 1.1, -1.0, 0.25, 2.69, 1e-320, 1e-9, 1e9, 1e300, -1e300, math.nan, math.inf,
    -math.inf)
_WORDS = (
    '', 'actuator', 'nobody', '\x00', '\n', '../../etc/passwd', '%s%n', '{0}', 'a' * 4096,
    '\u2603', 'use_sim_time', 'flux_density_max')
_WIDTHS = {
    'int8': (-2**7, 2**7 - 1), 'uint8': (0, 2**8 - 1), 'octet': (0, 255), 'char': (0, 255),
    'int16': (-2**15, 2**15 - 1), 'uint16': (0, 2**16 - 1), 'int32': (-2**31, 2**31 - 1),
    'uint32': (0, 2**32 - 1), 'int64': (-2**63, 2**63 - 1), 'uint64': (0, 2**64 - 1)}
_LENGTHS = (0, 0, 1, 1, 1, 2, 3, 50)


def message(kind: type[Any], dice: random.Random) -> Any:
    """Return a message, or a service request, with random extreme values."""
    made = kind()
    for name, slot in zip(kind.get_fields_and_field_types(), kind.SLOT_TYPES, strict=True):
        setattr(made, name, _value(slot, dice))
    return made


def encoding(kind: type[Any], dice: random.Random) -> bytes:
    """Return bytes that are not a valid message, or not the intended one."""
    whole = bytearray(serialize_message(message(kind, dice)))
    choice = dice.randrange(4)
    if choice == 0:
        return bytes(whole[:4 + dice.randrange(max(len(whole) - 4, 1))])
    if choice == 1:
        return bytes(whole[:4]) + dice.randbytes(dice.randrange(1, 300))
    if choice == 2:
        return bytes(whole) + dice.randbytes(64)
    for _ in range(4):
        whole[dice.randrange(4, len(whole))] = dice.randrange(256)
    return bytes(whole)


def _value(slot: Any, dice: random.Random) -> Any:
    """Return an extreme value of one field."""
    if isinstance(slot, NamespacedType):
        module = import_module('.'.join(slot.namespaces))
        return message(getattr(module, slot.name), dice)
    if isinstance(slot, AbstractString):
        return dice.choice(_WORDS)
    if isinstance(slot, AbstractNestedType):
        count = slot.size if isinstance(slot, Array) else dice.choice(_LENGTHS)
        values = [_value(slot.value_type, dice) for _ in range(count)]
        basic = slot.value_type
        if isinstance(basic, BasicType) and basic.typename == 'octet':
            return [bytes([x[0]]) for x in values]
        return values
    assert isinstance(slot, BasicType)
    if slot.typename in ('float', 'double'):
        number = dice.choice(_NUMBERS) if dice.random() < 0.7 else dice.gauss(0.0, 2.0)
        return number if slot.typename == 'double' or abs(number) < 1e38 \
            or not math.isfinite(number) else 1.0
    if slot.typename == 'boolean':
        return dice.random() < 0.5
    low, high = _WIDTHS[slot.typename]
    # Nanoseconds above one second are garbage that a message can carry; the class accepts them.
    number = dice.choice((low, high, 0, 1, dice.randint(low, high)))
    return bytes([number]) if slot.typename == 'octet' else number
