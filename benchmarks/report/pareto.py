"""Which method when: fronts of error against time, per map and footprint."""

from __future__ import annotations

#: Tolerated errors (relative L1).
TOLERANCES = (0.2, 0.1, 0.05, 0.02)

#: Errors up to this many times their noise cannot be distinguished from zero.
DETECTABLE = 1.5

#: Times within this factor of the fastest count as equal: for small footprints, all variants of a
#: method run the same code.
AS_FAST = 1.3


def excess(point: dict, metric: str = "l1") -> float:
    """The error of a point, or 0 where it cannot be told from the noise."""
    return point[metric] if point[metric] > DETECTABLE * point[f"noise_{metric}"] else 0.0


def front(points: list[dict], cost: str = "seconds_per_query", metric: str = "l1") -> list[dict]:
    """The points that no other beats in both cost and error, cheapest first."""
    found, best = [], float("inf")
    for point in sorted(points, key=lambda point: (point[cost], excess(point, metric))):
        if excess(point, metric) < best:
            best = excess(point, metric)
            found.append(point)
    return found


def fastest(points: list[dict], tolerance: float) -> dict | None:
    """The fastest point whose error is at most ``tolerance``, the first among equals, or None."""
    allowed = [point for point in points if excess(point) <= tolerance]
    best = min((point["seconds_per_query"] for point in allowed), default=0.0)
    return next((p for p in allowed if p["seconds_per_query"] <= AS_FAST * best), None)


def which_when(units: list[dict]) -> list[dict]:
    """One row per map and footprint: the front, and the fastest method for each tolerance."""
    return [
        {
            "map": unit["map"],
            "radius": unit["radius"],
            "front": [
                {key: point[key] for key in ("method", "seconds_per_query", "l1", "noise_l1")}
                for point in front(unit["points"])
            ],
            "fastest": [
                {
                    "tolerance": tolerance,
                    "method": None if point is None else point["method"],
                    "seconds_per_query": None if point is None else point["seconds_per_query"],
                }
                for tolerance in TOLERANCES
                for point in [fastest(unit["points"], tolerance)]
            ],
        }
        for unit in units
    ]
