"""Lenses: from depth to the diameter of the circle of confusion, in pixels.

| I want | call |
|---|---|
| a lens on a camera of the scene | `ThinLens.from_camera` |
| a photographer's lens, focused by moving it | `ThinLens.from_physical` |
| Blender's lens, or any whose sensor stays at the focal length | `ThinLens.from_sensor` |
| strength and focus in a disparity, as most tools take them | `ThinLens.from_disparity` |
| blurriness between three planes, as an artist sets it | `FocusPlanes` |
| a lens of my own | any object with the three members of `Lens` |
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, final, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import (
    WholeNumber,
    check,
    check_fields,
    parameter,
    whole_number,
    with_numbers,
)
from jaxfx._numerics import absolute, clip01, one_program, working_dtype
from jaxfx.camera import PinholeCamera


__all__ = ["FocusPlanes", "Lens", "ThinLens"]

# Depths as people have them: arrays, numbers and lists, of floats or integers.
_Depths = Num[ArrayLike, "*shape"] | float | int | Sequence[Any]


@runtime_checkable
class Lens(Protocol):
    """A lens as every method of depth of field takes it: any object with these three members.

    A lens of your own that is a pytree, an `equinox.Module` say, is differentiated, batched and
    compiled as ours are. Any other object is asked once per call, outside the compiled program.

        class Clipped(eqx.Module):
            lens: jaxfx.ThinLens
            largest: float

            @property
            def focus_distance(self):
                return self.lens.focus_distance

            def defocus(self, depth):
                return jnp.clip(self.lens.defocus(depth), -self.largest, self.largest)

            def circle_of_confusion(self, depth):
                return abs(self.defocus(depth))
    """

    @property
    def focus_distance(self) -> Any:
        """Depth of the plane in focus: a scalar, in scene units."""
        ...

    def defocus(self, depth: Any, /) -> Any:
        """Signed diameter of the circle of confusion.

        **Arguments:** `depth`: any shape, scene units; inf is background.

        **Returns:** pixels, of the depth's shape: negative in front of the focus plane.

        **Gradient:** the lens' own.
        """
        ...

    def circle_of_confusion(self, depth: Any, /) -> Any:
        """Diameter of the circle of confusion: `|defocus(depth)|`.

        **Arguments:** `depth`: any shape, scene units; inf is background.

        **Returns:** pixels, of the depth's shape.

        **Gradient:** the lens' own.
        """
        ...


def _all_positive(*values: Array) -> Array:
    return jnp.stack([value > 0 for value in values]).all()


# Width of a sensor over the focal length. Rectilinear lenses have up to 4, telescopes down
# to 1/500; millimetres taken for metres make it 1000 times as large or as small.
MIN_SENSOR_PER_FOCAL, MAX_SENSOR_PER_FOCAL = 1e-3, 50.0

_positive = lambda v: v > 0
_not_negative = lambda v: v >= 0


def _finite(name: str, value: Any, valid: Any, expected: str) -> Float[Array, ""]:
    number = parameter(name, value)
    check(name, number, lambda v: valid(v) & (v < np.inf), expected)
    return number


def _checked(lens: Any, method: str, depth: Any) -> Array:
    """The depth as an array, in its own float type, for a method of one of the lenses here."""
    check_fields(f"{type(lens).__name__}.{method}", lens)
    return parameter(f"{method}(depth)", depth, None)


@one_program
def _defocus(lens: Any, depth: Array) -> Array:
    """A lens' factor of the defocus times the depth's."""
    scale, factor = lens._factors(depth.astype(working_dtype(depth.dtype)))
    return (scale * factor).astype(depth.dtype)


@one_program
def _circle_of_confusion(lens: Any, depth: Array) -> Array:
    """A lens' factor of the defocus times the size of the depth's."""
    scale, factor = lens._factors(depth.astype(working_dtype(depth.dtype)))
    return (scale * absolute(factor)).astype(depth.dtype)


@one_program
def _of_disparity(
    strength: Array, scale: Array, focus_disparity: Array, shift: Array
) -> tuple[tuple[Array, Array, Array], Array]:
    """The fields of `ThinLens.from_disparity`, and the inverse depth in focus."""
    inverse_depth = scale * focus_disparity + shift
    is_near = inverse_depth > 0
    distance = jnp.where(is_near, 1 / jnp.where(is_near, inverse_depth, 1), jnp.inf)
    # A disparity that is traced may turn out to have no depth: no lens has one either.
    distance = jnp.where(inverse_depth < 0, jnp.nan, distance)
    return (strength / scale, distance, jnp.ones_like(strength)), inverse_depth


@final
class ThinLens(eqx.Module):
    """A thin lens, by the three numbers that an image can tell.

    A pixel at depth Z is spread over a disc of diameter `aperture * focal_pixels *
    |1 / focus_distance - 1 / Z|` pixels. The focal length and the display scale of the physical
    form can't be told apart from the aperture by any image, so they are not kept;
    `from_physical` takes them.

    **Arguments:**

    - `aperture`: diameter of the lens, in scene units; 0 is a pinhole.
    - `focus_distance`: depth of the plane in focus, in scene units; inf is focus at infinity.
    - `focal_pixels`: the camera's focal length in pixels.

    **Raises:** `ValueError` for a negative aperture, or a focus distance or focal length that
    is not positive. Traced values can't be looked at: there a bad lens makes every defocus NaN.

    **Gradient:** exact with respect to all three.

    **Example:**

    >>> from jaxfx import ThinLens
    >>> lens = ThinLens(aperture=0.1, focus_distance=2.0, focal_pixels=100.0)
    >>> print(lens.circle_of_confusion([2.0, 4.0]))
    [0.  2.5]

    Source: Potmesil & Chakravarty 1981, the circle of confusion of a thin lens.
    """

    SHAPES: ClassVar = {"aperture": (), "focus_distance": (), "focal_pixels": ()}

    aperture: Float[Array, ""]
    focus_distance: Float[Array, ""]
    focal_pixels: Float[Array, ""]

    def __repr__(self) -> str:
        return with_numbers(self)

    def __init__(self, aperture: Any, focus_distance: Any, focal_pixels: Any):
        name = "ThinLens(focus_distance)"
        self.aperture = _finite("ThinLens(aperture)", aperture, _not_negative, "0 or positive")
        self.focus_distance = parameter(name, focus_distance)
        check(name, self.focus_distance, _positive, "positive")
        self.focal_pixels = _finite(
            "ThinLens(focal_pixels)", focal_pixels, _positive, "positive"
        )

    @classmethod
    def from_camera(
        cls, camera: PinholeCamera, *, aperture: Any, focus_distance: Any
    ) -> "ThinLens":
        """A lens on `camera`.

        **Arguments:**

        - `camera`: its focal length is taken; where x and y differ, the geometric mean, which
          keeps the disc's area.
        - `aperture`, `focus_distance`: scene units.

        **Returns:** the lens.

        **Raises:** `ValueError` for a camera that is no pinhole, or as `ThinLens`.

        **Gradient:** exact, in the camera's focal length too.

        **Example:**

        >>> from jaxfx import PinholeCamera, ThinLens
        >>> camera = PinholeCamera.from_fov(1.0, height=8, width=8)
        >>> lens = ThinLens.from_camera(camera, aperture=0.1, focus_distance=2.0)
        >>> bool(lens.focal_pixels == camera.intrinsics[0, 0])
        True
        """
        if not isinstance(camera, PinholeCamera):
            kind = type(camera).__name__
            raise ValueError(f"`from_camera(camera)` must be a PinholeCamera, got {kind}.")
        check_fields("from_camera(camera)", camera)
        intrinsics = camera.intrinsics
        return cls(aperture, focus_distance, jnp.sqrt(intrinsics[0, 0] * intrinsics[1, 1]))

    @classmethod
    def from_physical(
        cls,
        *,
        focal_length: Any,
        aperture: Any | None = None,
        f_number: Any | None = None,
        focus_distance: Any,
        pixels_per_unit: Any,
    ) -> "ThinLens":
        """A lens from its physical numbers, all lengths in one unit.

        **Arguments:**

        - `focal_length`: F, a length.
        - `aperture`: the lens' diameter, a length; or else `f_number`.
        - `f_number`: the ratio `focal_length / aperture`; or else `aperture`.
        - `focus_distance`: depth in focus, a length greater than `focal_length`.
        - `pixels_per_unit`: pixels per unit of length on the sensor.

        **Returns:** the lens: `focal_pixels` is the image distance of the focus plane,
        `F Zf / (Zf - F)`, times `pixels_per_unit`.

        **Raises:** `ValueError` for both or neither of `aperture` and `f_number`, or a focus
        distance within the focal length.

        **Gradient:** exact.

        **Example:** 50 mm at f/2, focused at 2 m, on a sensor of 100 pixels per mm.

        >>> from jaxfx import ThinLens
        >>> lens = ThinLens.from_physical(
        ...     focal_length=50.0, f_number=2.0, focus_distance=2000.0, pixels_per_unit=100.0
        ... )
        >>> print(f"{lens.aperture:.1f} {lens.focal_pixels:.1f}")
        25.0 5128.2

        Source: Potmesil & Chakravarty 1981, image distance and circle of confusion.
        """
        if (aperture is None) == (f_number is None):
            raise ValueError(
                "`from_physical(aperture=..., f_number=...)` must be given one of the two, "
                f"got {'neither' if aperture is None else 'both'}."
            )
        name = "from_physical(focal_length=...)"
        focal_length = _finite(name, focal_length, _positive, "positive")
        name = "from_physical(focus_distance=...)"
        distance = parameter(name, focus_distance)
        name_of_scale = "from_physical(pixels_per_unit=...)"
        scale = _finite(name_of_scale, pixels_per_unit, _positive, "positive")
        margin = distance - focal_length
        check(
            name,
            margin,
            lambda v: v > 0,
            "beyond `focal_length` (focus_distance - focal_length > 0)",
        )
        if aperture is None:
            name = "from_physical(f_number=...)"
            aperture = focal_length / _finite(name, f_number, _positive, "positive")
        # A quotient that focus at infinity has as well.
        image_distance = focal_length / (1 - focal_length / distance)
        return cls(aperture, distance, image_distance * scale)

    @classmethod
    def from_sensor(
        cls,
        focal_length: Any,
        f_number: Any,
        focus_distance: Any,
        sensor_width: Any,
        width: WholeNumber,
    ) -> "ThinLens":
        """A lens that stays where it is when it focuses, as Blender's does.

        A real lens moves away from the sensor to focus nearer, and so shows less of the scene,
        larger: `from_physical`, by a factor of `focus_distance / (focus_distance -
        focal_length)`, 2 % at 2.6 m for 50 mm. Blender's sensor stays at the focal length.

        **Arguments:**

        - `focal_length`, `focus_distance`, `sensor_width`: lengths, all in one unit. Blender's
          are in millimetres, but for the distance.
        - `f_number`: the ratio of the focal length to the aperture.
        - `width`: static; pixels along the side that `sensor_width` fits: of Blender's "AUTO",
          the longer one.

        **Returns:** the lens: `focal_pixels` is `focal_length / sensor_width * width`, and
        `aperture` is `focal_length / f_number`.

        **Raises:** `ValueError` for a number that is not positive, or a focus distance within
        the focal length or a ratio of sensor and focal length that no lens has, as millimetres
        beside metres give them.

        **Gradient:** exact.

        **Example:** 50 mm at f/2, focused at 2 m, on a sensor 36 mm and 720 pixels wide.

        >>> from jaxfx import ThinLens
        >>> lens = ThinLens.from_sensor(0.050, 2.0, 2.0, 0.036, 720)
        >>> print(f"{lens.aperture:.3f} {lens.focal_pixels:.0f}")
        0.025 1000

        Source: Blender's Cycles, whose lens is `focal_length / (2 f_number)` in radius and
        whose rays through a pixel meet in the plane in focus.
        """
        focal_length, f_number, sensor_width = (
            _finite(f"from_sensor({name})", value, _positive, "positive")
            for name, value in (
                ("focal_length", focal_length),
                ("f_number", f_number),
                ("sensor_width", sensor_width),
            )
        )
        name = "from_sensor(focus_distance)"
        distance = parameter(name, focus_distance)
        # Blender's own numbers, 50 mm and 2.6 m, would be a lens 17.9 m wide at f/2.8.
        expected = "beyond `focal_length`, both in one unit (focus_distance - focal_length > 0)"
        check(name, distance - focal_length, _positive, expected)
        # One in metres and one in millimetres: a view of 180 degrees, or of a tenth of one.
        check(
            "from_sensor(sensor_width)",
            sensor_width / focal_length,
            lambda v: (v > MIN_SENSOR_PER_FOCAL) & (v < MAX_SENSOR_PER_FOCAL),
            "in the unit of `focal_length` (sensor_width / focal_length from 1/1000 to 50)",
        )
        width = whole_number("from_sensor(width)", width)
        return cls(focal_length / f_number, distance, focal_length / sensor_width * width)

    @classmethod
    def from_disparity(
        cls, *, strength: Any, focus_disparity: Any, scale: Any = 1.0, shift: Any = 0.0
    ) -> "ThinLens":
        """A lens by the two numbers that go with a disparity, of a network or a stereo pair.

        With `depth = depth.from_disparity(disparity, scale=scale, shift=shift)`, its defocus is
        `strength * (focus_disparity - disparity)` pixels, whatever `scale` and `shift` are.

        **Arguments:**

        - `strength`: K, pixels of the circle of confusion's diameter per step of disparity.
          Tools that state a radius, as BokehMe does, have half of it.
        - `focus_disparity`: the disparity in focus, in its own unit, steps.
        - `scale`, `shift`: inverse scene units of one step, and of a disparity of 0: those of
          `depth.from_disparity`. Without a scale the depth is the inverse of the disparity.

        **Returns:** the lens: `focus_distance` is `1 / (scale * focus_disparity + shift)`,
        `aperture` is `strength / scale` and `focal_pixels` is 1, of which only the product with
        the aperture counts. Back again, `strength` is `aperture * focal_pixels * scale` and
        `focus_disparity` is `(1 / focus_distance - shift) / scale`.

        **Raises:** `ValueError` for a negative strength, a scale that is not positive, or a
        disparity in focus whose depth is negative. A focus at a disparity that stands for depth
        inf is focus at infinity.

        **Gradient:** exact; zero in `focus_disparity` and `shift` at infinity.

        **Example:**

        >>> import numpy as np
        >>> from jaxfx import ThinLens, depth
        >>> lens = ThinLens.from_disparity(strength=20.0, focus_disparity=0.75)
        >>> disparity = np.array([[1.0, 0.75, 0.0]], np.float32)
        >>> print(lens.defocus(depth.from_disparity(disparity, scale=1.0)))
        [[-5.  0. 15.]]

        No image tells `scale` and `shift` of a disparity from the lens: the defocus has
        neither. `gamma` of `dof.scatter`, which reads depth itself, changes with `shift`.

        Source: Peng et al. 2022 (BokehMe) and the tools after it, for the two numbers; the
        algebra is that of the thin lens.
        """
        strength, scale = (
            _finite(f"from_disparity({name}=...)", value, valid, expected)
            for name, value, valid, expected in (
                ("strength", strength, _not_negative, "0 or positive"),
                ("scale", scale, _positive, "positive"),
            )
        )
        name = "from_disparity(focus_disparity=...)"
        focus_disparity = parameter(name, focus_disparity)
        shift = parameter("from_disparity(shift=...)", shift)
        fields, inverse_depth = _of_disparity(strength, scale, focus_disparity, shift)
        expected = "at a depth (scale * focus_disparity + shift >= 0)"
        check(name, inverse_depth, lambda v: (v >= 0) & np.isfinite(v), expected)
        return cls(*fields)

    def _factors(self, depth: Array) -> tuple[Array, Array]:
        """The lens' factor of the defocus, never negative, and the depth's, with the sign."""
        aperture, distance, focal = (
            x.astype(depth.dtype)
            for x in (self.aperture, self.focus_distance, self.focal_pixels)
        )
        valid = _all_positive(distance, focal) & (aperture >= 0)
        scale = jnp.where(valid, aperture * focal, jnp.nan)
        # At depth 0 a zero aperture would give 0 * inf.
        inverse = 1 / jnp.where((scale == 0) & (depth == 0), 1, depth)
        return scale, 1 / distance - inverse

    def defocus(self, depth: _Depths) -> Float[Array, "*shape"]:
        """Signed diameter of the circle of confusion.

        **Arguments:** `depth`: any shape, scene units, floats or integers; inf is allowed.

        **Returns:** pixels, in the type of `depth`, of integers in JAX's default float type:
        negative in front of the focus plane, 0 on it, `aperture * focal_pixels /
        focus_distance` at infinity, -inf at depth 0.

        **Raises:** `ValueError` for what is no array of numbers, or a batch of lenses.

        **Gradient:** exact; not finite at depth 0.
        """
        return _defocus(self, _checked(self, "defocus", depth))

    def circle_of_confusion(self, depth: _Depths) -> Float[Array, "*shape"]:
        """Diameter of the circle of confusion: `|defocus(depth)|`.

        **Arguments:** `depth`: any shape, scene units, floats or integers; inf is allowed.

        **Returns:** pixels, in the type of `depth`, of integers in JAX's default float type.

        **Raises:** `ValueError` as `defocus`.

        **Gradient:** exact; on the focus plane, a kink, the one from behind it.
        """
        return _circle_of_confusion(self, _checked(self, "circle_of_confusion", depth))


@final
class FocusPlanes(eqx.Module):
    """Piecewise-linear blurriness between three planes, as an artist sets it.

    Nothing is sharper than at `focus`; at `near` and before, at `far` and behind, the circle of
    confusion is `max_coc`.

    **Arguments:**

    - `near`, `focus`, `far`: depths in scene units, `near < focus < far`. A `far` of inf is
      never reached: all behind `focus` is sharp.
    - `max_coc`: the largest diameter, in pixels.

    **Raises:** `ValueError` where the planes are out of order or `max_coc` is negative. Traced
    values can't be looked at: there bad planes make every defocus NaN.

    **Gradient:** exact with respect to all four; a clamped depth has none.

    **Example:**

    >>> from jaxfx import FocusPlanes
    >>> lens = FocusPlanes(near=1.0, focus=2.0, far=4.0, max_coc=8.0)
    >>> print(lens.circle_of_confusion([2.0, 3.0, 9.0]))
    [0. 4. 8.]

    Source: Scheuermann 2004, advanced depth of field.
    """

    SHAPES: ClassVar = {"near": (), "focus": (), "far": (), "max_coc": ()}

    near: Float[Array, ""]
    focus: Float[Array, ""]
    far: Float[Array, ""]
    max_coc: Float[Array, ""]

    def __repr__(self) -> str:
        return with_numbers(self)

    def __init__(self, near: Any, focus: Any, far: Any, max_coc: Any):
        self.near = parameter("FocusPlanes(near)", near)
        self.focus = parameter("FocusPlanes(focus)", focus)
        self.far = parameter("FocusPlanes(far)", far)
        self.max_coc = _finite("FocusPlanes(max_coc)", max_coc, _not_negative, "0 or positive")
        check("FocusPlanes(near)", self.near, np.isfinite, "finite")
        ahead, behind = self.focus - self.near, self.far - self.focus
        check("FocusPlanes(near)", ahead, lambda v: v > 0, "before `focus` (focus - near > 0)")
        check("FocusPlanes(far)", behind, lambda v: v > 0, "behind `focus` (far - focus > 0)")

    @property
    def focus_distance(self) -> Float[Array, ""]:
        """Depth of the plane in focus, in scene units, under the name that `ThinLens` has."""
        return self.focus

    def _factors(self, depth: Array) -> tuple[Array, Array]:
        """`max_coc`, and the depth's factor of the defocus, from -1 to 1."""
        near, focus, far, max_coc = (
            x.astype(depth.dtype) for x in (self.near, self.focus, self.far, self.max_coc)
        )
        valid = _all_positive(focus - near, far - focus) & (max_coc >= 0)
        # Beyond the planes nothing changes; an infinite quotient would have a NaN derivative.
        depth = jnp.where(depth >= far, far, jnp.where(depth <= near, near, depth))
        is_ahead = depth < focus
        ahead = clip01((focus - jnp.where(is_ahead, depth, focus)) / (focus - near))
        ends = far < jnp.inf
        behind = jnp.where(ends, depth - focus, 0) / jnp.where(ends, far - focus, 1)
        behind = clip01(behind)
        scale = jnp.where(valid, max_coc, jnp.nan)
        return scale, jnp.where(is_ahead, -ahead, behind)

    def defocus(self, depth: _Depths) -> Float[Array, "*shape"]:
        """Signed diameter of the circle of confusion.

        **Arguments:** `depth`: any shape, scene units, floats or integers; inf is allowed.

        **Returns:** pixels, in the type of `depth`, of integers in JAX's default float type,
        within `[-max_coc, max_coc]`: negative in front of the focus plane.

        **Raises:** `ValueError` for what is no array of numbers, or a batch of lenses.

        **Gradient:** exact, with zero where clamped.
        """
        return _defocus(self, _checked(self, "defocus", depth))

    def circle_of_confusion(self, depth: _Depths) -> Float[Array, "*shape"]:
        """Diameter of the circle of confusion: `|defocus(depth)|`.

        **Arguments:** `depth`: any shape, scene units, floats or integers; inf is allowed.

        **Returns:** pixels, in the type of `depth`, of integers in JAX's default float type.

        **Raises:** `ValueError` as `defocus`.

        **Gradient:** exact; on the focus plane, a kink, the one from behind it.
        """
        return _circle_of_confusion(self, _checked(self, "circle_of_confusion", depth))
