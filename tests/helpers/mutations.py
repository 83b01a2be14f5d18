"""Documents with one value changed: what a damaged or hostile file may hold."""

import copy
import random
from typing import Any

JUNK = (None, True, -1, 0, 10**9, 10**30, 1.5, float("nan"), "", "x", [], [1], [[]], {}, {"x": 1})


def nest(levels: int = 200) -> list:
    """A list in a list, and so on."""
    value: list = []
    for _ in range(levels):
        value = [value]
    return value


def list_places(value: Any, place: tuple = ()) -> list[tuple]:
    """The paths of all values in a document, by keys and indices; the whole is ()."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list | tuple) else ()
    return [place, *(inner for key, held in items for inner in list_places(held, (*place, key)))]


def mutate(document: Any, draw: random.Random, junk: tuple = (*JUNK, nest())) -> Any:
    """Replace a value somewhere in a document, or leave it out; returns a changed copy."""
    place = draw.choice(list_places(document))
    other = draw.choice(junk)
    if not place:
        return other
    changed = copy.deepcopy(document)
    held = changed
    path: list = []
    for key in place[:-1]:
        path.append((held, key))
        held = held[key]
    if isinstance(held, tuple):
        parent, key = path[-1]
        held = parent[key] = list(held)
    if draw.random() < 0.2:
        del held[place[-1]]
    else:
        held[place[-1]] = other
    return changed
