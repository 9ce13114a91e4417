"""Arrays kept on disk under the hash of what they were computed from."""

from __future__ import annotations

import contextlib
import os
import tempfile
import zipfile
import zlib
from pathlib import Path

import numpy as np

FOLDER_VARIABLE = "CODESIGN_CACHE_DIR"
LARGEST = 512 * 2**20  # bytes in all; the files unused for longest go first
_UNREADABLE = (
    OSError,
    RuntimeError,
    EOFError,
    ValueError,
    KeyError,
    zipfile.BadZipFile,
    zlib.error,
)


def cache_folder() -> Path:
    """$CODESIGN_CACHE_DIR, or $XDG_CACHE_HOME/codesign, or ~/.cache/codesign."""
    chosen = os.environ.get(FOLDER_VARIABLE)
    if chosen:
        return Path(chosen)
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "codesign"


def load(key: str, names: tuple[str, ...]) -> dict[str, np.ndarray] | None:
    """The named arrays kept under a key, or None; a damaged file counts as absent."""
    try:
        path = _path(key)
        with np.load(path, allow_pickle=False) as kept:  # reading checks the archive's sums
            arrays = {name: kept[name] for name in names}
        with contextlib.suppress(OSError):
            os.utime(path)  # used just now
    except _UNREADABLE:
        return None
    return arrays


def store(key: str, arrays: dict[str, np.ndarray]) -> None:
    """Keeps arrays under a key; where the folder cannot be written to, nothing happens.

    A reader, in this process or another, finds either the whole file or none.
    """
    try:
        path = _path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
        _drop_oldest(path.parent)
    except (OSError, RuntimeError):  # no home folder is a RuntimeError
        return


def _path(key: str) -> Path:
    return cache_folder() / "fingers" / f"{key}.npz"


def _drop_oldest(folder: Path) -> None:
    """Removes what was unused for longest until the folder is within its size."""
    files = []
    for path in folder.iterdir():  # another process may remove files meanwhile
        with contextlib.suppress(FileNotFoundError):
            entry = path.stat()
            files.append((entry.st_mtime, entry.st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= LARGEST:
            return
        path.unlink(missing_ok=True)
        total -= size
