"""One check of input files serves all readers, each with its own error."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from surffollow.config.input_file import check_plain_file
from surffollow.errors import InputFileError, MapFileError


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)  # names of sockets have 107 bytes at most
    Path("a.csv").write_text("x_m,y_m\n")
    Path("link.csv").symlink_to("a.csv")
    Path("dangling.csv").symlink_to("none.csv")
    Path("sub").mkdir()
    os.mkfifo("pipe")
    Path("zeros").symlink_to("/dev/zero")
    socket.socket(socket.AF_UNIX).bind("socket")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("sub", "sub is a folder, no plain file; give a file"),
        ("pipe", "pipe is a pipe, no plain file; write what comes out of it to a file first"),
        ("socket", "socket is a socket, no plain file; give a file"),
        ("zeros", "zeros is a device, no plain file; give a file"),
    ],
)
@pytest.mark.parametrize("error", [InputFileError, MapFileError])
def test_what_is_no_file_is_named_with_its_remedy(
    folder: Path, name: str, says: str, error: type[MapFileError]
) -> None:
    with pytest.raises(error) as raised:
        check_plain_file(name, error)
    assert (str(raised.value), raised.value.exit_code) == (says, 1)


@pytest.mark.parametrize("name", ["a.csv", "link.csv", "none.csv", "dangling.csv", "a.csv/x", "nul\0"])
def test_a_file_and_a_name_that_is_not_there_are_left_to_the_reader(folder: Path, name: str) -> None:
    check_plain_file(name)
