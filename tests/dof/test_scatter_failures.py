"""Where scatter fails, with the figure of each failure, and where it must not."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import ThinLens, dof
from tests.helpers.forms import first


PROGRAMS = ("segment_sum", "shift", "tiles", "rows")
WIDTH, EDGE, RADIUS = 41, 20, 6.0
COLUMNS = np.arange(WIDTH) + 0.5 - EDGE  # signed distance of a pixel's centre from the edge


def covered(distance, radius):
    """The share of a disc on the far side of a line at a distance from its centre."""
    s = np.clip(distance / radius, -1, 1)
    return 0.5 - (s * np.sqrt(1 - s * s) + np.arcsin(s)) / np.pi


def edge(left_depth, right_depth, focus, **options):
    """The middle row of a white plane on the left and a black one on the right."""
    image = jnp.where(jnp.arange(WIDTH) < EDGE, 1.0, 0.0)[None, :, None]
    image = jnp.broadcast_to(image, (WIDTH, WIDTH, 1))
    depth = jnp.where(jnp.arange(WIDTH) < EDGE, left_depth, right_depth)[None, :]
    depth = jnp.broadcast_to(depth, (WIDTH, WIDTH))
    blurred = (
        min(left_depth, right_depth)
        if focus == max(left_depth, right_depth)
        else max(left_depth, right_depth)
    )
    lens = ThinLens(1.0, focus, 2 * RADIUS / abs(1 / focus - 1 / blurred))
    return np.asarray(dof.scatter(image, depth, lens, **options))[WIDTH // 2, :, 0]


# Pixels that see neither the frame nor, among near-by ones, a rim cut by rows.
SEEN = (np.abs(COLUMNS) < RADIUS + 1) & (COLUMNS > 0)


@pytest.mark.parametrize("gamma", [0.0, 1.0, 3.0])
def test_blurred_foreground_over_a_sharp_background(gamma):
    """A near plane hides `share` of the lens from a pixel behind its edge, and should give it
    that share of its colour. Scatter gives V share / (1 + V share): up to 1/6 too little
    without amplification, and up to 0.42 too much with a gamma that suits another scene."""
    share = covered(COLUMNS, RADIUS)
    result = edge(1.0, 2.0, 2.0, gamma=gamma, program="shift")
    weight = 2.0**gamma * share
    np.testing.assert_allclose(result[SEEN], (weight / (1 + weight))[SEEN], atol=0.012)
    error = (result - share)[SEEN]
    worst = {0.0: -1 / 6, 1.0: 0.086, 3.0: 0.418}[gamma]  # at shares of 1/2, (sqrt V - 1) / V
    assert error[np.abs(error).argmax()] == pytest.approx(worst, abs=0.03)


@pytest.mark.parametrize(("epsilon", "leak"), [(0.0, 0.0), (2.0, 0.0), (40.0, 0.26)])
def test_sharp_foreground_before_a_blurred_background(epsilon, leak):
    """Background must not leak into what is in focus: none does below the threshold, and with
    an epsilon larger than the blur itself the protection is gone."""
    result = edge(1.0, 2.0, 1.0, epsilon=epsilon, program="shift")
    leaked = (1 - result)[(COLUMNS < 0) & (COLUMNS > -RADIUS)]
    assert leaked.max() == pytest.approx(leak, abs=0.03)
    assert leaked.max() <= leak + 0.03


def test_a_thin_bar_in_focus_keeps_its_colour():
    for bar in (1, 2, 3):
        columns = jnp.arange(WIDTH)
        inside = (columns >= EDGE) & (columns < EDGE + bar)
        image = jnp.broadcast_to(jnp.where(inside, 0.2, 5.0)[None, :, None], (9, WIDTH, 1))
        depth = jnp.broadcast_to(jnp.where(inside, 1.0, jnp.inf)[None, :], (9, WIDTH))
        result = dof.scatter(image, depth, ThinLens(1.0, 1.0, 2 * RADIUS), epsilon=2.0)
        np.testing.assert_allclose(result[:, EDGE : EDGE + bar], 0.2, atol=1e-6)


@pytest.mark.parametrize("peak", [1e2, 1e4, 1e6])
@first("program", PROGRAMS)
@pytest.mark.full
def test_highlights_leave_dim_pixels_alone(program, peak):
    rng = np.random.default_rng(0)
    image = rng.uniform(0.05, 0.2, (48, 48, 3))
    image[20, 24] = peak
    depth = rng.uniform(1.0, 8.0, (48, 48))
    lens = ThinLens(0.1, 2.5, 60.0)
    exact = dof.scatter(jnp.asarray(image), jnp.asarray(depth), lens, program="segment_sum")
    single = dof.scatter(
        jnp.asarray(image, jnp.float32),
        jnp.asarray(depth, jnp.float32),
        lens,
        max_coc=8,
        program=program,
    )
    dim = np.asarray(exact) < 0.2
    assert 0.9 < dim.mean() < 1
    error = np.abs(np.asarray(single) / np.asarray(exact) - 1)[dim]
    assert error.max() < 1e-3
    # No sum of these programs mixes a highlight with what it does not reach: rounding alone.
    assert np.median(error) < 1e-6


@pytest.mark.full
def test_opaque_slanted_plane_has_no_band():
    """A ramp through focus whose colour is linear: blur keeps it, away from the frame."""
    columns = jnp.arange(64.0) + 0.5
    depth = jnp.broadcast_to(1 / (1.0 - columns / 80)[None, :], (64, 64))
    image = jnp.broadcast_to((columns / 64)[None, :, None], (64, 64, 1))
    lens = ThinLens(1.0, 1 / (1 - 32 / 80), 50.0)
    assert 15 < np.max(lens.circle_of_confusion(depth)) < 25
    error = np.asarray(dof.scatter(image, depth, lens, gamma=0.0) - image)[32, 14:-14]
    # What is left is the gradient of the blur itself, not a band: it is smooth and small.
    assert np.abs(error).max() < 0.03
    assert np.abs(np.diff(error, axis=0)).max() < 0.01
