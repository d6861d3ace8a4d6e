"""Files that are there whole or not at all."""

from pathlib import Path

import pytest

from xew.files import replacing


def test_the_old_file_stands_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "made" / "file.txt"
    with replacing(path, within=tmp_path) as temporary:
        temporary.write_text("first")
        assert not path.exists() and temporary.parent == path.parent
    with pytest.raises(ValueError, match="half way"), replacing(path, within=tmp_path) as temporary:
        temporary.write_text("sec")
        raise ValueError("half way")
    assert path.read_text() == "first"
    with replacing(path, within=tmp_path) as temporary:
        temporary.write_text("second")
        assert path.read_text() == "first"
    assert path.read_text() == "second" and list(path.parent.iterdir()) == [path]
