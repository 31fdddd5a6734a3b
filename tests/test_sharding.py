"""What `sharding` refuses, and one device; tests/sharding has eight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractMesh

from jaxfx import sharding


def mesh(count, name="rows"):
    return AbstractMesh((count,), (name,))


def test_one_device_computes_the_effect_itself():
    halved = sharding.rows(lambda image, by: image / by, jax.make_mesh((1,), ("rows",)), halo=3)
    np.testing.assert_array_equal(halved(jnp.ones((2, 3)), by=2.0), np.full((2, 3), 0.5))


def test_a_halo_wider_than_the_rows_of_a_device_is_refused():
    image = jnp.ones((16, 3))
    for count, halo, most in ((8, 3, 2), (2, 9, 8)):
        call = sharding.rows(lambda image: image, mesh(count), halo=halo)
        message = rf"rows\(halo=...\).* at most .*, {most} of the 16 on {count}.* got {halo}"
        with pytest.raises(ValueError, match=message):
            call(image)
    with pytest.raises(ValueError, match=r"at most .*, 4 of the 9 on 2 devices, got 5"):
        sharding.rows(lambda image: image, mesh(2), halo=5)(jnp.ones((9, 3)))


def test_other_faults_are_refused_by_name():
    same = lambda image: image
    with pytest.raises(ValueError, match=r"rows\(axis=...\).* mesh, \('rows',\), got 'x'"):
        sharding.rows(same, mesh(4), axis="x", halo=1)
    with pytest.raises(ValueError, match=r"rows\(halo=...\).* 0 or more, got -1"):
        sharding.rows(same, mesh(4), halo=-1)
    with pytest.raises(ValueError, match=r"rows\(align=...\).*, got 0"):
        sharding.rows(same, mesh(4), halo=1, align=0)
    with pytest.raises(ValueError, match=r"target_rows\(axis=...\)"):
        sharding.target_rows(same, mesh(4), axis="x", height=3)
    with pytest.raises(ValueError, match=r"target_rows\(height=...\)"):
        sharding.target_rows(same, mesh(4), height=0)
    for images in ((jnp.ones((4, 3)), jnp.ones((5, 3))), (jnp.ones(()),), ()):
        with pytest.raises(ValueError, match="images of one height"):
            sharding.rows(same, mesh(4), halo=1)(*images)
