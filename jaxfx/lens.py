"""Lenses: from depth to the diameter of the circle of confusion, in pixels."""

from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._checks import check, parameter
from jaxfx._numerics import absolute, clip01
from jaxfx.camera import PinholeCamera


__all__ = ["FocusPlanes", "ThinLens"]


def _all_positive(*values: Array) -> Array:
    return jnp.stack([value > 0 for value in values]).all()


@final
class ThinLens(eqx.Module):
    """A thin lens as an image can know it: three numbers.

    A pixel at depth Z is spread over a disc of diameter `aperture * focal_pixels *
    |1 / focus_distance - 1 / Z|` pixels. The focal length and the display scale of the physical
    form can't be told apart from the aperture by any image, so they are not kept;
    `from_physical` takes them.

    **Arguments:**

    - `aperture`: diameter of the lens, in scene units; 0 is a pinhole.
    - `focus_distance`: depth of the plane in focus, in scene units.
    - `focal_pixels`: the camera's focal length in pixels.

    **Raises:** `ValueError` for a negative aperture, or a focus distance or focal length that
    is not positive. Traced values can't be looked at: there a bad lens makes every defocus NaN.

    **Gradient:** exact with respect to all three.

    Source: Potmesil & Chakravarty 1981, the circle of confusion of a thin lens.
    """

    aperture: Float[Array, ""]
    focus_distance: Float[Array, ""]
    focal_pixels: Float[Array, ""]

    def __init__(self, aperture: Any, focus_distance: Any, focal_pixels: Any):
        self.aperture = parameter("ThinLens(aperture)", aperture)
        self.focus_distance = parameter("ThinLens(focus_distance)", focus_distance)
        self.focal_pixels = parameter("ThinLens(focal_pixels)", focal_pixels)
        check("ThinLens(aperture)", self.aperture, lambda v: v >= 0, "0 or positive")
        check("ThinLens(focus_distance)", self.focus_distance, lambda v: v > 0, "positive")
        check("ThinLens(focal_pixels)", self.focal_pixels, lambda v: v > 0, "positive")

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

        **Gradient:** exact, in the camera's focal length too.
        """
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

        Source: Potmesil & Chakravarty 1981, image distance and circle of confusion.
        """
        if (aperture is None) == (f_number is None):
            raise ValueError(
                "`from_physical(aperture=..., f_number=...)` must be given one of the two, "
                f"got {'neither' if aperture is None else 'both'}."
            )
        focal_length = parameter("from_physical(focal_length=...)", focal_length)
        name = "from_physical(focus_distance=...)"
        distance = parameter(name, focus_distance)
        scale = parameter("from_physical(pixels_per_unit=...)", pixels_per_unit)
        margin = distance - focal_length
        check(
            name,
            margin,
            lambda v: v > 0,
            "beyond `focal_length` (focus_distance - focal_length > 0)",
        )
        if aperture is None:
            aperture = focal_length / parameter("from_physical(f_number=...)", f_number)
        return cls(aperture, distance, focal_length * distance / margin * scale)

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

    def defocus(self, depth: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Signed diameter of the circle of confusion.

        **Arguments:** `depth`: any shape, scene units; inf is allowed.

        **Returns:** pixels, in the type of `depth`: negative in front of the focus plane,
        0 on it, `aperture * focal_pixels / focus_distance` at infinity, -inf at depth 0.

        **Gradient:** exact; not finite at depth 0.
        """
        scale, difference = self._factors(jnp.asarray(depth))
        return scale * difference

    def circle_of_confusion(self, depth: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Diameter of the circle of confusion: `|defocus(depth)|`.

        **Arguments:** `depth`: any shape, scene units; inf is allowed.

        **Returns:** pixels, in the type of `depth`.

        **Gradient:** exact; on the focus plane, a kink, the one from behind it.
        """
        scale, difference = self._factors(jnp.asarray(depth))
        return scale * absolute(difference)


@final
class FocusPlanes(eqx.Module):
    """Piecewise-linear blurriness between three planes, as an artist sets it.

    Nothing is sharper than at `focus`; at `near` and before, at `far` and behind, the circle of
    confusion is `max_coc`.

    **Arguments:**

    - `near`, `focus`, `far`: depths in scene units, `near < focus < far`.
    - `max_coc`: the largest diameter, in pixels.

    **Raises:** `ValueError` where the planes are out of order or `max_coc` is negative. Traced
    values can't be looked at: there bad planes make every defocus NaN.

    **Gradient:** exact with respect to all four; a clamped depth has none.

    Source: Scheuermann 2004, advanced depth of field.
    """

    near: Float[Array, ""]
    focus: Float[Array, ""]
    far: Float[Array, ""]
    max_coc: Float[Array, ""]

    def __init__(self, near: Any, focus: Any, far: Any, max_coc: Any):
        self.near = parameter("FocusPlanes(near)", near)
        self.focus = parameter("FocusPlanes(focus)", focus)
        self.far = parameter("FocusPlanes(far)", far)
        self.max_coc = parameter("FocusPlanes(max_coc)", max_coc)
        ahead, behind = self.focus - self.near, self.far - self.focus
        check("FocusPlanes(near)", ahead, lambda v: v > 0, "before `focus` (focus - near > 0)")
        check("FocusPlanes(far)", behind, lambda v: v > 0, "behind `focus` (far - focus > 0)")
        check("FocusPlanes(max_coc)", self.max_coc, lambda v: v >= 0, "0 or positive")

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
        ahead = clip01((focus - depth) / (focus - near))
        behind = clip01((depth - focus) / (far - focus))
        scale = jnp.where(valid, max_coc, jnp.nan)
        return scale, jnp.where(depth < focus, -ahead, behind)

    def defocus(self, depth: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Signed diameter of the circle of confusion.

        **Arguments:** `depth`: any shape, scene units; inf is allowed.

        **Returns:** pixels, in the type of `depth`, within `[-max_coc, max_coc]`: negative in
        front of the focus plane.

        **Gradient:** exact, with zero where clamped.
        """
        scale, ramp = self._factors(jnp.asarray(depth))
        return scale * ramp

    def circle_of_confusion(self, depth: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Diameter of the circle of confusion: `|defocus(depth)|`.

        **Arguments:** `depth`: any shape, scene units; inf is allowed.

        **Returns:** pixels, in the type of `depth`.

        **Gradient:** exact; on the focus plane, a kink, the one from behind it.
        """
        scale, ramp = self._factors(jnp.asarray(depth))
        return scale * absolute(ramp)
