import pytest

from jaxfx._extras import needs


def test_a_missing_library_names_its_extra():
    with (
        pytest.raises(ImportError, match=r"no_such_library.*pip install 'jaxfx\[io\]'") as info,
        needs("io"),
    ):
        import no_such_library  # noqa: F401
    assert info.value.name == "no_such_library"


def test_an_installed_library_is_imported():
    with needs("io"):
        import json
    assert json.loads("1") == 1


def test_other_errors_pass_unchanged():
    with pytest.raises(ImportError, match="libGL") as info, needs("scene"):
        raise ImportError("libGL.so.1: cannot open shared object file")
    assert "extra" not in str(info.value)
