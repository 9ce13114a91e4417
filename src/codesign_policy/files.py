"""Writing files so that a reader sees the old one or the new one, never half of it."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, moved over it on success and removed on failure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def require_replaceable(folder: Path, marker: str) -> None:
    """Raises: ValueError: a folder that is neither empty nor holds the file `marker`."""
    if folder.exists() and not (folder / marker).is_file() and any(folder.iterdir()):
        raise ValueError(f"{folder}: has other content, without a {marker}: name another folder")


@contextmanager
def replacing_folder(folder: Path, marker: str) -> Iterator[Path]:
    """An empty folder beside `folder`, moved to its place on success and removed on failure.

    Args:
        folder: may exist if it is empty or holds the file `marker`: then it is replaced.
        marker: tells a folder of the same kind from one that happens to have the name.

    Raises:
        ValueError: there is something else.
    """
    require_replaceable(folder, marker)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as aside:
        temporary = Path(aside, "new")
        temporary.mkdir()
        yield temporary
        if folder.exists():
            os.replace(folder, Path(aside, "old"))
        os.replace(temporary, folder)


def write_text(path: Path, text: str) -> None:
    """Write a text file in one go."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
