"""Shadow maps of the still life against shadow rays that Embree traces."""

import numpy as np
import pytest

from jaxfx import DirectionalLight, PointLight, SpotLight, scene, shadow
from jaxfx._sampling import pixel_centers


pytest.importorskip("embreex", reason="the truth is traced by Embree")

SIDE, WHITE = 96, [1.0, 1.0, 1.0]
SUN = np.array([0.6, -0.67, -0.42])
LAMP, TARGET = np.array([-1.2, 2.6, -1.6]), np.array([0.0, 0.4, -3.8])


class Stage:
    """A view of the still life: its depth, normals and points, and rays from these."""

    def __init__(self):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.mesh = scene.still_life()
        self.eye = scene.default_camera(self.mesh, height=SIDE, width=SIDE)
        found = scene.gbuffer(self.mesh, self.eye, height=SIDE, width=SIDE, backend="embree")
        self.depth, self.normal = found.depth, found.normal
        centers = pixel_centers(SIDE, SIDE, found.depth.dtype)
        self.points = np.asarray(self.eye.unproject(centers, found.depth), np.float64)
        self.rays = EmbreeScene(robust=True)
        TriangleMesh(self.rays, self.mesh.vertices[self.mesh.faces].astype(np.float32))

    def truth(self, towards, distance=np.inf):
        """Which points see the light, and which face it at more than a grazing angle."""
        towards = np.broadcast_to(towards, self.points.shape)
        towards = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
        normal = np.asarray(self.normal, np.float64)
        rays = (self.points + 1e-3 * normal, towards)
        rays = (np.ascontiguousarray(each.reshape(-1, 3), np.float32) for each in rays)
        first = self.rays.run(*rays, query="DISTANCE").reshape(SIDE, SIDE)
        clear = first > 1e30 if np.isinf(distance).all() else first > distance
        return clear, np.sum(normal * towards, axis=-1) > 0.05

    def from_position(self, position):
        towards = position - self.points
        return self.truth(towards, np.linalg.norm(towards, axis=-1))

    def compared(self, cameras, map_size):
        """The maps side by side, and the receivers."""
        options = {"height": map_size, "width": map_size, "backend": "embree"}
        maps = [np.asarray(scene.depth(self.mesh, camera, **options)) for camera in cameras]
        light = cameras if len(cameras) > 1 else cameras[0]
        seen = shadow.receivers(self.depth, self.eye, light, normal=self.normal)
        return np.concatenate(maps, axis=1), seen

    def under_the_sun(self, map_size):
        ends = self.points.reshape(-1, 3)
        centre = (ends.min(axis=0) + ends.max(axis=0)) / 2
        radius = np.linalg.norm(ends - centre, axis=-1).max()
        light = DirectionalLight(SUN, WHITE)
        cameras = shadow.light_cameras(light, map_size=map_size, centre=centre, radius=radius)
        return self.compared(cameras, map_size)


@pytest.fixture(scope="module")
def stage():
    return Stage()


def rates(visible, clear, facing):
    """Acne, the share of what is lit that is shown dark; leaks, of what is dark shown lit."""
    visible = np.asarray(visible)
    return np.mean(visible[facing & clear] == 0), np.mean(visible[facing & ~clear] == 1)


def test_acne_falls_and_leaks_grow_with_both_biases(stage):
    """Ten units across, 512 texels. Half of all is acne without a bias."""
    data, truth = stage.under_the_sun(512), stage.truth(-SUN)
    grid = [
        [rates(shadow.hard(*data, bias=b, slope_bias=s), *truth) for s in (0.0, 0.5, 2.0)]
        for b in (0.0, 0.01, 0.1, 0.5)
    ]
    acne, leaks = np.moveaxis(np.array(grid), -1, 0)
    for axis in (0, 1):
        assert (np.diff(acne, axis=axis) <= 0).all()
        assert (np.diff(leaks, axis=axis) >= 0).all()
    assert acne[0, 0] > 0.4
    # Half a texel of slope is all that a plane needs; a constant bias needs a tenth of a unit.
    assert acne[0, 1] < 0.005
    assert leaks[0, 1] < 0.04
    assert acne[1, 0] > 0.1
    assert acne[2, 0] < 0.005
    # Half a unit lets the light under what stands on the floor.
    assert leaks[3, 0] > 0.15


def test_a_finer_map_errs_less(stage):
    clear, facing = stage.truth(-SUN)
    wrong = []
    for map_size in (256, 512, 1024):
        visible = shadow.hard(*stage.under_the_sun(map_size), slope_bias=0.5)
        wrong.append(np.mean((np.asarray(visible) != clear)[facing]))
    assert wrong[1] < 0.7 * wrong[0]
    assert wrong[2] < 0.7 * wrong[1]
    assert wrong[2] < 0.004


def test_six_faces_about_a_lamp(stage):
    cameras = shadow.light_cameras(PointLight(LAMP, WHITE), map_size=256, margin=4)
    visible = shadow.hard(*stage.compared(cameras, 256), slope_bias=0.5)
    clear, facing = stage.from_position(LAMP)
    assert np.mean(clear[facing]) < 0.95
    assert np.mean((np.asarray(visible) != clear)[facing]) < 0.015


def test_a_square_lamps_penumbra(stage):
    """36 shadow rays a point; `pcss` halves the error of the hard shadow, `pcf` does not."""
    light_size, rng = 0.2, (np.arange(6) + 0.5) / 6 - 0.5
    light = SpotLight(LAMP, TARGET - LAMP, WHITE, 0.7, 0.9)
    (camera,) = shadow.light_cameras(light, map_size=512)
    right, down = light_size * np.asarray(camera.world_from_camera, np.float64)[:3, :2].T
    rays = [stage.from_position(LAMP + a * right + b * down) for a in rng for b in rng]
    clear, facing = (np.array(each) for each in zip(*rays, strict=True))
    share, data = clear.mean(axis=0), stage.compared((camera,), 512)
    inside = (np.abs(np.stack(data[1][:2]) - 256) < 240).all(axis=0) & (data[1].z > 0)
    penumbra = facing.all(axis=0) & inside & (share > 0) & (share < 1)
    assert np.sum(penumbra) > 300

    bias = {"bias": 0.02, "slope_bias": 2.0}
    soft = shadow.pcss(*data, camera, size=31, light_size=light_size, **bias)
    error = {
        name: np.abs(np.asarray(visible) - share)[penumbra].mean()
        for name, visible in {
            "hard": shadow.hard(*data, **bias),
            "pcf": shadow.pcf(*data, size=7, **bias),
            "pcss": soft,
        }.items()
    }
    assert error["pcss"] < 0.6 * error["hard"]
    assert error["pcss"] < 0.75 * error["pcf"]
    assert error["pcf"] > 0.6 * error["hard"]
