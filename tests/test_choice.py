"""One record for both choices of cameras."""

from jaxfx import relight, reproject
from jaxfx._choice import Choice


def test_both_choices_return_the_same_record():
    assert relight.Choice is Choice
    assert Choice._fields == reproject.Choice._fields == ("chosen", "worth")
