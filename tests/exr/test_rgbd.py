"""An image and its depth from one file, by the names that renderers write."""

import numpy as np
import OpenEXR
import pytest

from jaxfx import dof, exr


FLAT = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
SIZE = (6, 9)


def image(channels=4, start=0.0, dtype=np.float32):
    planes = [np.full(SIZE, start + 0.125 * i) for i in range(channels)]
    return np.stack(planes, axis=-1).astype(dtype)


def blender(path, layers, dtype=np.float32):
    """A multilayer file as Blender writes it: every pass of every view layer, in one part."""
    planes = {}
    for i, (layer, depth) in enumerate(layers.items()):
        for name in ("Combined", "DiffCol"):
            for j, letter in enumerate("RGBA" if name == "Combined" else "RGB"):
                start = i if name == "Combined" else 7
                planes[f"{layer}.{name}.{letter}"] = np.full(SIZE, start + 0.125 * j, dtype)
        planes[f"{layer}.Depth.Z"] = depth.astype(dtype)
        planes[f"{layer}.Mist.Z"] = np.full(SIZE, 0.5, dtype)
        planes[f"{layer}.Denoising Depth.Z"] = np.full(SIZE, 0.25, dtype)
        planes[f"{layer}.AO.R"] = np.zeros(SIZE, dtype)
    OpenEXR.File(FLAT.copy(), planes).write(str(path))


def depth(sky):
    values = np.full(SIZE, 2.5)
    values[0] = sky
    return values


CLEAN = np.where(np.arange(6)[:, None] == 0, np.inf, np.full(SIZE, 2.5))


@pytest.mark.parametrize(("dtype", "sky"), [(np.float32, 1e10), (np.float16, 65504)])
def test_blender_multilayer(tmp_path, dtype, sky):
    path = tmp_path / "a.exr"
    blender(path, {"ViewLayer": depth(sky)}, dtype)
    rgbd = exr.read_rgbd(path)
    assert rgbd._fields == ("image", "depth")
    assert rgbd.image.dtype == rgbd.depth.dtype == np.float32
    np.testing.assert_array_equal(rgbd.image, image())
    np.testing.assert_array_equal(rgbd.depth, CLEAN)


@pytest.mark.full
def test_two_view_layers_are_an_image_and_what_is_behind_it(tmp_path):
    path = tmp_path / "a.exr"
    blender(path, {"ViewLayer": depth(1e10), "Behind": depth(1e10) + 1})
    with pytest.raises(ValueError, match=r"must have one layer .*\['Behind', 'ViewLayer'\]"):
        exr.read_rgbd(path)
    with pytest.raises(ValueError, match=r"must have a layer `View` with an image and a depth"):
        exr.read_rgbd(path, layer="View")
    front = exr.read_rgbd(path, layer="ViewLayer")
    behind = exr.read_rgbd(path, layer="Behind")
    np.testing.assert_array_equal(behind[0], image(start=1))
    np.testing.assert_array_equal(behind[1], CLEAN + 1)
    assert front[1][3, 3] == 2.5
    from jaxfx import ThinLens

    blurred = dof.layered(*front, ThinLens(0.1, 2.0, 20.0), max_coc=5.0, behind=behind)
    assert np.isfinite(blurred).all()


@pytest.mark.parametrize(
    ("color", "z"),
    [
        (["R", "G", "B", "A"], "Z"),
        (["R", "G", "B", "A"], "depth.Z"),
        (["R", "G", "B", "A"], "Depth.V"),
        (["rgba.red", "rgba.green", "rgba.blue", "rgba.alpha"], "depth.Z"),
        (
            ["View Layer.Combined.R", *(f"View Layer.Combined.{c}" for c in "GBA")],
            "View Layer.Depth.Z",
        ),
        ([f"L.Combined.left.{c}" for c in "RGBA"], "L.Depth.left.Z"),
        ([f"beauty.{c}" for c in "RGBA"], "Z"),
        (["R", "G", "B", "A"], "ViewLayer.Depth.Z"),
        ([f"a.Combined.{c}" for c in "RGBA"], "b.Depth.Z"),
    ],
)
def test_names_of_other_renderers(tmp_path, color, z):
    planes = {name: image()[..., i].copy() for i, name in enumerate(color)}
    planes |= {z: depth(1e10).astype(np.float32), "AO.V": np.zeros(SIZE, np.float32)}
    OpenEXR.File(FLAT.copy(), planes).write(str(tmp_path / "a.exr"))
    found_image, found_depth = exr.read_rgbd(tmp_path / "a.exr")
    np.testing.assert_array_equal(found_image, image())
    np.testing.assert_array_equal(found_depth, CLEAN)


def test_what_write_wrote(tmp_path):
    holes = depth(np.inf).astype(np.float32)
    holes[2] = 0, -1, np.nan, 1, 1, 1, 1, 1, 1
    exr.write(tmp_path / "a.exr", {"": image(3), "depth": holes, "coc": depth(0)})
    found_image, found_depth = exr.read_rgbd(tmp_path / "a.exr")
    np.testing.assert_array_equal(found_image, image(3))
    np.testing.assert_array_equal(found_depth[2], [np.nan] * 3 + [1] * 6)


def part(name, channels, window=None, view=None):
    header = FLAT | {"displayWindow": (np.zeros(2, np.int32), np.array([8, 5], np.int32))}
    if window:
        header["dataWindow"] = tuple(np.array(corner, np.int32) for corner in window)
    return OpenEXR.Part(header | ({} if view is None else {"view": view}), channels, name)


def views(windows=(None, None), has_view=True):
    parts = []
    for i, (view, window) in enumerate(zip(("left", "right"), windows, strict=True)):
        planes = {c: image(start=i)[..., j].copy() for j, c in enumerate("RGB")}
        planes["depth.Z"] = (depth(1e10) + i).astype(np.float32)
        parts.append(part(view, planes, window, view if has_view else None))
    return parts


@pytest.mark.parametrize("has_view", [True, False])
def test_a_view_for_each_part(tmp_path, has_view):
    """Passes without a prefix belong to the first view."""
    OpenEXR.File(views(has_view=has_view)).write(str(tmp_path / "a.exr"))
    layers = {None: 0, "right": 1} | ({"left": 0} if has_view else {})
    for layer, i in layers.items():
        found_image, found_depth = exr.read_rgbd(tmp_path / "a.exr", layer=layer)
        np.testing.assert_array_equal(found_image, image(3, start=i))
        np.testing.assert_array_equal(found_depth, CLEAN + i)


def test_views_in_one_part(tmp_path):
    planes = {name: image()[..., j].copy() for j, name in enumerate("RGB")}
    planes |= {f"right.{name}": 1 + plane for name, plane in planes.items()}
    planes["depth.left.Z"] = depth(1e10).astype(np.float32)
    planes["depth.right.Z"] = 1 + planes["depth.left.Z"]
    header = FLAT | {"multiView": ["left", "right"]}
    OpenEXR.File(header, planes).write(str(tmp_path / "a.exr"))
    for layer, i in ((None, 0), ("left", 0), ("right", 1)):
        found_image, found_depth = exr.read_rgbd(tmp_path / "a.exr", layer=layer)
        np.testing.assert_array_equal(found_image, image(3, start=i))
        np.testing.assert_array_equal(found_depth, CLEAN + i)


def test_blender_with_a_part_for_each_pass_and_view(tmp_path):
    parts = []
    for i, view in enumerate(("left", "right")):
        combined = {
            f"ViewLayer.Combined.{c}": image(start=i)[..., j].copy()
            for j, c in enumerate("RGBA")
        }
        z = {"ViewLayer.Depth.Z": (depth(1e10) + i).astype(np.float32)}
        parts.append(part(f"ViewLayer.Combined-{view}", combined, view=view))
        parts.append(part(f"ViewLayer.Depth-{view}", z, view=view))
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    for i, view in enumerate(("left", "right")):
        found = exr.read_rgbd(tmp_path / "a.exr", layer=f"ViewLayer.{view}")
        np.testing.assert_array_equal(found[0], image(start=i))
        np.testing.assert_array_equal(found[1], CLEAN + i)


def test_pixels_that_lie_elsewhere_are_refused(tmp_path):
    """Two parts of one size whose data windows differ by a pixel."""
    one, other = [(0, 0), (8, 5)], [(1, 0), (9, 5)]
    image_planes = {c: image()[..., j].copy() for j, c in enumerate("RGB")}
    depth_plane = {"depth.Z": depth(1e10).astype(np.float32)}
    OpenEXR.File([part("rgb", image_planes, one), part("z", depth_plane, other)]).write(
        str(tmp_path / "a.exr")
    )
    with pytest.raises(ValueError, match=r"a.exr` must have `` and `depth` in the same pixels"):
        exr.read_rgbd(tmp_path / "a.exr")
    # Data windows of other views do not matter.
    OpenEXR.File(views((one, other))).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(
        exr.read_rgbd(tmp_path / "a.exr", layer="right")[1], CLEAN + 1
    )


def test_a_file_without_depth_names_its_layers(tmp_path):
    exr.write(tmp_path / "a.exr", {"": image(), "AO": depth(0)})
    with pytest.raises(
        ValueError, match=r"a.exr` must have one layer with an image and a depth, got none.*AO"
    ):
        exr.read_rgbd(tmp_path / "a.exr")


def test_an_image_before_two_depths_is_a_choice(tmp_path):
    layers = {"": image(), "near.depth": depth(0), "far.depth": depth(0)}
    exr.write(tmp_path / "a.exr", layers)
    with pytest.raises(ValueError, match=r"a.exr` must .* a depth, got .*\['far', 'near'\]"):
        exr.read_rgbd(tmp_path / "a.exr")
