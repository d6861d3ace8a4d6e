"""Files that are there whole or not at all."""

from pathlib import Path

import pytest

from xew.files import replacing, write_section


def test_the_old_file_stands_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "made" / "file.txt"
    with replacing(path) as temporary:
        temporary.write_text("first")
        assert not path.exists() and temporary.parent == path.parent
    with pytest.raises(ValueError, match="half way"), replacing(path) as temporary:
        temporary.write_text("sec")
        raise ValueError("half way")
    assert path.read_text() == "first"
    with replacing(path) as temporary:
        temporary.write_text("second")
        assert path.read_text() == "first"
    assert path.read_text() == "second" and list(path.parent.iterdir()) == [path]


def test_a_section_is_written_anew_and_all_else_stays(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    write_section(page, "## One", "first")
    assert page.read_text() == "## One\nfirst\n"
    write_section(page, "## Two", "second\n\n### Part\nof it")
    write_section(page, "## One", "other\n")
    assert page.read_text() == "## One\nother\n\n## Two\nsecond\n\n### Part\nof it\n"
    page.write_text(f"# Page\nhead\n{page.read_text()}\n# Next\n")
    write_section(page, "## Two", "last")
    assert page.read_text() == "# Page\nhead\n## One\nother\n\n## Two\nlast\n\n# Next\n"
