"""Polygons into triangles, against areas by the shoelace formula and points in the plane."""

import numpy as np
import pytest
from skimage.measure import points_in_poly

from jaxfx.scene.formats._polygons import triangulate


def shoelace(polygon):
    x, y = np.asarray(polygon, float).T
    return abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2


def cut(polygon, turn=None):
    """The triangles' corners in the plane, and how many polygons intersect themselves."""
    flat = np.asarray(polygon, float)
    points = np.pad(flat, ((0, 0), (0, 1))) @ (np.eye(3) if turn is None else turn)
    triangles, owner, crossing = triangulate(points, [len(points)])
    assert len(triangles) == len(points) - 2
    np.testing.assert_array_equal(owner, 0)
    return flat[triangles], crossing


def area(triangles):
    return sum(shoelace(triangle) for triangle in triangles)


L_SHAPE = [(2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 0)]
ARROW = [(0, 0), (2, 1), (0, 2), (1, 1)]
RING = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]
COMB = [(0, 0), (9, 0), (9, 2)] + [(x, y) for i in range(4) for x, y in
                                   ((8 - 2 * i, 1), (7 - 2 * i, 2))] + [(0, 2)]  # fmt: skip


@pytest.mark.parametrize("polygon", [L_SHAPE, ARROW, RING, COMB])
@pytest.mark.parametrize("start", [0, 1, 3])
@pytest.mark.parametrize("order", [1, -1])
def test_concave_polygons_keep_their_area(polygon, start, order):
    turned = np.roll(polygon, start, axis=0)[::order]
    triangles, crossing = cut(turned)
    expected = 12 if polygon is RING else shoelace(polygon)
    assert crossing == 0
    assert area(triangles) == pytest.approx(expected)


def test_random_stars_seen_from_any_side():
    random = np.random.default_rng(1)
    for _ in range(60):
        count = random.integers(4, 25)
        angle = np.sort(random.uniform(0, 2 * np.pi, count))
        if np.diff([*angle, angle[0] + 2 * np.pi]).max() > np.pi:
            continue
        radius = random.uniform(0.1, 1, count)
        star = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        triangles, crossing = cut(star, turn)
        assert crossing == 0
        assert area(triangles) == pytest.approx(shoelace(star))
        inside = np.array([triangle.mean(axis=0) for triangle in triangles])
        large = [shoelace(triangle) > 1e-9 for triangle in triangles]
        assert points_in_poly(inside[large], star).all()


def test_triangles_keep_the_polygons_front():
    triangles, _ = cut(L_SHAPE)
    ab, ac = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    assert (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0] >= 0).all()


def test_level_corners_and_corners_twice():
    assert area(cut([(0, 0), (1, 0), (2, 0), (2, 2), (1, 1), (0, 2)])[0]) == pytest.approx(3)
    assert area(cut([*L_SHAPE, L_SHAPE[-1]])[0]) == pytest.approx(3)
    assert area(cut([(0, 0), (1, 1), (2, 2), (3, 3)])[0]) == pytest.approx(0)


def test_a_polygon_that_crosses_itself_is_counted():
    assert cut([(0, 0), (2, 2), (2, 0), (0, 2)])[1] == 1
    star = [(np.cos(4 * np.pi * i / 5), np.sin(4 * np.pi * i / 5)) for i in range(5)]
    assert cut(star)[1] == 1


def test_many_polygons_of_many_sizes_stay_in_order():
    polygons = [L_SHAPE, [(0, 0), (1, 0), (0, 1)], ARROW, L_SHAPE[::-1]]
    points = np.concatenate([np.pad(np.array(p, float), ((0, 0), (0, 1))) for p in polygons])
    triangles, owner, crossing = triangulate(points, [len(polygon) for polygon in polygons])
    assert crossing == 0
    np.testing.assert_array_equal(owner, [0] * 4 + [1] + [2] * 2 + [3] * 4)
    for index, polygon in enumerate(polygons):
        found = area(points[triangles[owner == index]][..., :2])
        assert found == pytest.approx(shoelace(polygon))
