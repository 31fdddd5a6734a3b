"""Lights: their fields, as types, under transforms, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import AmbientLight, DirectionalLight, PointLight, SpotLight
from jaxfx.light import Light


COLOR, POSITION, DIRECTION = (1.0, 0.5, 0.25), (1.0, 2.0, 3.0), (0.0, -2.0, 0.0)
LIGHTS = {
    AmbientLight: {"color": COLOR},
    DirectionalLight: {"direction": DIRECTION, "color": COLOR},
    PointLight: {"position": POSITION, "color": COLOR},
    SpotLight: {
        "position": POSITION,
        "direction": DIRECTION,
        "color": COLOR,
        "inner_angle": 0.3,
        "outer_angle": 0.5,
    },
}


@pytest.mark.parametrize(("kind", "fields"), LIGHTS.items())
def test_fields_are_kept_in_order(kind, fields):
    light = kind(*fields.values())
    assert isinstance(light, Light)
    for name, value in fields.items():
        field = getattr(light, name)
        np.testing.assert_array_equal(field, value)
        assert field.dtype == jnp.float64
        assert not field.weak_type
    assert len(jax.tree.leaves(light)) == len(fields)


@pytest.mark.parametrize(("kind", "fields"), LIGHTS.items())
def test_types_of_numbers(kind, fields):
    single = kind(**{name: np.float32(value) for name, value in fields.items()})
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(single))
    if "outer_angle" not in fields:
        whole = kind(**{name: [1, 2, 3] for name in fields})
        assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(whole))


@pytest.mark.parametrize(("kind", "fields"), LIGHTS.items())
@pytest.mark.full
def test_transforms(kind, fields):
    """Made, batched and differentiated inside them."""

    def total(numbers):
        light = kind(**numbers)
        return sum(jnp.sum(leaf * leaf) for leaf in jax.tree.leaves(light))

    numbers = {name: jnp.array(value) for name, value in fields.items()}
    expected = {name: 2 * value for name, value in numbers.items()}
    for gradient in (jax.grad(total), jax.jacfwd(total), jax.jit(jax.grad(total))):
        for name, slope in gradient(numbers).items():
            np.testing.assert_allclose(slope, expected[name], rtol=1e-15)
    batch = {name: jnp.stack([value, 2 * value]) for name, value in numbers.items()}
    value = total(numbers)
    np.testing.assert_allclose(jax.vmap(total)(batch), [value, 4 * value], rtol=1e-14)


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind, fields in LIGHTS.items() for name in fields]
)
def test_errors_of_shape(kind, name):
    wrong = [1.0, 2.0] if name not in ("inner_angle", "outer_angle") else [0.4]
    shape = r"\(3,\), got \(2,\)" if len(wrong) == 2 else r"\(\), got \(1,\)"
    with pytest.raises(
        ValueError, match=rf"`{kind.__name__}\({name}\)` must have shape {shape}"
    ):
        kind(**LIGHTS[kind] | {name: wrong})


@pytest.mark.parametrize("kind", [DirectionalLight, SpotLight])
def test_errors_of_directions(kind):
    message = rf"`{kind.__name__}\(direction\)` must be a vector other than zero"
    with pytest.raises(ValueError, match=message):
        kind(**LIGHTS[kind] | {"direction": (0, 0, 0)})


@pytest.mark.parametrize(
    ("inner", "outer", "message"),
    [
        (-0.1, 0.5, r"`SpotLight\(inner_angle\)` must be 0 or positive, got -0.1"),
        (0.1, 3.2, r"`SpotLight\(outer_angle\)` must be at most pi, got 3.2"),
        (0.5, 0.5, r"`SpotLight\(outer_angle\)` must be above `inner_angle`"),
        (np.nan, 0.5, r"`SpotLight\(inner_angle\)` must be 0 or positive, got nan"),
    ],
)
def test_errors_of_angles(inner, outer, message):
    with pytest.raises(ValueError, match=message):
        SpotLight(**LIGHTS[SpotLight] | {"inner_angle": inner, "outer_angle": outer})


def test_the_widest_and_the_narrowest_cone():
    SpotLight(**LIGHTS[SpotLight] | {"inner_angle": 0, "outer_angle": np.pi})
    SpotLight(**LIGHTS[SpotLight] | {"inner_angle": 0, "outer_angle": 1e-9})
