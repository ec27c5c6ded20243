"""Mutations of files: bytes cut, flipped, spliced; JSON whose values are what no program expects."""

from __future__ import annotations

import copy
import json
import random
import struct
from typing import Any

EDGES = [struct.pack("<i", value) for value in (0, -1, 1, 2**31 - 1, -(2**31), 65536, 10**9)]
EDGES += [struct.pack("<q", value) for value in (2**62, -1, 2**32)] + [struct.pack("<f", float("nan"))]

ODD_VALUES: list[Any] = [
    None, True, 0, -1, 1e308, -1e308, 10**400, 2**63, float("nan"), float("inf"), 1e-320, "", "x" * 5000,
    "../../../etc/passwd", "/etc/passwd", "..", ".", "a\x00b", "\ud800", "a\nb", [], {}, [[]], [None] * 3,
    {"views": None}, [[1, 0, 0, 0]] * 4, "NaN",
]  # fmt: skip


def mutate_bytes(data: bytes, dice: random.Random) -> bytes:
    """One to eight mutations of one kind: a cut, changed bytes, an edge value, a splice, a swap, zeros."""
    result = bytearray(data)
    kind = dice.randrange(6)
    if kind == 0 or not result:
        return bytes(result[: dice.randrange(len(result) + 1)])
    # Headers decide most: half of all mutations are in the first 512 bytes.
    end = min(len(result), 512) if dice.random() < 0.5 else len(result)
    for _ in range(dice.randint(1, 8)):
        place = dice.randrange(end)
        if kind == 1:
            result[place : place + 1] = bytes([dice.randrange(256)])
        elif kind == 2:
            edge = dice.choice(EDGES)
            result[place : place + len(edge)] = edge
        elif kind == 3:
            result[place : place + dice.randint(0, 16)] = dice.randbytes(dice.randint(0, 16))
        elif kind == 4:
            other, length = dice.randrange(len(result)), dice.randint(1, 64)
            result[place : place + length] = result[other : other + length]
        else:
            length = min(dice.randint(1, 256), len(result) - place)
            result[place : place + length] = bytes(length)
        end = max(1, min(end, len(result)))
        if not result:
            break
    return bytes(result)


def mutate_json(text: str, dice: random.Random) -> bytes:
    """JSON with one to three values replaced, lost or doubled; sometimes not JSON at all, or nested 100,000 deep."""
    if dice.random() < 0.25:
        return mutate_bytes(text.encode(), dice)
    if dice.random() < 0.03:
        return dice.choice([b"[" * 100_000, b'{"a":' * 100_000, b"1" * 100_000, b"\xff\xfe" + text.encode("utf-16-le")])
    value = json.loads(text)
    for _ in range(dice.randint(1, 3)):
        value = _change(value, dice)
    return json.dumps(value).encode("utf-8", "surrogatepass")


def _change(value: Any, dice: random.Random) -> Any:
    value = copy.deepcopy(value)
    inner = value
    # Walk down: the deeper, the more often.
    while isinstance(inner, dict | list) and inner:
        key = dice.choice(list(inner)) if isinstance(inner, dict) else dice.randrange(len(inner))
        child = inner[key]
        if isinstance(child, dict | list) and child and dice.random() < 0.8:
            inner = child
            continue
        action = dice.randrange(4)
        if action == 0 and isinstance(inner, dict):
            del inner[key]
        elif action == 0:
            inner.pop(key)
        elif action == 1 and isinstance(inner, list):
            inner.append(copy.deepcopy(child))
        else:
            inner[key] = copy.deepcopy(dice.choice(ODD_VALUES))
        return value
    return copy.deepcopy(dice.choice(ODD_VALUES))
