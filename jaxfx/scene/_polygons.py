"""Polygons cut into triangles."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int


def triangulate(
    points: Float[np.ndarray, "corner 3"], sizes: Sequence[int] | Int[np.ndarray, " polygon"]
) -> tuple[Int[np.ndarray, "triangle 3"], Int[np.ndarray, " triangle"], int]:
    """Polygons, `sizes` corners each, as triangles of their corners.

    A polygon is seen along its normal. A fan from its first corner will do where no triangle
    of the fan is turned over; else ears are cut off one by one. Gives the triangles as indices
    of `points`, each triangle's polygon, and how many polygons cross themselves: those have no
    right triangles, and are cut into fans.

    Source: Newell's normal (Sutherland, Sproull & Schumacker 1974); ears (Meisters 1975).
    """
    sizes = np.asarray(sizes, np.intp)
    starts = np.cumsum(sizes) - sizes
    triangles, owners, crossing = [], [], 0
    for size in np.unique(sizes):
        polygon = np.flatnonzero(sizes == size)
        corner = starts[polygon, None] + np.arange(size)
        fan = np.stack(
            [np.zeros(size - 2, np.intp), *(np.arange(size - 2) + i for i in (1, 2))]
        )
        cut = np.broadcast_to(fan.T, (len(polygon), size - 2, 3))
        if size > 3:
            flat = _flattened(points[corner])
            cut = cut.copy()
            for index in np.flatnonzero(_is_turned_over(flat)):
                ears = _ears(flat[index])
                crossing += ears is None
                cut[index] = fan.T if ears is None else ears
        triangles.append((corner[:, 0, None, None] + cut).reshape(-1, 3))
        owners.append(np.repeat(polygon, size - 2))
    if not triangles:
        return np.zeros((0, 3), np.intp), np.zeros(0, np.intp), 0
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order], crossing


def _flattened(corners: Float[np.ndarray, "polygon n 3"]) -> Float[np.ndarray, "polygon n 2"]:
    """The corners in the plane of each polygon, counter-clockwise."""
    local = corners - corners[:, :1]
    normal = np.cross(local, np.roll(local, -1, axis=1)).sum(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
    aside = np.eye(3)[np.abs(normal).argmin(axis=1)]
    right = np.cross(aside, normal)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    axes = np.stack([right, np.cross(normal, right)], axis=1)
    return np.einsum("pnk,pik->pni", local, axes)


def _is_turned_over(flat: Float[np.ndarray, "polygon n 2"]) -> Bool[np.ndarray, " polygon"]:
    first, second, third = flat[:, :1], flat[:, 1:-1], flat[:, 2:]
    area = _area(first, second, third)
    return (area < -1e-12 * np.abs(area).sum(axis=1, keepdims=True)).any(axis=1)


def _area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the area of triangles, positive where they are counter-clockwise."""
    (x1, y1), (x2, y2) = np.moveaxis(b - a, -1, 0), np.moveaxis(c - a, -1, 0)
    return x1 * y2 - x2 * y1


def _ears(flat: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "triangle 3"] | None:
    """Triangles of a polygon that does not cross itself; None for one that does."""
    left = list(range(len(flat)))
    found = []
    while len(left) > 3:
        ring = flat[left]
        before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
        turn = _area(before, ring, after)
        at = _first_ear(before, ring, after, turn)
        if at is None:
            return None
        found.append([left[at - 1], left[at], left[(at + 1) % len(left)]])
        del left[at]
    found.append(left)
    area = _area(*(flat[[each[i] for each in found]] for i in range(3)))
    whole = np.abs(area).sum()
    return np.array(found) if (area >= -1e-9 * whole).all() else None


def _first_ear(
    before: Float[np.ndarray, "n 2"],
    ring: Float[np.ndarray, "n 2"],
    after: Float[np.ndarray, "n 2"],
    turn: Float[np.ndarray, " n"],
) -> int | None:
    """The first corner whose triangle holds no other corner.

    Corners at the same place as the triangle's own do not count: an edge to a hole in the
    polygon is walked there and back.
    """
    reflex = np.flatnonzero(turn <= 0)
    for at in np.flatnonzero(turn > 0):
        a, b, c = before[at], ring[at], after[at]
        others = ring[reflex]
        own = [(others == each).all(axis=1) for each in (a, b, c)]
        others = others[~np.any(own, axis=0)]
        sides = (_area(a, b, others), _area(b, c, others), _area(c, a, others))
        if not np.all(np.array(sides) >= 0, axis=0).any():
            return int(at)
    level = np.flatnonzero(turn == 0)
    return int(level[0]) if len(level) else None
