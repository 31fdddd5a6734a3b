"""One bounce of light against closed forms: a ball, parallel squares, a wall."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest
from trimesh import Trimesh, creation, util

from jaxfx import OrthographicCamera, PinholeCamera, SphericalHarmonicsLight, relight, scene


pytestmark = pytest.mark.skipif(
    scene.embree.problem() is not None, reason="Embree does not work on this machine."
)


def square(z, facing, side=1.0):
    """A square normal to the z axis; its front faces +z (`facing` 1) or -z (-1)."""
    half = side / 2
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Trimesh(corners, faces if facing > 0 else faces[:, ::-1], process=False)


def built(meshes, camera, size=(12, 12), **options):
    mesh = scene.from_trimesh(util.concatenate(meshes))
    height, width = size
    gbuffer = scene.gbuffer(mesh, camera, height=height, width=width, backend="embree")
    return mesh, gbuffer, scene.transfer(mesh, gbuffer, camera, **options)


def middle():
    """Halfway between squares at z = 0 and 1, only the one at 1 is visible."""
    pose = np.eye(4)
    pose[2, 3] = 0.5
    return OrthographicCamera(12.0, [6, 6], pose)


@pytest.fixture(scope="module")
def ball():
    inside = creation.icosphere(3, radius=2.0)
    inside.invert()
    camera = PinholeCamera.from_fov(1.5, height=12, width=12)
    return built([inside], camera, point_count=400, rank=400)[2]


@pytest.mark.full
def test_an_enclosure_gets_what_it_sends(ball):
    """In a sphere a sample's transfer is its fraction of the surface, for any pixel."""
    shares = np.asarray(ball.receive @ ball.send)
    np.testing.assert_allclose(shares.sum(axis=-1), 1, atol=0.03)
    np.testing.assert_allclose(np.asarray(ball.position) ** 2 @ np.ones(3), 4, rtol=0.02)
    uneven = 1 + np.asarray(ball.normal) @ [0.3, -0.5, 0.4]
    np.testing.assert_allclose(shares @ uneven, 1, atol=0.05)


def test_the_points_of_an_enclosure_exchange_all():
    """In a furnace of reflectance r the irradiance after n bounces is r + r**2 + ... + r**n."""
    inside = creation.icosphere(2, radius=2.0)
    inside.invert()
    camera = PinholeCamera.from_fov(1.5, height=4, width=4)
    _, gbuffer, transfer = built([inside], camera, (4, 4), point_count=300, rank=300)
    exchange = np.asarray(transfer.exchange)
    assert exchange.sum(axis=1).mean() == pytest.approx(1, abs=0.04)
    np.testing.assert_allclose(exchange.sum(axis=1), 1, atol=0.08)
    even = SphericalHarmonicsLight(np.pad([[1.0, 1, 1]], ((0, 8), (0, 0))))
    once, twice, thrice = (
        np.asarray(relight.indirect(gbuffer, transfer, [even], bounces=n)) for n in (1, 2, 3)
    )
    r = float(gbuffer.diffuse[0, 0, 0])
    np.testing.assert_allclose(twice / once, 1 + r, rtol=0.04)
    np.testing.assert_allclose(thrice / once, 1 + r + r**2, rtol=0.04)


def test_facing_squares_send_light_back_by_their_form_factor():
    """Hottel's 0.19982 of it, point by point; none to points of the same square."""
    transfer = built([square(0, 1), square(1, -1)], middle(), point_count=256, rank=4)[2]
    exchange, low = np.asarray(transfer.exchange), np.asarray(transfer.position)[:, 2] < 0.5
    np.testing.assert_array_equal(exchange[np.ix_(low, low)], 0)
    back = exchange[np.ix_(~low, low)].sum(axis=1)
    # The lower points are spread evenly; the upper ones lie denser where they send more.
    assert back.mean() == pytest.approx(0.19982, rel=0.05)


@pytest.mark.full
def test_one_singular_vector_says_all_of_a_sphere(ball):
    first = np.asarray(ball.receive[..., :1] @ ball.send[:1])
    np.testing.assert_allclose(first.sum(axis=-1), 1, atol=0.03)


@pytest.mark.full
def test_singular_vectors_are_orthonormal_and_the_largest_come_first(ball):
    np.testing.assert_allclose(ball.send @ ball.send.T, np.eye(400), atol=1e-5)
    strength = np.linalg.norm(np.asarray(ball.receive).reshape(-1, 400), axis=0)
    assert strength[0] > 20 * strength[1]


def test_parallel_squares_have_their_form_factor():
    """0.19982 at a distance of one side (Hottel 1931), from the front only."""
    send, get = square(0, 1), square(1, -1)
    transfer = built([send, get], middle(), point_count=256, rank=64)[2]
    share = np.asarray(transfer.receive) @ np.asarray(transfer.send).sum(axis=1)
    assert share.mean() == pytest.approx(0.19982, rel=0.01)
    turned = built([square(0, -1), get], middle(), point_count=16, rank=16)[2]
    np.testing.assert_array_equal(turned.receive, 0)


def test_a_wall_between_lets_nothing_through():
    wall = square(0.25, 1, side=3.0)
    mesh, _, transfer = built(
        [square(0, 1), square(1, -1), wall], middle(), point_count=64, rank=8
    )
    behind = np.asarray(transfer.position)[:, 2] < 0.1
    np.testing.assert_allclose(np.asarray(transfer.send)[:, behind], 0, atol=1e-6)
    assert np.asarray(transfer.receive).any()
    ends = np.array([[0, 0, 0.9], [0, 0, 0.3], [0.4, 0, 1]])
    seen = scene.visible(mesh, np.array([[[0, 0, 0.0]], [[0, 0, 1.0]]]), ends)
    np.testing.assert_array_equal(seen, [[False] * 3, [True] * 3])


def test_points_have_the_reflectance_and_the_front_of_what_they_lie_on():
    mesh, gbuffer, transfer = built(
        [square(0, 1), square(1, -1)], middle(), point_count=32, rank=4
    )
    assert transfer.receive.shape == (12, 12, 4) and transfer.send.shape == (4, 32)
    assert transfer.receive.dtype == jnp.float32
    z = np.asarray(transfer.position)[:, 2]
    np.testing.assert_allclose(np.asarray(transfer.normal)[:, 2], np.where(z < 0.5, 1, -1))
    np.testing.assert_allclose(
        np.asarray(transfer.diffuse) - np.asarray(gbuffer.diffuse[0, 0]), 0, atol=1e-6
    )
    assert np.abs(np.asarray(transfer.position)[:, :2]).max() <= 0.5
    again = scene.transfer(mesh, gbuffer, middle(), point_count=32, rank=4)
    np.testing.assert_array_equal(transfer.position, again.position)


def test_errors_name_the_argument():
    transfer, visible = inspect.unwrap(scene.transfer), inspect.unwrap(scene.visible)
    mesh, gbuffer, _ = built([square(1, -1)], middle(), point_count=2, rank=1)
    for options, message in (
        ({"point_count": 0}, r"`scene.transfer\(point_count=...\)` must be at least 1, got 0"),
        (
            {"point_count": 2.0},
            r"`scene.transfer\(point_count=...\)` must be an integer, got 2.0",
        ),
        (
            {"point_count": 4, "rank": 5},
            r"`scene.transfer\(rank=...\)` must be in \[1, 4\], got 5",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            transfer(mesh, gbuffer, middle(), **options)
    with pytest.raises(ValueError, match=r"`scene.visible\(end\)` must have shape"):
        visible(mesh, np.zeros((1, 3)), np.zeros((1, 2)))
