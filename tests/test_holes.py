"""Which pixel is copied, against the same searches in plain loops."""

import heapq

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import _holes


NAN = np.nan


def holed(seed, size=(9, 11), share=0.6):
    rng = np.random.default_rng(seed)
    values = rng.uniform(1, 9, size)
    values[rng.uniform(size=size) < share] = NAN
    values[size[0] // 2] = NAN
    return values


def farther_by_loops(depth):
    """In each gap of a row, then of a column, the index of its farther end."""
    source = np.arange(depth.size).reshape(depth.shape)
    values = depth.copy()
    for values_view, source_view in ((values, source), (values.T, source.T)):
        for row, indices in zip(values_view, source_view, strict=True):
            known = np.flatnonzero(~np.isnan(row))
            for i in np.flatnonzero(np.isnan(row)):
                ends = [*known[known < i][-1:], *known[known > i][:1]]
                if ends:
                    best = max(ends, key=lambda end: row[end])
                    indices[i] = indices[best]
            row[:] = depth.reshape(-1)[indices]
    return source


@pytest.mark.parametrize("seed", range(4))
def test_farther_ends(seed):
    depth = holed(seed)
    found = _holes.farther_ends(jnp.asarray(depth))
    np.testing.assert_array_equal(found, farther_by_loops(depth))


def sources_by_dijkstra(depth, guide, expected):
    """The cheapest path to each pixel from any known one, by a queue."""
    height, width = depth.shape
    shown, longer = np.sqrt(guide), max(height, width)
    is_known = ~np.isnan(depth)
    costs = np.where(is_known, 0, np.inf)
    source = np.arange(depth.size).reshape(depth.shape)
    queue = [(0.0, *at) for at in np.argwhere(is_known)]
    while queue:
        cost, j, i = heapq.heappop(queue)
        if cost > costs[j, i]:
            continue
        for dj in (-1, 0, 1):
            for di in (-1, 0, 1):
                there = j + dj, i + di
                if not (0 <= there[0] < height and 0 <= there[1] < width):
                    continue
                edge = np.mean(np.abs(shown[j, i] - shown[there]))
                step = np.hypot(dj, di) + 1.25 * longer * edge
                if is_known[j, i]:
                    step += 0.25 * longer * max(np.log(expected[there] / depth[j, i]), 0)
                if cost + step < costs[there]:
                    costs[there], source[there] = cost + step, source[j, i]
                    heapq.heappush(queue, (cost + step, *there))
    return source


@pytest.mark.parametrize("seed", range(4))
def test_cheapest_sources(seed):
    rng = np.random.default_rng(seed)
    depth = holed(seed, share=0.9)
    guide, expected = rng.uniform(size=(9, 11, 2)), rng.uniform(1, 9, (9, 11))
    found = _holes.cheapest_sources(*map(jnp.asarray, (depth, guide, expected)), medians=0)
    np.testing.assert_array_equal(found, sources_by_dijkstra(depth, guide, expected))


def test_a_path_round_a_wall():
    """Through the gap below a wall that the guide shows, not over the wall."""
    walls = np.zeros((5, 9))
    walls[:4, 4] = 1
    depth = np.full((5, 9), NAN)
    depth[0, 3], depth[0, 4] = 2, 3
    guide, expected = jnp.asarray(walls[..., None]), jnp.full((5, 9), 1.0)
    found = _holes.cheapest_sources(jnp.asarray(depth), guide, expected, medians=0)
    np.testing.assert_array_equal(found, np.where(walls == 1, 4, 3))


def test_medians_take_back_a_lone_pixel():
    depth = np.array([[2.0] * 5, [2, NAN, NAN, NAN, 2], [2.0] * 5, [2, 2, 9, 2, 2]])
    source = np.arange(20).reshape(4, 5)
    source[1, 1:4] = 0, 17, 4
    found = _holes._median_sources(jnp.asarray(depth), jnp.asarray(source))
    assert depth.reshape(-1)[found[1, 2]] == 2
