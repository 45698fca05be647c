"""Where verbs write: whole files or none, through links, and straight to what is no file."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from services.output import opened
from suturetrack.types import InputError


def test_a_file_appears_whole_or_stays_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "file"
    for words in ("one", "two"):
        with opened(file) as out:
            out.write(words)
            out.flush()
            assert not file.exists() or file.read_text() == "one"
        assert file.read_text() == words
    with pytest.raises(TypeError), opened(file) as out:
        out.writelines(["half", 0])  # type: ignore[list-item]
    assert file.read_text() == "two"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("exists", [True, False])
def test_a_link_stays_one_and_its_file_is_written(tmp_path: Path, exists: bool) -> None:
    (tmp_path / "there").mkdir()
    file, link = tmp_path / "there" / "file", tmp_path / "link"
    if exists:
        file.write_text("before")
    link.symlink_to(Path("there") / "file")
    with opened(link) as out:
        out.write("after")
    assert link.is_symlink()
    assert file.read_text() == "after"
    assert list((tmp_path / "there").iterdir()) == [file]


@pytest.mark.parametrize("linked", [True, False])
def test_a_pipe_stays_one_and_is_written_to(tmp_path: Path, linked: bool) -> None:
    pipe = output = tmp_path / "pipe"
    os.mkfifo(pipe)
    if linked:
        output = tmp_path / "link"
        output.symlink_to(pipe)
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()), daemon=True)
    reader.start()
    with opened(output) as out:
        out.write("through")
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    reader.join(30)
    assert read == ["through"]


def test_a_reader_that_has_seen_enough_of_a_pipe_is_no_fault(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.fdopen(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK))
    with pytest.raises(BrokenPipeError), opened(pipe) as out, reader:
        out.write("for whoever reads on")


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    for output, reason in (
        (tmp_path, "Is a directory"),
        (tmp_path / "no" / "file", "No such file"),
    ):
        with pytest.raises(InputError, match=f"cannot write {output}: {reason}"), opened(output):
            pass
