"""OFF: polygons, colours in both notations, normals, and refused files."""

import numpy as np
import pytest
import trimesh

from jaxfx import io, scene


@pytest.fixture
def load(tmp_path):
    """A function that loads an OFF file with a text."""

    def read(text):
        (tmp_path / "a.off").write_text(text)
        return scene.load(tmp_path / "a.off")

    return read


L_SHAPE = ["2 0 0", "2 1 0", "1 1 0", "1 2 0", "0 2 0", "0 0 0"]


def text(rows, faces, head="OFF"):
    return "\n".join([head, f"{len(rows)} {len(faces)} 0", *rows, *faces, ""])


def area(mesh):
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def test_concave_polygons(load):
    assert area(load(text(L_SHAPE, ["6 0 1 2 3 4 5"]))) == pytest.approx(3)


def test_what_trimesh_writes(load):
    ball = trimesh.creation.icosphere(1)
    loaded = load(ball.export(file_type="off"))
    np.testing.assert_allclose(loaded.vertices[loaded.faces], ball.triangles, atol=1e-9)


def test_remarks_and_counts_beside_the_head(load):
    for head in ("OFF 3 1 0", "OFF3 1 0", "# a\nOFF # b\n\n3 1 0 # c"):
        assert len(load("\n".join([head, *L_SHAPE[:3], "3 0 1 2"])).faces) == 1


@pytest.mark.parametrize(
    "color", ["51 128 255", "51 128 255 9", "0.2 0.5 1.0", "0.2 0.5 1.0 1.0"]
)
@pytest.mark.parametrize("of_faces", [False, True])
def test_colors(load, color, of_faces):
    words = np.array(color.split()[:3], float)
    expected = io.linear_from_srgb(words / 255 if "." not in color else words)
    if of_faces:
        loaded = load(text(L_SHAPE[:3], [f"3 0 1 2 {color}"]))
    else:
        loaded = load(text([f"{row} {color}" for row in L_SHAPE[:3]], ["3 0 1 2"], "COFF"))
    np.testing.assert_allclose(loaded.colors - expected, 0, atol=1e-6)


def test_normals_and_coordinates(load):
    loaded = load(
        text([f"{row} 0 3 4 0.25 0.75" for row in L_SHAPE[:3]], ["3 0 1 2"], "STNOFF")
    )
    np.testing.assert_allclose(loaded.normals - [0, 0.6, 0.8], 0, atol=1e-6)
    np.testing.assert_allclose(loaded.uv - [0.25, 0.75], 0)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (text(L_SHAPE, ["3 0 1 6"]), "a face is '3 0 1 6' of 6"),
        (text(L_SHAPE, ["3 0 1 -1"]), "a face is '3 0 1 -1' of 6"),
        (text(L_SHAPE, ["3 0 1"]), "a face is"),
        (text(L_SHAPE, ["2 0 1"]), "a face is"),
        (text(L_SHAPE, ["3 0 1 2"], "4OFF"), "does not begin with OFF"),
        (text(L_SHAPE, ["3 0 1 2"]) + "9 9 9\n", "1 lines are left over"),
        (text(L_SHAPE, ["3 0 1 2"]).replace("6 1 0", "6 2 0"), "ends before 6 vertices and 2"),
        (text(L_SHAPE, ["3 0 1 2"], "COFF"), "its vertices have 3 numbers"),
        (text([*L_SHAPE[:2], "1 1"], ["3 0 1 2"]), "same number of numbers"),
        (text(L_SHAPE, ["3 0 1 2 300 0 0"]), "a colour is neither"),
        (text(L_SHAPE, ["3 0 1 2 0.1 0 0", "3 0 1 2"]), "some of its faces have a colour"),
    ],
)
def test_errors_name_the_file_and_the_fault(load, content, complaint):
    with pytest.raises(ValueError, match=rf"`scene\.load\(path\)`.*a\.off'.*{complaint}"):
        load(content)
