"""The camera and the lights that a scene gets when none are chosen."""

import numpy as np

from jaxfx.camera import Camera, PinholeCamera
from jaxfx.light import AmbientLight, DirectionalLight
from jaxfx.scene._scene import Scene
from jaxfx.scene._view import View, check_size


# The default view: field of view of the shorter side, in radians; the direction from the middle
# of the scene to the eye, in world axes; the share of the half image that the scene may fill.
_FOV = np.radians(35)
_BACKWARD = (0.55, 0.4, 1.0)
_FILL = 0.9


def default_camera(scene: Scene, *, height: int, width: int) -> PinholeCamera:
    """A camera that shows the whole scene, from the front and above.

    It looks at the middle of the bounding box, y up, from as near as fits the scene and a
    margin. A scene with a `viewpoint` is seen from there.

    **Arguments:**

    - `scene`: from `load`, `from_trimesh` or `still_life`.
    - `height`, `width`: image size in pixels.

    **Returns:** a `PinholeCamera`.

    **Raises:** `ValueError` for a size that is not a positive integer.

    **Gradient:** none; the host side.

    **Example:**

    >>> from jaxfx import scene
    >>> mesh = scene.still_life()
    >>> camera = scene.default_camera(mesh, height=6, width=8)
    >>> print(camera.world_from_camera[:3, 3])
    [0.   1.25 0.  ]
    """
    height, width = check_size("default_camera", height, width)
    aspect = np.array([width, height]) / min(height, width)
    if scene.viewpoint is not None:
        eye, at, fov = scene.viewpoint
    else:
        at, fov = scene.center, _FOV
        backward = np.array(_BACKWARD) / np.linalg.norm(_BACKWARD)
        right = np.cross([0, 1, 0], backward)
        right /= np.linalg.norm(right)
        points = (scene.points - at).T
        off_axis = np.abs(np.stack([right, np.cross(backward, right)]) @ points)
        tangent = _FILL * np.tan(fov / 2) * aspect[:, None]
        # For each point, the distance from `at` at which it lies on the image's border; and no
        # point nearer to the eye than half the scene's radius.
        distance = np.maximum(off_axis / tangent, scene.radius / 2) + backward @ points
        eye = at + backward * np.max(distance)
    fov_y = 2 * np.arctan(np.tan(fov / 2) * aspect[1])
    return PinholeCamera.look_at(eye, at, up=[0, 1, 0], fov_y=fov_y, height=height, width=width)


def default_lights(
    camera: Camera,
) -> tuple[DirectionalLight, DirectionalLight, AmbientLight]:
    """A warm key light, a cool fill light and a weak ambient light, placed by the camera.

    **Arguments:** `camera`: the camera whose axes the lights follow.

    **Returns:** the key, fill and ambient light: a sequence of lights for `relight.render`.

    **Raises:** `ValueError` for another type.

    **Gradient:** none; the host side.

    **Example:**

    >>> from jaxfx import PinholeCamera, scene
    >>> camera = PinholeCamera.from_fov(0.8, height=6, width=8)
    >>> [type(light).__name__ for light in scene.default_lights(camera)]
    ['DirectionalLight', 'DirectionalLight', 'AmbientLight']
    """
    rotation = View.of(camera, "scene.default_lights").world_from_camera[:3, :3]
    key = DirectionalLight(rotation @ [0.5, 0.7, 0.8], [0.85, 0.8, 0.72])
    fill = DirectionalLight(rotation @ [-0.8, 0.2, 0.6], [0.18, 0.2, 0.25])
    return key, fill, AmbientLight([0.12, 0.12, 0.13])
