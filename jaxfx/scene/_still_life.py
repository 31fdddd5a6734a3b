"""The built-in scene: textured objects from near to far, made without files."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from jaxfx._extras import needs
from jaxfx.scene._material import Material
from jaxfx.scene._scene import Scene, Viewpoint


_Corners = Float[np.ndarray, "face 3 3"]
_UV = Float[np.ndarray, "face 3 2"]
_Texture = UInt8[np.ndarray, "height width 3"]


def still_life() -> Scene:
    """A built-in room with textured objects at depths of 0.8 to 8 scene units.

    It has thin rods near and far, balls, boxes, a ring and columns, a floor and a back wall.
    With a focus distance of about 2.8, objects on both sides of the focus plane are blurred.

    **Returns:** the `Scene`, the same on every call.

    **Gradient:** none; the host side.

    **Example:**

    >>> from jaxfx import scene
    >>> mesh = scene.still_life()
    >>> mesh.names[:3]
    ('floor', 'wall', 'near rod 0')

    y points up. Objects stand on y = 0, and the floor lies 0.002 below, so that no two surfaces
    coincide. The eye of `default_camera` is above the origin and looks along -z. Meshes are
    made by `trimesh.creation`, textures by NumPy.
    """
    with needs("scene"):
        from trimesh import creation

    parts = _Parts()
    _room(parts, creation)
    _foreground(parts, creation)
    _middle(parts, creation)
    _background(parts, creation)
    return parts.scene(Viewpoint(eye=(0.0, 1.25, 0.0), at=(0.0, 0.72, -3.0), fov=0.8))


def _room(parts: "_Parts", creation: Any) -> None:
    """Add the floor and the back wall."""
    floor = Material(texture=_checker(_SAND, _BRICK, soft=0.08))
    parts.add("floor", creation.box((24, 0.2, 12)), floor, (0, -0.102, -3), _flat(0.8))
    wall = Material(texture=_tiles())
    parts.add("wall", creation.box((24, 9, 0.2)), wall, (0, 4.4, -8.1), _flat(3.2))


def _foreground(parts: "_Parts", creation: Any) -> None:
    """Add three rods, a post and a ball, about 1 unit away."""
    stripes = Material(texture=_stripes(_RED, _WHITE, 1), roughness=0.5)
    for index, (x, z, radius) in enumerate(
        [(-0.36, -0.85, 0.009), (-0.26, -1.0, 0.012), (-0.42, -1.15, 0.015)]
    ):
        rod = _upright(creation.cylinder(radius, 1.5, sections=24))
        parts.add(
            f"near rod {index}", rod, stripes, (x, 0.75, z), _cylinder(1, 0, slant=8), _rounded
        )
    dots = Material(texture=_dots(_YELLOW, _BLUE), roughness=0.35)
    column = Material(texture=_stripes(_GREEN, _DARK, 1))
    post = _upright(creation.cylinder(0.07, 0.74, sections=48))
    parts.add("near post", post, column, (0.3, 0.37, -1.1), _cylinder(6, 1), _rounded)
    ball = _upright(creation.icosphere(4, radius=0.15))
    parts.add("near ball", ball, dots, (0.3, 0.89, -1.1), _sphere(6, 3), _smooth)


def _middle(parts: "_Parts", creation: Any) -> None:
    """Add a box, two balls and a ring, about 2 to 3 units away."""
    box = _turned(creation.box((0.55, 0.55, 0.55)), 0.6)
    chequers = Material(texture=_checker(_BLUE, _WHITE))
    parts.add("box", box, chequers, (-0.62, 0.275, -2.5), _flat(0.275))
    marble = Material(texture=_noise(_ORANGE, _PURPLE), roughness=0.3)
    ball = _upright(creation.icosphere(5, radius=0.36))
    parts.add("marble", ball, marble, (0.12, 0.36, -2.8), _sphere(2, 1), _smooth)
    rings = Material(texture=_stripes(_RED, _YELLOW, 2), roughness=0.5)
    ring = _turned(creation.torus(0.3, 0.1, major_sections=64, minor_sections=32), 0.5)
    parts.add("ring", ring, rings, (0.95, 0.4, -3.3), _torus(12, 1, 0.3), _smooth)
    gold = Material(color=(0.95, 0.62, 0.22), metallic=0.9, roughness=0.4)
    ball = creation.icosphere(4, radius=0.2)
    parts.add("gold ball", ball, gold, (-0.1, 0.2, -1.9), _sphere(1, 1), _smooth)


def _background(parts: "_Parts", creation: Any) -> None:
    """Add a column, a crate, a ball and seven rods, 4.6 to 7 units away."""
    column = Material(texture=_stripes(_GREEN, _WHITE, 1), roughness=0.6)
    post = _upright(creation.cylinder(0.3, 2.2, sections=64))
    parts.add("column", post, column, (-1.5, 1.1, -4.6), _cylinder(6, 0, slant=2), _rounded)
    crate = Material(texture=_noise(_GREEN, _YELLOW, seed=3))
    box = _turned(creation.box((0.9, 1.3, 0.9)), -0.5)
    parts.add("crate", box, crate, (1.9, 0.65, -5.2), _flat(1.0))
    dots = Material(texture=_dots(_WHITE, _RED))
    ball = _upright(creation.icosphere(4, radius=0.55))
    parts.add("far ball", ball, dots, (0.25, 0.55, -5.8), _sphere(6, 3), _smooth)
    for index, color in enumerate([_RED, _ORANGE, _YELLOW, _GREEN, _BLUE, _PURPLE, _WHITE]):
        rod = _upright(creation.cylinder(0.03, 2.6, sections=16))
        plain = Material(texture=np.array([[color]], np.uint8))
        at = (-1.05 + 0.35 * index, 1.3, -7.0)
        parts.add(f"far rod {index}", rod, plain, at, _cylinder(1, 1), _rounded)


# Colours, as sRGB bytes.
_WHITE, _DARK, _SAND = (240, 238, 230), (40, 44, 60), (214, 196, 160)
_RED, _ORANGE, _YELLOW = (214, 40, 44), (240, 130, 30), (250, 208, 46)
_GREEN, _BLUE, _PURPLE, _BRICK = (44, 150, 76), (34, 92, 200), (120, 50, 160), (150, 78, 60)


class _Parts:
    """Collects objects, and joins them to a scene."""

    def __init__(self):
        self.names, self.materials = [], []
        self.vertices, self.faces, self.normals, self.uv = [], [], [], []

    def add(
        self,
        name: str,
        mesh: Any,
        material: Material,
        position: tuple[float | int, float | int, float | int],
        mapping: Callable[[_Corners, _Corners], _UV],
        normals: Callable[[Any], _Corners] | None = None,
    ) -> None:
        """Add `mesh` at `position`.

        `mapping` computes the texture coordinates from corners and normals in the mesh's frame;
        `normals` the corners' normals, which are the faces' if it is None.
        """
        frame = mesh.metadata.get("frame", np.eye(3))
        flat = np.repeat(np.asarray(mesh.face_normals)[:, None], 3, axis=1)
        corners = flat if normals is None else normals(mesh)
        start = sum(map(len, self.vertices))
        self.names.append(name)
        self.materials.append(material)
        self.vertices.append(mesh.vertices + np.asarray(position, float))
        self.faces.append(mesh.faces + start)
        self.normals.append(corners)
        self.uv.append(mapping(np.asarray(mesh.triangles) @ frame, flat @ frame))

    def scene(self, viewpoint: Viewpoint) -> Scene:
        """All objects as one scene."""
        owner = np.repeat(np.arange(len(self.faces)), [len(faces) for faces in self.faces])
        return Scene(
            vertices=np.concatenate(self.vertices),
            faces=np.concatenate(self.faces),
            normals=np.concatenate(self.normals),
            uv=np.concatenate(self.uv),
            colors=np.ones((len(owner), 3, 3)),
            materials=tuple(self.materials),
            face_materials=owner,
            names=tuple(self.names),
            face_objects=owner,
            viewpoint=viewpoint,
        )


def _placed(mesh: Any, rotation: Float[np.ndarray, "3 3"]) -> Any:
    """The mesh rotated in place. Its frame, which texture mappings use, is kept in metadata."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    mesh.apply_transform(transform)
    mesh.metadata["frame"] = rotation @ mesh.metadata.get("frame", np.eye(3))
    return mesh


def _upright(mesh: Any) -> Any:
    """The mesh with its z axis pointing up."""
    return _placed(mesh, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))


def _turned(mesh: Any, angle: float) -> Any:
    """The mesh rotated about the vertical axis by `angle`, in radians."""
    c, s = np.cos(angle), np.sin(angle)
    return _placed(mesh, np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))


def _smooth(mesh: Any) -> _Corners:
    """The vertex normals at the corners."""
    return np.asarray(mesh.vertex_normals)[mesh.faces]


def _rounded(mesh: Any) -> _Corners:
    """A cylinder's corner normals: smooth around its axis (y), flat on its caps."""
    flat = np.repeat(np.asarray(mesh.face_normals)[:, None], 3, axis=1)
    radial = np.asarray(mesh.triangles) * [1, 0, 1]
    return np.where(np.abs(flat[..., 1:2]) > 0.5, flat, radial)


def _flat(size: float) -> Callable[[_Corners, _Corners], _UV]:
    """Texture coordinates by projection along each face's main axis; the period is `size`."""

    def mapping(corners: _Corners, normals: _Corners) -> _UV:
        axis = np.abs(normals[:, 0]).argmax(axis=-1)
        across = np.array([[2, 1], [0, 2], [0, 1]])[axis]
        return np.take_along_axis(corners, across[:, None, :], axis=-1) / size

    return mapping


def _sphere(around: int, up: int) -> Callable[[_Corners, _Corners], _UV]:
    """Texture coordinates by longitude, with `around` repeats, and latitude, with `up`."""

    def mapping(corners: _Corners, normals: _Corners) -> _UV:
        latitude = np.arcsin(np.clip(corners[..., 2] / np.linalg.norm(corners, axis=-1), -1, 1))
        return np.stack([_turns(corners) * around, latitude / np.pi * up], axis=-1)

    return mapping


def _cylinder(
    around: int, up: float | int, slant: float | int = 0
) -> Callable[[_Corners, _Corners], _UV]:
    """Texture coordinates by longitude, with `around` repeats, and height, with `up` per unit.

    `slant` turns of the texture per unit of height wind it around the axis.
    """

    def mapping(corners: _Corners, normals: _Corners) -> _UV:
        turns, height = _turns(corners), corners[..., 2]
        return np.stack([turns * around + height * slant, height * up], axis=-1)

    return mapping


def _torus(around: int, across: int, radius: float) -> Callable[[_Corners, _Corners], _UV]:
    """Texture coordinates by the two angles of a torus about z, of major radius `radius`."""

    def mapping(corners: _Corners, normals: _Corners) -> _UV:
        ring = np.hypot(corners[..., 0], corners[..., 1]) - radius
        tube = np.stack([ring, corners[..., 2]], axis=-1)
        return np.stack([_turns(corners) * around, _turns(tube) * across], axis=-1)

    return mapping


def _turns(corners: Float[np.ndarray, "face 3 _"]) -> Float[np.ndarray, "face 3"]:
    """The angle about the z axis, in turns, without a jump inside any face.

    A corner on the axis, where the angle is undefined, takes the mean of the others.
    """
    x, y = corners[..., 0], corners[..., 1]
    turns = np.arctan2(y, x) / (2 * np.pi)
    on_axis = np.hypot(x, y) < 1e-9
    reference = np.where(on_axis[:, :1], turns[:, 1:2], turns[:, :1])
    turns = turns - np.round(turns - reference)
    others = np.where(on_axis, 0, turns).sum(axis=1) / np.maximum((~on_axis).sum(axis=1), 1)
    return np.where(on_axis, others[:, None], turns)


def _blend(one: Any, other: Any, weight: Float[np.ndarray, "height width"]) -> _Texture:
    """A texture between two colours, with `weight` of the second, in sRGB bytes."""
    mixed = np.asarray(one) + weight[..., None] * (np.asarray(other, float) - np.asarray(one))
    return np.round(np.clip(mixed, 0, 255)).astype(np.uint8)


def _grid(size: int = 128) -> tuple[Float[np.ndarray, "1 size"], Float[np.ndarray, "size 1"]]:
    """The x and y of a square texture's texels, from 0 to 1."""
    centers = (np.arange(size) + 0.5) / size
    return centers[None, :], centers[:, None]


def _step(value: Any, soft: float) -> Any:
    """A linear ramp from 0 to 1 over `soft`, about the value 0."""
    return np.clip(value / soft + 0.5, 0, 1)


def _checker(one: Any, other: Any, soft: float = 0.06) -> _Texture:
    """Two by two checks."""
    x, y = _grid()
    return _blend(one, other, _step(np.sin(2 * np.pi * x) * np.sin(2 * np.pi * y), soft * 4))


def _stripes(one: Any, other: Any, count: int) -> _Texture:
    """`count` pairs of stripes across u."""
    x, y = _grid()
    weight = _step(np.sin(2 * np.pi * count * x) + 0 * y, 0.3)
    return _blend(one, other, weight)


def _dots(one: Any, other: Any) -> _Texture:
    """A disc of the second colour on the first."""
    x, y = _grid()
    return _blend(one, other, _step(0.3 - np.hypot(x - 0.5, y - 0.5), 0.03))


def _tiles() -> _Texture:
    """Four by four tiles of different colours, with dark joints."""
    palette = np.array([_RED, _YELLOW, _BLUE, _WHITE, _GREEN, _ORANGE, _PURPLE, _SAND])
    count, size = 4, 256
    colors = np.random.default_rng(7).permutation(np.tile(palette, (2, 1)))
    x, y = _grid(size)
    index = (x * count).astype(int) + count * (y * count).astype(int)
    edge = np.minimum(
        *(0.5 - np.abs(along * count % 1 - 0.5) for along in np.broadcast_arrays(x, y))
    )
    weight = _step(edge - 0.06, 0.04)
    dark = np.asarray(_DARK, float)
    return np.round(dark + weight[..., None] * (colors[index] - dark)).astype(np.uint8)


def _noise(one: Any, other: Any, seed: int = 1) -> _Texture:
    """Bands of two colours by periodic noise of four octaves."""
    random, size = np.random.default_rng(seed), 256
    total = np.zeros((size, size))
    for octave in range(4):
        cells = 4 << octave
        lattice = random.uniform(-1, 1, (cells, cells))
        total += _smooth_lattice(lattice, size) / (1 << octave)
    return _blend(one, other, 0.5 + 0.5 * np.sin(5 * total))


def _smooth_lattice(
    lattice: Float[np.ndarray, "cell cell"], size: int
) -> Float[np.ndarray, "size size"]:
    """A periodic lattice of values, interpolated by a cubic to `size` samples per side."""
    cells = len(lattice)
    position = (np.arange(size) + 0.5) / size * cells
    first = position.astype(int)
    weight = position - first
    weight = weight * weight * (3 - 2 * weight)
    rows = np.zeros((size, cells))
    rows[np.arange(size), first] += 1 - weight
    rows[np.arange(size), (first + 1) % cells] += weight
    return rows @ lattice @ rows.T
