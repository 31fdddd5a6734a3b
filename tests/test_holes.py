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


SIDES = ((-1, 0), (0, -1), (0, 1), (1, 0))


def texture_by_loops(shown):
    """The mean step to the sides, and its mean over 3 x 3, the frame's own pixels repeated."""
    height, width, _ = shown.shape
    held = lambda j, i: (min(max(j, 0), height - 1), min(max(i, 0), width - 1))
    steps, means = np.zeros((2, height, width))
    for at in np.ndindex(height, width):
        sides = [shown[held(at[0] + dj, at[1] + di)] for dj, di in SIDES]
        steps[at] = np.mean([np.mean(np.abs(shown[at] - side)) for side in sides])
    for j, i in np.ndindex(height, width):
        means[j, i] = np.mean(
            [steps[held(j + a, i + b)] for a in (-1, 0, 1) for b in (-1, 0, 1)]
        )
    return means


def sources_by_dijkstra(depth, guide, expected):
    """The sources of all the cheapest paths to each pixel, by a queue."""
    height, width = depth.shape
    shown, longer = np.sqrt(guide), max(height, width)
    texture = texture_by_loops(shown)
    is_known = ~np.isnan(depth)
    costs = np.where(is_known, 0, 10**9)
    sources = {at: {i} for i, at in enumerate(np.ndindex(depth.shape))}
    queue = [(0, *at) for at in np.argwhere(is_known)]
    while queue:
        cost, j, i = heapq.heappop(queue)
        if cost > costs[j, i]:
            continue
        for dj, di in SIDES:
            there = j + dj, i + di
            if not (0 <= there[0] < height and 0 <= there[1] < width):
                continue
            change = np.mean(np.abs(shown[j, i] - shown[there]))
            step = 1 + 2 * longer * max(change - min(texture[j, i], texture[there]), 0)
            if is_known[j, i]:
                step += 0.4 * longer * (expected[there] > 1.1 * depth[j, i])
            total = cost + int(np.rint(64 * step))
            if total < costs[there]:
                costs[there], sources[there] = total, set(sources[j, i])
                heapq.heappush(queue, (total, *there))
            elif total == costs[there]:
                sources[there] |= sources[j, i]
    return sources


@pytest.mark.parametrize("seed", range(4))
def test_cheapest_sources(seed):
    rng = np.random.default_rng(seed)
    depth = holed(seed, share=0.9)
    guide, expected = rng.uniform(size=(9, 11, 2)), rng.uniform(1, 9, (9, 11))
    found = _holes.cheapest_sources(*map(jnp.asarray, (depth, guide, expected)))
    for at, sources in sources_by_dijkstra(depth, guide, expected).items():
        assert int(found[at]) in sources


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("share", [0.3, 0.97])
def test_the_pixels_of_a_source_hang_together(share, dtype):
    """By their sides, whatever the ties: so no filled pixel stands alone."""
    rng = np.random.default_rng(5)
    size = 24, 31
    depth = rng.choice([1, 1.5, 4], size)
    depth[rng.uniform(size=size) < share] = NAN
    guide = rng.choice([0.2, 0.21, 0.7], (*size, 1))
    arrays = (depth, guide, np.full(size, 3.0))
    found = np.asarray(_holes.cheapest_sources(*(jnp.asarray(a, dtype) for a in arrays)))
    for source in np.unique(found):
        reached = np.zeros(size, bool)
        reached.reshape(-1)[source] = True
        for _ in range(depth.size):
            padded = np.pad(reached, 1)
            beside = [padded[1 + j : j + 25, 1 + i : i + 32] for j, i in SIDES]
            grown = (found == source) & np.logical_or.reduce([reached, *beside])
            if (grown == reached).all():
                break
            reached = grown
        np.testing.assert_array_equal(reached, found == source)


def test_a_path_round_a_wall():
    """Through the gap below a wall that the guide shows, not over the wall."""
    walls = np.zeros((5, 9))
    walls[:4, 4] = 1
    depth = np.full((5, 9), NAN)
    depth[0, 3], depth[0, 4] = 2, 3
    guide, expected = jnp.asarray(walls[..., None]), jnp.full((5, 9), 1.0)
    found = _holes.cheapest_sources(jnp.asarray(depth), guide, expected)
    np.testing.assert_array_equal(found, np.where(walls == 1, 4, 3))
