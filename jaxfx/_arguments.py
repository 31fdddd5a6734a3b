"""Checks of arguments that are cameras, lenses, lights or caches: the right type, and no batch.

A camera, lens or light whose fields have a leading axis is a batch. Without `jax.vmap` its
fields would be broadcast against an image's rows and columns, and no error raised.
"""

from collections.abc import Sequence
from typing import Any, get_args

import jax
from jaxtyping import Array

from jaxfx._checks import (
    as_array,
    check_fields,
    check_shape,
    items,
    parameter,
    share,
    shares,
)
from jaxfx.camera import Camera
from jaxfx.gbuffer import GBuffer
from jaxfx.lens import FocusPlanes, Lens, ThinLens
from jaxfx.light import EnvironmentLight, Light, SphericalHarmonicsLight


# How many numbers per pixel an occlusion may have: of degree 2 or 3.
OCCLUSION_COUNTS = (9, 16)


def check_camera(name: str, camera: Any, kind: Any = Camera) -> None:
    """Raise `ValueError` unless `camera` is a single camera of the type, or union, `kind`."""
    if not isinstance(camera, kind):
        kinds = " or ".join(f"a {cls.__name__}" for cls in get_args(kind) or (kind,))
        kinds = kinds.replace("a O", "an O")
        raise ValueError(f"`{name}` must be {kinds}, got {type(camera).__name__}.")
    check_fields(name, camera)


def check_lens(name: str, lens: Any) -> None:
    """Raise `ValueError` unless `lens` is a single lens."""
    if isinstance(lens, type) or not isinstance(lens, Lens):
        raise ValueError(
            f"`{name}` must be a lens, with `defocus(depth)`, `circle_of_confusion(depth)` and "
            f"`focus_distance`, as a ThinLens is, got {lens!r:.60}."
        )
    if isinstance(lens, ThinLens | FocusPlanes):
        check_fields(name, lens)
    check_shape(f"{name}.focus_distance", lens.focus_distance, ())


def check_light(name: str, light: Any, kind: Any = Light) -> None:
    """Raise `ValueError` unless `light` is a single light of the type, or union, `kind`."""
    if not isinstance(light, kind):
        kinds = ", ".join(cls.__name__ for cls in get_args(kind) or (kind,))
        raise ValueError(f"`{name}` must be one of {kinds}, got {type(light).__name__}.")
    check_fields(name, light)


def check_lights(name: str, lights: Any) -> tuple[Light, ...]:
    """The lights of a sequence; `ValueError` names the item that is not a single light."""
    sequence = items(name, lights, "a sequence of lights")
    for index, light in enumerate(sequence):
        check_light(f"{name[:-1]}[{index}])", light)
    return tuple(sequence)


def check_gbuffer(name: str, gbuffer: Any) -> GBuffer:
    """The G-buffer, with its shapes checked again: it may have been edited as a pytree."""
    if not isinstance(gbuffer, GBuffer):
        raise ValueError(f"`{name}` must be a GBuffer, got {type(gbuffer).__name__}.")
    return GBuffer(*jax.tree.leaves(gbuffer))


def check_visibility(name: str, value: Any, light: Light, shape: tuple[int, ...]) -> Array:
    """A light's visibility: a share of it per pixel or, of light from all around, `occlusion`'s
    coefficients; `ValueError` names a wrong one."""
    array = as_array(name, value)
    if array.ndim != len(shape) + 1:
        return share(name, value, shape)
    if not isinstance(light, SphericalHarmonicsLight | EnvironmentLight):
        raise ValueError(
            f"`{name}` must have shape {shape} for a {type(light).__name__}, "
            f"got {array.shape}: coefficients are for light from all around."
        )
    if array.shape not in {(*shape, count) for count in OCCLUSION_COUNTS}:
        counts = " or ".join(map(str, OCCLUSION_COUNTS))
        raise ValueError(
            f"`{name}` must have shape {shape}, or that and {counts} coefficients, "
            f"got {array.shape}."
        )
    return parameter(name, value, array.shape)


def check_visibilities(
    name: str, values: Any, lights: Sequence[Light], shape: tuple[int, ...]
) -> list[Array | None]:
    """One visibility, as by `check_visibility`, or None per light; None alone for all None."""
    if values is not None:
        values = items(name, values, "a sequence")
    if values is None or len(values) != len(lights):
        return shares(name, values, len(lights), shape)
    return [
        None if value is None else check_visibility(f"{name}[{index}]", value, light, shape)
        for index, (value, light) in enumerate(zip(values, lights, strict=True))
    ]


def alike(
    lights: Sequence[Light], visibilities: Sequence[Array | None] | None = None
) -> list[list[int]]:
    """The indices of lights that can be stacked: of one kind, with as many numbers.

    So can their visibilities, where a visibility's pixel has as many numbers, or there is none.
    """
    kinds, groups = get_args(Light), {}
    for index, light in enumerate(lights):
        visibility = None if visibilities is None else visibilities[index]
        numbers = () if visibility is None else visibility.shape[2:]
        has_size = getattr(light, "light_size", None) is not None
        key = kinds.index(type(light)), getattr(light, "heights", ()), has_size, numbers
        groups.setdefault(key, []).append(index)
    return [groups[key] for key in sorted(groups)]
