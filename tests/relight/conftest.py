import pytest

from tests.cases.relight_views import AROUND, LARGE, cache, orbit


@pytest.fixture(scope="session")
def caches():
    """Eight caches of the still life, and their cameras."""
    cameras = [orbit(*where, size=LARGE) for where in AROUND]
    return [cache(camera, LARGE) for camera in cameras], cameras
