"""Pictures with depth, seen from other cameras."""

from jaxfx.reproject.blend import Choice, blend, choose
from jaxfx.reproject.intersect import Hit, intersect
from jaxfx.reproject.warp import warp


__all__ = ["Choice", "Hit", "blend", "choose", "intersect", "warp"]
