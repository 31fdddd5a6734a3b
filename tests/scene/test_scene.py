"""The checks and the properties of a scene."""

import inspect

import numpy as np
import pytest

from jaxfx import scene


def arrays(**changes):
    """The arguments of a scene of one triangle."""
    one = {
        "vertices": np.eye(3),
        "faces": np.array([[0, 1, 2]]),
        "normals": np.ones((1, 3, 3)),
        "uv": np.zeros((1, 3, 2)),
        "colors": np.ones((1, 3, 3)),
        "materials": (scene.Material(),),
        "face_materials": np.zeros(1, int),
        "names": ("one",),
        "face_objects": np.zeros(1, int),
    }
    return one | changes


def build(kind, **arguments):
    """A scene by the unwrapped constructor: jaxtyping's error would come before ours."""
    made = object.__new__(kind)
    inspect.unwrap(kind.__init__)(made, **arguments)
    return made


def test_scene_copies_and_locks_its_arrays():
    vertices = np.eye(3)
    one = scene.Scene(**arrays(vertices=vertices))
    vertices[0] = 9
    np.testing.assert_array_equal(one.vertices, np.eye(3))
    with pytest.raises(ValueError, match="read-only"):
        one.vertices[0] = 9


def test_bounding_box_is_of_the_triangles():
    vertices = np.concatenate([np.diag([2.0, 4.0, 6.0]), [[99.0, 99.0, 99.0]]])
    one = scene.Scene(**arrays(vertices=vertices))
    np.testing.assert_allclose(one.bounds, [[0, 0, 0], [2, 4, 6]])
    np.testing.assert_allclose(one.center, [1, 2, 3])
    np.testing.assert_allclose(one.extent, [2, 4, 6])
    assert one.radius == pytest.approx(np.sqrt(14))
    assert repr(one) == "Scene(1 triangles, 1 objects, 2 x 4 x 6)"


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"faces": np.zeros((0, 3), int)}, r"Scene\(faces=...\)` must hold at least one"),
        ({"faces": np.array([[0, 1, 3]])}, r"Scene\(faces=...\)` must be indices in \[0, 3\)"),
        ({"vertices": np.full((3, 3), np.inf)}, r"Scene\(vertices=...\)` must be finite"),
        ({"uv": np.full((1, 3, 2), np.nan)}, r"Scene\(uv=...\)` must be finite.* face 0; 1 of"),
        ({"normals": np.full((1, 3, 3), np.inf)}, r"Scene\(normals=...\)` must be finite"),
        ({"colors": np.full((1, 3, 3), np.nan)}, r"Scene\(colors=...\)` must be finite"),
        ({"second_uv": np.zeros((2, 3, 2))}, r"Scene\(second_uv=...\)` must have shape"),
        (
            {
                "materials": (
                    scene.Material(samplers={"texture": scene.Sampler(use_second_uv=True)}),
                )
            },
            r"Scene\(second_uv=...\)` must be given",
        ),
        ({"normals": np.ones((2, 3, 3))}, r"Scene\(normals=...\)` must have shape \(1, 3, 3\)"),
        ({"face_materials": np.ones(1, int)}, r"Scene\(face_materials=...\)` must be indices"),
        ({"face_objects": -np.ones(1, int)}, r"Scene\(face_objects=...\)` must be indices"),
    ],
)
def test_bad_scenes(changes, complaint):
    with pytest.raises(ValueError, match=complaint):
        build(scene.Scene, **arrays(**changes))


@pytest.mark.parametrize(
    "wrong",
    [
        {"metallic": 1.5},
        {"roughness": -0.1},
        {"color": (1.0, 2.0)},
        {"texture": np.zeros((2, 2, 3))},
        {"metallic_roughness": np.zeros((2, 2), np.uint8)},
        {"normal_map": np.zeros((2, 2, 3))},
        {"texture": np.zeros((2, 2, 3), np.uint32)},
        {"normal_scale": np.nan},
        {"samplers": {"bump": scene.Sampler()}},
    ],
)
def test_bad_materials(wrong):
    with pytest.raises(ValueError, match=rf"`Material\({next(iter(wrong))}=...\)` must"):
        build(scene.Material, **wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        {"wrap": ("repeat", "stretch")},
        {"wrap": ("repeat",)},
        {"transform": ((1, 0), (0, 1))},
        {"transform": ((1, 0, np.nan), (0, 1, 0))},
    ],
)
def test_bad_samplers(wrong):
    with pytest.raises(ValueError, match=rf"`Sampler\({next(iter(wrong))}=...\)` must"):
        build(scene.Sampler, **wrong)
