"""Holes against SciPy's exact distances."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxfx import GBuffer, relight


SIZE = (19, 26)


def numbered(size=SIZE, shader=None):
    """A cache that says in every field which pixel it is."""
    index = np.arange(size[0] * size[1], dtype=float).reshape(size)
    vector = np.repeat(index[..., None], 3, axis=-1)
    shader = index.astype(np.int32) % 3 if shader is None else shader
    return GBuffer(
        vector, shader, vector, vector, vector, vector, 1 + index, index / index.size
    )


def holes(kind):
    rng = np.random.default_rng(1)
    return {
        "few": (rng.random(SIZE) > 0.05).astype(int),
        "many": (rng.random(SIZE) > 0.97).astype(int),
        "block": 2 - 2 * np.pad(np.ones((13, 17), int), ((4, 2), (3, 6))),
        "one-pixel-left": np.eye(1, SIZE[0] * SIZE[1], 77, dtype=int).reshape(SIZE),
        "left-column": np.repeat(np.eye(1, SIZE[1], dtype=int), SIZE[0], axis=0),
        "none": np.ones(SIZE, int),
    }[kind]


@pytest.mark.parametrize(
    "kind", ["few", "many", "block", "one-pixel-left", "left-column", "none"]
)
def test_is_the_nearest_covered_pixel(kind):
    views = holes(kind)
    gbuffer = numbered()
    filled, count = relight.fill_holes(gbuffer, views)
    assert int(count) == (views == 0).sum()
    source = np.rint(np.asarray(filled.roughness) * views.size).astype(int)
    row, column = np.divmod(source, SIZE[1])
    y, x = np.indices(SIZE)
    np.testing.assert_allclose(
        np.hypot(row - y, column - x), ndimage.distance_transform_edt(views == 0), atol=1e-12
    )
    assert (views[row, column] > 0).all()
    for name in ("color", "ambient", "diffuse", "specular", "normal"):
        assert (np.asarray(getattr(filled, name)) == source[..., None]).all()
    assert (np.asarray(filled.shader) == source % 3).all()
    np.testing.assert_array_equal(filled.depth, gbuffer.depth)


def test_background_is_neither_filled_nor_taken_from():
    depth = np.full(SIZE, 2.0)
    depth[:, :20] = np.inf
    views = np.where(np.isfinite(depth), 1, 0)
    views[5, 20:23] = 0
    shader = np.where(views > 0, 1, -1)
    gbuffer = numbered(shader=shader)
    gbuffer = GBuffer(**{**vars(gbuffer), "depth": depth})
    filled, count = relight.fill_holes(gbuffer, views)
    assert int(count) == 3
    np.testing.assert_array_equal(filled.shader, np.where(np.isfinite(depth), 1, -1))


def test_nothing_covered_leaves_everything():
    gbuffer = numbered()
    filled, count = relight.fill_holes(gbuffer, np.zeros(SIZE, int))
    assert int(count) == 0
    np.testing.assert_array_equal(filled.color, gbuffer.color)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1)])
def test_any_size(size):
    views = np.zeros(size, int)
    views[-1, -1] = 3
    filled, count = relight.fill_holes(numbered(size), views)
    assert int(count) == size[0] * size[1] - 1
    assert (np.asarray(filled.color) == size[0] * size[1] - 1).all()


def test_a_filled_pixel_has_the_derivative_of_the_one_it_was_taken_from():
    views = np.ones(SIZE, int)
    views[3:6, 7] = 0
    gbuffer = numbered()

    def red(color):
        changed = GBuffer(**{**vars(gbuffer), "color": color})
        return relight.fill_holes(changed, views)[0].color

    weight = np.random.default_rng(2).random((*SIZE, 3))
    (pulled,) = jax.vjp(red, gbuffer.color)[1](jnp.asarray(weight))
    _, pushed = jax.jvp(red, (gbuffer.color,), (gbuffer.color,))
    np.testing.assert_array_equal(pushed, red(gbuffer.color))
    assert (np.asarray(pulled)[3:6, 7] == 0).all()
    assert np.asarray(pulled).sum() == pytest.approx(weight.sum())


def test_errors_name_the_argument():
    fill = inspect.unwrap(relight.fill_holes)
    with pytest.raises(ValueError, match=r"`fill_holes\(views\)` must have the cache's"):
        fill(numbered(), np.ones((2, 2), int))
