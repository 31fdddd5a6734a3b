"""Checks of arguments that are cameras, lenses, lights or caches: the right type, and no batch.

A camera, lens or light whose fields have a leading axis is a batch. Without `jax.vmap` its
fields would be broadcast against an image's rows and columns, and no error raised.
"""

from collections.abc import Sequence
from typing import Any, get_args

import jax

from jaxfx._checks import check_fields, check_shape, items
from jaxfx.camera import Camera
from jaxfx.gbuffer import GBuffer
from jaxfx.lens import FocusPlanes, Lens, ThinLens
from jaxfx.light import Light


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


def alike(lights: Sequence[Light]) -> list[list[int]]:
    """The indices of lights that can be stacked: of one kind, with as many numbers."""
    kinds, groups = get_args(Light), {}
    for index, light in enumerate(lights):
        key = kinds.index(type(light)), getattr(light, "heights", ())
        groups.setdefault(key, []).append(index)
    return [groups[key] for key in sorted(groups)]
