"""Caches along mirrored and refracted rays, relit, against Mitsuba's light on the same scene.

The still life under one light at a time. Its floor is a mirror of metal, then of glass; then
its marble ball is of glass, and shows its own far side. Mitsuba finds the mirrored or refracted
ray and its share by its own materials, the next surface, the light there and its shadow; none
in the ball, whose own surface would keep all light out. Every other surface is Lambert.

    python -m benchmarks.relight_mirror
"""

import argparse

import equinox as eqx
import jax.numpy as jnp
import mitsuba as mi
import numpy as np

from benchmarks.scenes import relight_truth as truth
from jaxfx import relight, scene


INDEX = 1.5
# Which object is of which material, and which way its rays go.
KINDS = {
    "conductor": ("floor", "mirrored"),
    "dielectric": ("floor", "mirrored"),
    "dielectric, behind it": ("marble", "refracted"),
}


def of_mitsuba(mesh, camera, light, size, material, kind):
    """Mitsuba's radiance in the pixels of one mirror or clear material, and their mask."""
    shapes = truth.shapes(mesh)
    world = mi.load_dict({"type": "scene", **shapes, "light": truth.emitter(light)})
    if kind == "conductor":
        bsdf = mi.load_dict({"type": "conductor", "material": "none"})
    else:
        bsdf = mi.load_dict({"type": "dielectric", "int_ior": INDEX, "ext_ior": 1.0})
    context, image = mi.BSDFContext(), np.zeros((size[0] * size[1], 3))
    is_mirror = np.zeros(size[0] * size[1], bool)
    is_behind = KINDS[kind][1] == "refracted"
    chosen, name = 1 - 1e-7 if is_behind else 0.0, f"shape{material}"
    for pixel, ray in enumerate(truth.rays(camera, size)):
        hit = world.ray_intersect(ray)
        if not hit.is_valid() or hit.shape.id() != name:
            continue
        is_mirror[pixel] = True
        sample, weight = bsdf.sample(context, hit, chosen, [0.5, 0.5])
        # Of one of two ways, which Mitsuba takes by chance; radiance in matter is denser.
        share = np.array(weight, float) * sample.pdf * sample.eta**2
        second = world.ray_intersect(hit.spawn_ray(hit.to_world(sample.wo)))
        if second.is_valid():
            way, irradiance = world.sample_emitter_direction(second, [0.5, 0.5], not is_behind)
            value = second.bsdf().eval(context, second, second.to_local(way.d))
            image[pixel] = share * np.array(irradiance * value, float)
    return np.pi * image.reshape(*size, 3), is_mirror.reshape(size)


def of_caches(mesh, camera, gbuffer, light, kind):
    """The same from a second cache: traced once, then lit."""
    is_behind = KINDS[kind][1] == "refracted"
    if is_behind:
        rays = relight.refracted(gbuffer, camera, index=INDEX)
        share = 1 - relight.fresnel(gbuffer, camera, index=INDEX)
    else:
        rays = relight.mirrored(gbuffer, camera)
        share = 1.0 if kind == "conductor" else relight.fresnel(gbuffer, camera, index=INDEX)
    second = scene.gbuffer_along(mesh, rays)
    second = eqx.tree_at(lambda g: g.shader, second, jnp.where(second.shader < 0, -1, 0))
    depth = jnp.where(jnp.isfinite(second.depth), second.depth, 0)
    places = np.asarray(rays.origins + depth[..., None] * rays.directions, float)
    visible = None if is_behind else truth.unshadowed(mesh, places, light)
    return np.asarray(share * relight.shade(second, rays, light, visible))


def compare(size):
    """Rows: kind, light, pixels of the mirror, PSNR of those, the share off by a hundredth."""
    mesh = scene.still_life()
    camera = scene.default_camera(mesh, height=size[0], width=size[1])
    gbuffer = truth.lambert(mesh, camera, size)
    options = {"height": size[0], "width": size[1], "backend": "embree"}
    ids = np.asarray(scene.material_ids(mesh, camera, **options))
    for kind, (name, _) in KINDS.items():
        is_object = mesh.face_objects == mesh.names.index(name)
        material = int(mesh.face_materials[is_object][0])
        for lamp, light in truth.LIGHTS.items():
            expected, is_mirror = of_mitsuba(mesh, camera, light, size, material, kind)
            where = is_mirror & (ids == material)
            found = of_caches(mesh, camera, gbuffer, light, kind)[where]
            scale, error = expected[where].max(), np.abs(found - expected[where])
            psnr = -10 * np.log10(np.mean((error / scale) ** 2))
            off = (error.max(axis=-1) > 0.01 * scale).mean()
            yield kind, lamp, int(where.sum()), psnr, off


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=96, help="height of the image, pixels")
    size = parser.parse_args().size
    print("| material | light | pixels | PSNR, dB | off by a hundredth, % |")
    print("|---|---|---:|---:|---:|")
    for kind, name, count, psnr, off in compare((size, size * 4 // 3)):
        print(f"| {kind} | {name} | {count} | {psnr:.1f} | {100 * off:.2f} |")


if __name__ == "__main__":
    main()
