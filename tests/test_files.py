import pytest

from jaxfx._files import check_suffix, write_whole


def test_a_file_is_replaced_once_it_is_complete(tmp_path):
    path = tmp_path / "a.bin"
    write_whole(path, b"old")
    write_whole(path, memoryview(b"new"))
    assert path.read_bytes() == b"new"
    assert [file.name for file in tmp_path.iterdir()] == ["a.bin"]


def test_a_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.bin"
    write_whole(path, b"old")
    with pytest.raises(TypeError):
        write_whole(path, "text")
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.bin"]


def test_a_link_is_followed(tmp_path):
    (tmp_path / "link").symlink_to("a.bin")
    write_whole(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "a.bin").read_bytes() == b"new"


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(OSError, match=r"cannot write `a.bin` here"):
        write_whole(tmp_path / "no" / "a.bin", b"new")


@pytest.mark.parametrize("name", ["a.png", "a.PNG", "folder.x/a", "a"])
def test_a_suffix_that_fits(name):
    check_suffix("write(path)", name, ".png")


@pytest.mark.parametrize("name", ["a.jpg", "a.png.gz", "a.exr"])
def test_a_suffix_of_another_format(name):
    with pytest.raises(ValueError, match=rf"`write\(path\)` must end in `.png`.* `{name}`"):
        check_suffix("write(path)", name, ".png")
