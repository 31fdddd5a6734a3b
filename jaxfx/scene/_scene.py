"""A scene: triangles with their attributes and materials, in NumPy arrays."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Int

from jaxfx.scene._material import Material


class Viewpoint(NamedTuple):
    """A view that suits a scene: `default_camera` takes it.

    **Arguments:**

    - `eye`, `at`: world positions, 3: of the camera, and of what it looks at.
    - `fov`: field of view along the shorter side of the image, in radians.

    **Gradient:** none; the host side.

    **Example:**

    >>> from jaxfx import scene
    >>> scene.Viewpoint(eye=(0.0, 1.0, 0.0), at=(0.0, 0.0, -3.0), fov=0.8).at
    (0.0, 0.0, -3.0)
    """

    eye: tuple[float, float, float]
    at: tuple[float, float, float]
    fov: float


@final
@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Scene:
    """Triangles in world space with normals, texture coordinates, colours and materials.

    `load`, `from_trimesh` and `still_life` make one, or arrays of your own. World axes are the
    mesh file's (y up in most of them). The arrays are copied and read-only, since the backends
    keep what they build from them.

    **Arguments:**

    - `vertices`: vertex 3, world positions, in scene units.
    - `faces`: face 3, indices of vertices, counter-clockwise seen from the front.
    - `normals`: face 3 3, each corner's normal, in world space. Their sign does not matter.
    - `uv`: face 3 2, each corner's texture coordinates; v points up, and the image covers
      [0, 1] of both.
    - `colors`: face 3 3, each corner's linear RGB, which multiplies the material's.
    - `materials`, `face_materials`: the materials, and every face's index into them.
    - `names`, `face_objects`: the objects' names, and every face's index into them.
    - `viewpoint`: the view that `default_camera` takes, or None for one by the bounding box.
    - `second_uv`: face 3 2, a second set of texture coordinates, for textures whose `Sampler`
      has `use_second_uv`; or None.

    **Raises:** `ValueError` where there is no triangle, a number is not finite, or shapes and
    indices do not fit one another.

    **Gradient:** none; the host side.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import scene
    >>> triangle = scene.Scene(
    ...     vertices=np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]),
    ...     faces=np.array([[0, 1, 2]]),
    ...     normals=np.broadcast_to([0.0, 0, 1], (1, 3, 3)),
    ...     uv=np.zeros((1, 3, 2)),
    ...     colors=np.ones((1, 3, 3)),
    ...     materials=(scene.Material(),),
    ...     face_materials=np.array([0]),
    ...     names=("triangle",),
    ...     face_objects=np.array([0]),
    ... )
    >>> triangle
    Scene(1 triangles, 1 objects, 1 x 1 x 0)
    """

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    normals: Float[np.ndarray, "face 3 3"]
    uv: Float[np.ndarray, "face 3 2"]
    colors: Float[np.ndarray, "face 3 3"]
    materials: tuple[Material, ...]
    face_materials: Int[np.ndarray, " face"]
    names: tuple[str, ...]
    face_objects: Int[np.ndarray, " face"]
    viewpoint: Viewpoint | None = None
    second_uv: Float[np.ndarray, "face 3 2"] | None = None

    def __post_init__(self):
        count = len(self.faces)
        if count == 0:
            raise ValueError("`Scene(faces=...)` must hold at least one triangle, got none.")
        for name, (shape, dtype) in {
            "vertices": ((len(self.vertices), 3), np.float64),
            "faces": ((count, 3), np.int32),
            "normals": ((count, 3, 3), np.float32),
            "uv": ((count, 3, 2), np.float32),
            "colors": ((count, 3, 3), np.float32),
            "face_materials": ((count,), np.int32),
            "face_objects": ((count,), np.int32),
            "second_uv": ((count, 3, 2), np.float32),
        }.items():
            value = getattr(self, name)
            if name == "second_uv" and value is None:
                continue
            if np.shape(value) != shape:
                raise ValueError(
                    f"`Scene({name}=...)` must have shape {shape}, got {np.shape(value)}."
                )
            with np.errstate(over="ignore"):  # The next check refuses what overflows.
                copied = np.array(value, dtype, order="C")
            self._require_finite(name, copied)
            copied.flags.writeable = False
            object.__setattr__(self, name, copied)
        self._require_index("faces", len(self.vertices))
        self._require_index("face_materials", len(self.materials))
        self._require_index("face_objects", len(self.names))
        samplers = [s for material in self.materials for s in material.samplers.values()]
        if self.second_uv is None and any(sampler.use_second_uv for sampler in samplers):
            raise ValueError(
                "`Scene(second_uv=...)` must be given for a `Sampler` that uses it, got None."
            )

    def _require_finite(self, name: str, value: np.ndarray) -> None:
        """Raise `ValueError` that names the first vertex or face which is not finite."""
        wrong = ~np.isfinite(value).reshape(len(value), -1).all(axis=1)
        if wrong.any():
            item = "vertex" if name == "vertices" else "face"
            raise ValueError(
                f"`Scene({name}=...)` must be finite, got {value[wrong][0].tolist()} at "
                f"{item} {wrong.argmax()}; {wrong.sum()} of {wrong.size} are wrong."
            )

    def _require_index(self, name: str, count: int) -> None:
        """Raise `ValueError` unless all values of a field are in [0, count)."""
        value = getattr(self, name)
        if value.min() < 0 or value.max() >= count:
            raise ValueError(
                f"`Scene({name}=...)` must be indices in [0, {count}), "
                f"got {value.min()} to {value.max()}."
            )

    def __repr__(self) -> str:
        sides = " x ".join(f"{side:.4g}" for side in self.extent)
        return f"Scene({len(self.faces)} triangles, {len(self.names)} objects, {sides})"

    @cached_property
    def points(self) -> Float[np.ndarray, "point 3"]:
        """The vertices that faces use: point 3, world positions."""
        return self.vertices[np.unique(self.faces)]

    @cached_property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """The smallest and the largest coordinates of the triangles: 2 3."""
        points = self.points
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """The middle of the bounding box: 3, a world position."""
        return self.bounds.mean(axis=0)

    @property
    def extent(self) -> Float[np.ndarray, "3"]:
        """The sides of the bounding box: 3, in scene units."""
        return self.bounds[1] - self.bounds[0]

    @property
    def radius(self) -> float:
        """Half the diagonal of the bounding box, in scene units; 1 where all is one point."""
        return float(np.linalg.norm(self.extent)) / 2 or 1.0

    @cached_property
    def unit_triangles(self) -> Float[np.ndarray, "face 3 3"]:
        """The corners, face 3 3, float32, moved and scaled into the unit ball about the origin.

        The backends find visible faces with these. So float32 suffices for scenes that are tiny
        or far from the origin, too.
        """
        unit = (self.vertices - self.center) / self.radius
        return np.ascontiguousarray(unit.astype(np.float32)[self.faces])
