"""OBJ and MTL: indices, polygons, names and options, against the files' text."""

import logging

import numpy as np
import OpenImageIO
import pytest
from PIL import Image

from jaxfx import io, scene


QUAD = "v 0 0 0\nv 3 0 0\nv 3 2 0\nv 0 2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "usemtl a\nf 1/1 2/2 3/3 4/4\n"


@pytest.fixture
def load(tmp_path):
    """A function that loads an OBJ file with a text, beside an `m.mtl` with another."""

    def read(text, mtl="newmtl a\nKd 1 1 1\nmap_Kd texels.png\n"):
        (tmp_path / "m.mtl").write_text(mtl)
        (tmp_path / "m.obj").write_text(text)
        return scene.load(tmp_path / "m.obj")

    return read


def area(mesh):
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


CORNERS = np.array([[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0]], float)


@pytest.mark.parametrize(
    "face",
    [
        "f 1 2 3",
        "f -4 -3 -2",
        "f 1/1 2/2 3/3",
        "f 1//1 2//1 3//1",
        "f 1/1/1 2/2/1 3/3/1",
        "f -4/-4/-1 2/2/1 3/-2/-1",
        "fo 1 2 3",
        "  f   1\t2  3   # a remark",
        "f 1 2 \\\n3",
    ],
)
def test_every_form_of_an_index(load, face):
    loaded = load(f"{QUAD}vn 0 0 -1\n{face}\n")
    np.testing.assert_array_equal(loaded.vertices[loaded.faces], [CORNERS[:3]])
    np.testing.assert_array_equal(
        loaded.normals, [[[0, 0, -1 if face.count("/") == 6 else 1]] * 3]
    )


def test_relative_indices_count_from_where_they_stand(load):
    text = "v 0 0 0\nv 2 0 0\nv 0 2 0\nf -3 -2 -1\nv 10 0 0\nv 12 0 0\nv 10 2 0\nf -3 -2 -1\n"
    np.testing.assert_array_equal(load(text).bounds[:, 0], [0, 12])


def test_an_absolute_index_may_come_before_its_vertex(load):
    loaded = load("f 1 2 3\nv 0 0 0\nv 3 0 0\nv 3 2 0\n")
    np.testing.assert_array_equal(loaded.vertices[loaded.faces], [CORNERS[:3]])


def test_concave_polygons_are_cut_by_ears(load):
    corners = "v 2 0 0\nv 2 1 0\nv 1 1 0\nv 1 2 0\nv 0 2 0\nv 0 0 0\n"
    assert area(load(f"{corners}f 1 2 3 4 5 6\n")) == pytest.approx(3)
    assert area(load(f"{corners}f 3 4 5 6 1 2\n")) == pytest.approx(3)
    assert area(load("v 0 0 0\nv 2 1 0\nv 0 2 0\nv 1 1 0\nf 1 2 3 4\n")) == pytest.approx(1)


def test_faces_with_and_without_coordinates_and_normals(load, texels, codes, caplog):
    """Faces with vt have the texture; those without have the material's colour."""
    half = "v 1.5 0 0\nv 1.5 2 0\nvt 0.5 0\nvt 0.5 1\nvn 0 1 1\n"
    faces = "usemtl a\nf 1/1 5/5 6/6 4/4\nf 5//1 2//1 3//1 6//1\n"
    with caplog.at_level(logging.WARNING, "jaxfx"):
        loaded = load(
            f"mtllib m.mtl\n{QUAD}{half}{faces}", "newmtl a\nKd 1 0 0\nmap_Kd texels.png"
        )
    shown = codes(loaded)
    np.testing.assert_array_equal(shown[:, 0], texels[:, 0] * [1, 0, 0])
    np.testing.assert_array_equal(shown[:, 2], [[255, 0, 0]] * 2)
    np.testing.assert_allclose(loaded.normals[:2], [[[0, 0, 1]] * 3] * 2)
    np.testing.assert_allclose(loaded.normals[2:], [[[0, 0.5**0.5, 0.5**0.5]] * 3] * 2)
    assert "the texture of 'a' on faces without vt" in caplog.text


def test_smoothing_groups_make_the_normals_that_are_not_given(load):
    roof = "v 0 0 0\nv 0 0 1\nv 1 1 0\nv 1 1 1\nv 2 0 0\nv 2 0 1\n"
    faces = "f 1 2 4 3\n{}f 3 4 6 5\n"
    flat = load(roof + faces.format(""))
    slope = 0.5**0.5
    np.testing.assert_allclose(flat.normals[0], [[-slope, slope, 0]] * 3, atol=1e-7)
    smooth = load(roof + "s 1\n" + faces.format(""))
    at_ridge = np.isin(smooth.faces, [2, 3])
    np.testing.assert_allclose(smooth.normals[at_ridge] - [0, 1, 0], 0, atol=1e-7)
    edge = load(roof + "s 1\n" + faces.format("s 2\n"))
    np.testing.assert_allclose(edge.normals, flat.normals, atol=1e-7)
    off = load(roof + "s off\n" + faces.format("s 0\n"))
    np.testing.assert_allclose(off.normals, flat.normals, atol=1e-7)


def test_vertex_colors_are_srgb(load):
    loaded = load("v 0 0 0 1 0.5 0\nv 1 0 0 1 0.5 0\nv 0 1 0\nf 1 2 3\n")
    expected = io.linear_from_srgb(np.array([1, 0.5, 0]))
    np.testing.assert_allclose(loaded.colors[0, :2], [expected] * 2, atol=1e-6)
    np.testing.assert_array_equal(loaded.colors[0, 2], 1)


def test_objects_and_groups_name_faces(load):
    three = "g one\nf 1 2 3\ng two\nf 1 3 4\ng one\nf 1 2 4\n"
    loaded = load(QUAD + three)
    assert loaded.names == ("one", "two")
    np.testing.assert_array_equal(loaded.face_objects, [0, 1, 0])
    assert load(f"{QUAD}o all\n{three}").names == ("all",)
    assert load(f"{QUAD}f 1 2 3\n").names == ("m.obj",)


def test_several_libraries(load, tmp_path, texels):
    (tmp_path / "second one.mtl").write_text("newmtl b\nKd 0 1 0\nnewmtl a\nKd 0 0 1\n")
    loaded = load(
        f"mtllib m.mtl\nmtllib second one.mtl\n{QUAD}usemtl b\nf 1 2 3\nusemtl a\nf 1 3 4\n",
        "newmtl a\nKd 1 0 0\n",
    )
    colors = [loaded.materials[i].color for i in loaded.face_materials]
    np.testing.assert_allclose(colors, [[0, 1, 0], [1, 0, 0]])
    both = load(f'mtllib m.mtl "second one.mtl"\n{QUAD}usemtl b\nf 1 2 3\n', "newmtl a\nKd 1\n")
    np.testing.assert_allclose(both.materials[0].color, [0, 1, 0])


@pytest.mark.parametrize(
    ("file", "written"),
    [
        ("texels.png", '"texels.png"'),
        ("my t.png", "my t.png"),
        ("my t.png", '"my t.png"'),
        ("t.png", ".\\t.png"),
        ("sub/t.png", "sub\\t.png"),
        ("sub/t.png", "Sub\\T.PNG"),
        ("Case.PNG", "case.png"),
        ("t.png", "-s 1 1 1 t.png"),
        ("t.png", "-o 1 0 0 -blendu on -mm 0 1 -texres 64 t.png"),
        ("t.png", "-o 1 t.png"),
        ("-odd.png", "-odd.png"),
        ("a#b.png", "a#b.png"),
    ],
)
def test_names_and_options_of_maps(load, texels, codes, tmp_path, file, written):
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / "texels.png").rename(tmp_path / file)
    loaded = load(f"mtllib m.mtl\n{QUAD}{FACE}", f"newmtl a\nKd 1 1 1\nmap_Kd {written}\n")
    np.testing.assert_array_equal(codes(loaded), texels)


def test_scale_offset_and_clamp_of_a_map(load, texels, codes):
    mtl = "newmtl a\nKd 1 1 1\nmap_Kd -clamp on -s 1 -1 -o 0.3333333333333333 1 texels.png\n"
    shown = codes(load(f"mtllib m.mtl\n{QUAD}{FACE}", mtl))
    np.testing.assert_array_equal(shown, texels[::-1][:, [1, 2, 2]])


def test_maps_lie_beside_their_library(load, texels, codes, tmp_path):
    (tmp_path / "lib").mkdir()
    (tmp_path / "texels.png").rename(tmp_path / "lib" / "t.png")
    (tmp_path / "lib" / "a.mtl").write_text("newmtl a\nKd 1 1 1\nmap_Kd t.png\n")
    np.testing.assert_array_equal(codes(load(f"mtllib lib/a.mtl\n{QUAD}{FACE}")), texels)


@pytest.mark.parametrize("kind", ["grey", "color"])
def test_16_bits_of_a_texture(load, tmp_path, codes, straight, kind):
    code = 30001
    if kind == "grey":
        Image.fromarray(np.full((2, 2), code, np.uint16)).save(tmp_path / "texels.png")
    else:
        output = OpenImageIO.ImageOutput.create("png")
        spec = OpenImageIO.ImageSpec(2, 2, 3, "uint16")
        assert output.open(str(tmp_path / "texels.png"), spec)
        assert output.write_image(np.full((2, 2, 3), code, np.uint16)) and output.close()
    loaded = load(f"mtllib m.mtl\n{QUAD}{FACE}")
    shown = scene.gbuffer(loaded, straight(2), height=2, width=3, backend="embree")
    expected = io.read_png(tmp_path / "texels.png")[0, 0, 0]
    np.testing.assert_allclose(shown.color, expected, rtol=1e-6)


@pytest.mark.parametrize("suffix", ["jpg", "bmp", "tga", "tif", "webp", "gif"])
def test_other_images(load, tmp_path, codes, suffix):
    color = (200, 100, 50)
    Image.new("RGB", (8, 8), color).save(tmp_path / f"t.{suffix}")
    loaded = load(f"mtllib m.mtl\n{QUAD}{FACE}", f"newmtl a\nKd 1 1 1\nmap_Kd t.{suffix}\n")
    assert abs(codes(loaded)[0, 0] - color).max() <= 2


def test_illum_without_highlight(load):
    mtl = "newmtl a\nKd 1 1 1\nKs 1 1 1\nNs 30\nillum {}\n"
    rough = [
        load(f"mtllib m.mtl\n{QUAD}{FACE}", mtl.format(i)).materials[0].roughness
        for i in (1, 2)
    ]
    assert rough == [1, 0.25]


def test_what_is_left_out_is_said_once(load, caplog):
    mtl = "newmtl a\nKa 1 1 1\nKd 1 1 1\nd 0.5\nmap_Bump b.png\nillum 2\nNi 1\nKe 0 0 0\n"
    with caplog.at_level(logging.WARNING, "jaxfx"):
        load(f"mtllib m.mtl\n{QUAD}l 1 2\np 1\n{FACE}f 1 3 2 4\n", mtl)
    (record,) = caplog.records
    assert record.getMessage().endswith(
        "left out are d of materials, lines, map_Bump of materials, points, "
        "the triangulation of 1 polygons that intersect themselves"
    )


def test_materials_without_any_library(load, caplog):
    with caplog.at_level(logging.WARNING, "jaxfx"):
        loaded = load(QUAD + FACE)
    assert loaded.materials[0].color == (0.8, 0.8, 0.8)
    assert "usemtl without any mtllib" in caplog.text
    load(f"mtllib gone.mtl\n{QUAD}f 1 2 3\n")
    assert "gone.mtl" in caplog.text


@pytest.mark.parametrize(
    ("text", "mtl", "complaint"),
    [
        (f"{QUAD}f 1 2 5\n", "", r"line 9, a face among 4 v, 4 vt, 0 vn: it has an index that"),
        (f"{QUAD}f 1 2 -5\n", "", r"line 9, 'f 1 2 -5': there is no -5 among 4"),
        (f"{QUAD}f 1 2 0\n", "", r"line 9.*there is no 0"),
        (f"{QUAD}f 1 2\n", "", r"line 9.*a face of 2 corners"),
        (f"{QUAD}f 1/1 2/2 3\n", "", r"line 9, .*: its corners are not of one form"),
        (
            f"{QUAD}f 1/1/1 2/2/1 3/3/1\n",
            "",
            r"line 9, a face among 4 v, 4 vt, 0 vn: it has an index",
        ),
        (f"{QUAD}f 1 2 1_0\n", "", r"line 9.*'_' is in no number"),
        ("v 0 0\n", "", r"line 1, 'v 0 0': 2 numbers"),
        ("v 0 0 x\n", "", r"line 1, 'v 0 0 x'"),
        ("v 0 0 0 255 0 0\n", "", r"line 1.*a colour is not in \[0, 1\]"),
        ("vt nan 0\n", "", r"line 1.*not finite"),
        ("curv2 1 2 3\n", "", r"line 1, 'curv2 1 2 3': 'curv2' is not read"),
        (f"mtllib gone.mtl\n{QUAD}{FACE}", "", r"material 'a' is in none of the files \['gone"),
        (f"mtllib m.mtl\n{QUAD}{FACE}", "newmtl b\n", r"no mtllib has the material 'a'"),
        (f"mtllib m.mtl\n{QUAD}{FACE}", "Kd 1 1 1\n", r"'Kd' before any newmtl"),
        (f"mtllib m.mtl\n{QUAD}{FACE}", "newmtl a\nKd xyz 1 1 1\n", r"has Kd 'xyz 1 1 1'"),
        (f"mtllib m.mtl\n{QUAD}{FACE}", "newmtl a\nKd 1 1\n", r"has Kd '1 1'"),
        (f"mtllib m.mtl\n{QUAD}{FACE}", "newmtl a\nmap_Kd gone.png\n", r"no file 'gone\.png'"),
        (f"mtllib m.mtl\n{QUAD}{FACE}", "newmtl a\nmap_Kd m.obj\n", r"m\.obj' is neither PNG"),
        (f"mtllib m.mtl\n{QUAD}{FACE}", "newmtl a\nmap_Kd -t 1 a.png\n", r"is not read"),
        (f"mtllib m.mtl\n{QUAD}{FACE}", "newmtl a\nmap_Kd -mm 0 2 a.png\n", r"is not read"),
        (f"mtllib m.mtl\n{QUAD}{FACE}", "newmtl a\nmap_Kd -s t.png\n", r"no number behind -s"),
    ],
)
def test_errors_name_the_file_and_the_fault(load, text, mtl, complaint):
    with pytest.raises(ValueError, match=rf"`scene\.load\(path\)`.*m\.obj'.*{complaint}"):
        load(text, mtl)


def test_two_files_that_differ_in_capitals_alone(load, tmp_path, texels):
    for name in ("ONE.png", "One.png"):
        (tmp_path / name).write_bytes((tmp_path / "texels.png").read_bytes())
    with pytest.raises(ValueError, match=r"'one\.png' is the name of"):
        load(f"mtllib m.mtl\n{QUAD}{FACE}", "newmtl a\nmap_Kd one.png\n")
