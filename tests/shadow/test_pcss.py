"""Soft shadows of a light with an extent, against the closed form of a half-plane."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import OrthographicCamera, PinholeCamera, shadow


SIDE = 128


def half_plane(light_camera, blocker=1.0, floor=2.0):
    """Left of the axis all is shadowed from depth `blocker`; receivers lie on the floor."""
    shadow_map = np.full((SIDE, SIDE), floor)
    shadow_map[:, : SIDE // 2] = blocker
    x = SIDE / 2 + np.linspace(-20, 20, 81)
    fields = (x, 0 * x + SIDE / 2, 0 * x + floor, 0 * x)
    receivers = shadow.Receivers(*(jnp.asarray(each)[None] for each in fields))
    return shadow_map, receivers, light_camera


def width(visible):
    """Of a linear ramp: 1 / its steepest slope, in samples of half a texel."""
    return 0.5 / np.abs(np.diff(np.asarray(visible)[0])).max()


@pytest.mark.parametrize("light_size", [0.1, 0.2])
def test_the_penumbra_is_as_wide_as_similar_triangles_say(light_size):
    """Floor at 2, blocker at 1: light_size wide there, focal / 2 texels a unit."""
    camera = PinholeCamera.from_fov(1.0, height=SIDE, width=SIDE)
    data = half_plane(camera)
    visible = shadow.pcss(*data, size=15, light_size=light_size, bias=0.1)
    texels = light_size * float(camera.intrinsics[0, 0]) / 2
    assert width(visible) == pytest.approx(texels, rel=0.02)
    assert visible[0, 0] == 0
    assert visible[0, -1] == 1


def test_a_sun_is_measured_in_radians():
    camera = OrthographicCamera(50.0, [SIDE / 2, SIDE / 2], np.eye(4))
    visible = shadow.pcss(*half_plane(camera), size=15, light_size=0.2, bias=0.1)
    assert width(visible) == pytest.approx(50 * 2 * np.tan(0.1), rel=0.02)


def test_what_touches_casts_a_sharp_shadow():
    camera = PinholeCamera.from_fov(1.0, height=SIDE, width=SIDE)
    far, near = (
        shadow.pcss(*half_plane(camera, z), size=15, light_size=0.2, bias=0.01)
        for z in (1.0, 1.95)
    )
    assert width(near) == pytest.approx(1, rel=0.02)
    assert width(far) > 8


def test_lit_where_there_is_no_blocker():
    camera = PinholeCamera.from_fov(1.0, height=SIDE, width=SIDE)
    _, receivers, _ = half_plane(camera)
    empty = np.full((SIDE, SIDE), np.inf)
    assert (shadow.pcss(empty, receivers, camera, size=15, light_size=0.2) == 1).all()


@pytest.mark.full
def test_reverse_mode_matches_differences():
    camera = PinholeCamera.from_fov(1.0, height=SIDE, width=SIDE)
    shadow_map, receivers, _ = half_plane(camera)

    def loss(light_size, shift, softness):
        moved = receivers._replace(u=receivers.u + shift)
        options = {"size": 11, "bias": 0.1, "light_size": light_size, "softness": softness}
        return jnp.sum(shadow.pcss(shadow_map, moved, camera, **options) ** 2)

    at = tuple(map(jnp.asarray, (0.1, 0.123, 0.3)))
    both = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2)))
    for index, slope in enumerate(both(*at)[1]):
        ahead, behind = (
            both(*(x + s * (i == index) for i, x in enumerate(at)))[0] for s in (1e-6, -1e-6)
        )
        assert float(slope) == pytest.approx(float(ahead - behind) / 2e-6, rel=1e-4, abs=1e-6)


def test_errors_name_their_argument(case):
    function = inspect.unwrap(shadow.pcss)
    camera = PinholeCamera.from_fov(1.0, height=8, width=8)
    for name, options in (("size", {"size": 2}), ("light_size", {"light_size": 0.0})):
        with pytest.raises(ValueError) as caught:
            function(*case, camera, **({"size": 3, "light_size": 1.0} | options))
        assert str(caught.value).startswith(f"`pcss({name}=...)`")
