"""Short words for axes and points of a sweep, each told from the others."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

REPLICATE = "particles.seed"  # points that differ in this alone are replicates
WORDS = {"packing_density": "density", "std_radius": "spread", "mean_radius": "radius", "surface_factor": "surface"}
DIGITS = (3, 4, 6, 9, 17)  # significant, the fewest that tell values apart


def words(keys: Sequence[str]) -> dict[str, str]:
    """A short word for each dotted key: its last part, or as much more as the others ask for."""
    last = {key: key.rsplit(".", 1)[-1] for key in keys}
    short = {key: WORDS.get(name, name.replace("_", " ")) for key, name in last.items()}
    for longer in (last, {key: key.replace("_", " ") for key in keys}):
        often = Counter(short.values())
        short = {key: word if often[word] == 1 else longer[key].replace("_", " ") for key, word in short.items()}
    return short


def spelled(value: Any, digits: int = 6) -> str:
    """A value of an axis; long lists are cut."""
    if isinstance(value, bool) or value is None:
        return "-" if value is None else str(value).lower()
    text = f"{value:.{digits}g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def labels(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """A label for each point, from its values along the axes in which the points differ: "density 0.65, spread 0.5".

    Where values come again, a number tells the points apart.
    """
    keys = differing(points)
    named = words(keys)
    columns = {key: _column([point.get(key) for point in points]) for key in keys}
    found = [", ".join(f"{named[key]} {columns[key][k]}" for key in keys) for k in range(len(points))]
    often, seen = Counter(found), Counter[str]()
    for k, label in enumerate(found):
        if often[label] > 1:
            seen[label] += 1
            found[k] = f"{label} ({seen[label]})".strip()
    return found


def differing(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """The keys, but for the replicate's, whose values are not the same at all points."""
    keys = dict.fromkeys(key for point in points for key in point if key != REPLICATE)
    return [key for key in keys if len({repr(point.get(key)) for point in points}) > 1]


def _column(values: Sequence[Any]) -> list[str]:
    """The values in as few digits as tell them apart."""
    different = len({repr(value) for value in values})
    for digits in DIGITS:
        found = [spelled(value, digits) for value in values]
        if len(set(found)) >= different:
            break
    return found
