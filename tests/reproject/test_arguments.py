"""The arguments that the calls of reprojection share."""

import pytest

from jaxfx.reproject.arguments import check_size


def test_a_size_is_given_whole_or_left_out():
    assert check_size("warp", None, None, (3, 4)) == (3, 4)
    assert check_size("warp", 5, 7, (3, 4)) == (5, 7)
    for missing, size in (("width", (5, None)), ("height", (None, 7))):
        with pytest.raises(ValueError, match=rf"^`warp\({missing}=\.\.\.\)` .* both or none"):
            check_size("warp", *size, (3, 4))
