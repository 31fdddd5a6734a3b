"""Polygons cut into triangles."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int


# A clockwise triangle smaller than this, relative to the area of all triangles, is rounding. A
# smaller number would clip the ears of convex polygons with nearly collinear corners, a larger
# one would leave fans that fold over. Ears, which are cut from one another, round more.
_FAN_ROUNDING = 1e-12
_EAR_ROUNDING = 1e-9


def triangulate(
    points: Float[np.ndarray, "corner 3"], sizes: Sequence[int] | Int[np.ndarray, " polygon"]
) -> tuple[Int[np.ndarray, "triangle 3"], Int[np.ndarray, " triangle"], int]:
    """Cut polygons, of `sizes` consecutive points each, into triangles.

    Each polygon is projected along its normal. It becomes a fan from its first corner, unless
    a triangle of the fan is turned over: then ears are clipped one by one.

    Returns the triangles as indices into `points`, the polygon of each triangle, and how many
    polygons intersect themselves. Those have no triangulation, and are cut into fans.

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
            projected = _projected(points[corner])
            cut = cut.copy()
            for index in np.flatnonzero(_has_turned_triangle(projected)):
                ears = _clipped_ears(projected[index])
                crossing += ears is None
                cut[index] = fan.T if ears is None else ears
        triangles.append((corner[:, 0, None, None] + cut).reshape(-1, 3))
        owners.append(np.repeat(polygon, size - 2))
    if not triangles:
        return np.zeros((0, 3), np.intp), np.zeros(0, np.intp), 0
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order], crossing


def _projected(corners: Float[np.ndarray, "polygon n 3"]) -> Float[np.ndarray, "polygon n 2"]:
    """The corners in the plane of each polygon, in which they run counter-clockwise."""
    local = corners - corners[:, :1]
    normal = np.cross(local, np.roll(local, -1, axis=1)).sum(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    right = np.cross(axis, normal)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    axes = np.stack([right, np.cross(normal, right)], axis=1)
    return np.einsum("pnk,pik->pni", local, axes)


def _has_turned_triangle(
    corners: Float[np.ndarray, "polygon n 2"],
) -> Bool[np.ndarray, " polygon"]:
    """Whether the fan from a polygon's first corner has a clockwise triangle."""
    area = _double_area(corners[:, :1], corners[:, 1:-1], corners[:, 2:])
    total = np.abs(area).sum(axis=1, keepdims=True)
    return (area < -_FAN_ROUNDING * total).any(axis=1)


def _double_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the area of triangles, positive where they are counter-clockwise."""
    (x1, y1), (x2, y2) = np.moveaxis(b - a, -1, 0), np.moveaxis(c - a, -1, 0)
    return x1 * y2 - x2 * y1


def _clipped_ears(corners: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "triangle 3"] | None:
    """Triangles of one polygon by ear clipping; None where it intersects itself."""
    remaining = list(range(len(corners)))
    triangles = []
    while len(remaining) > 3:
        ring = corners[remaining]
        before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
        turn = _double_area(before, ring, after)
        ear = _first_ear(before, ring, after, turn)
        if ear is None:
            return None
        next_corner = remaining[(ear + 1) % len(remaining)]
        triangles.append([remaining[ear - 1], remaining[ear], next_corner])
        del remaining[ear]
    triangles.append(remaining)
    cut = np.array(triangles)
    area = _double_area(*(corners[cut[:, i]] for i in range(3)))
    return cut if (area >= -_EAR_ROUNDING * np.abs(area).sum()).all() else None


def _first_ear(
    before: Float[np.ndarray, "n 2"],
    ring: Float[np.ndarray, "n 2"],
    after: Float[np.ndarray, "n 2"],
    turn: Float[np.ndarray, " n"],
) -> int | None:
    """The index in `ring` of the first corner whose triangle contains no other corner.

    `turn` is positive at convex corners. Corners that coincide with one of the triangle's do
    not count: an outline that cuts to a hole passes the same points twice. If there is no such
    corner, the first on a straight line is taken.
    """
    reflex = np.flatnonzero(turn <= 0)
    for corner in np.flatnonzero(turn > 0):
        a, b, c = before[corner], ring[corner], after[corner]
        others = ring[reflex]
        coincides = [(others == vertex).all(axis=1) for vertex in (a, b, c)]
        others = others[~np.any(coincides, axis=0)]
        sides = [_double_area(*edge, others) for edge in ((a, b), (b, c), (c, a))]
        if not np.all(np.array(sides) >= 0, axis=0).any():
            return int(corner)
    straight = np.flatnonzero(turn == 0)
    return int(straight[0]) if len(straight) else None
