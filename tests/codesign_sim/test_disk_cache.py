"""The files that baked fingers are kept in."""

import multiprocessing
import os

import numpy as np
import pytest

from codesign_sim import SurfaceMesh, disk_cache, distance
from codesign_sim.distance import bake

KEY = "0123abcd"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("CODESIGN_CACHE_DIR", str(tmp_path))
    distance._bake_cached.cache_clear()
    return tmp_path / "fingers"


def keep(value, size=1000):
    disk_cache.store(KEY, {"value": np.full(size, float(value))})


def kept():
    arrays = disk_cache.load(KEY, ("value",))
    return None if arrays is None else arrays["value"]


def test_what_was_stored_is_found():
    assert kept() is None
    keep(3.5)
    assert (kept() == 3.5).all()
    assert disk_cache.load(KEY, ("value", "other")) is None


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_file_counts_as_absent_until_stored_again(folder, share):
    keep(1.0)
    path = folder / f"{KEY}.npz"
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert kept() is None
    keep(2.0)
    assert (kept() == 2.0).all()


def test_a_damaged_byte_is_noticed(folder):
    keep(1.0)
    path = folder / f"{KEY}.npz"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert kept() is None


def test_a_folder_that_cannot_be_written_to_does_without(tmp_path, monkeypatch):
    file = tmp_path / "a file"
    file.write_text("")
    monkeypatch.setenv("CODESIGN_CACHE_DIR", str(file / "below"))
    keep(1.0)
    assert kept() is None
    assert bake(SurfaceMesh.box((0, 0, 0), (0.011, 0.01, 0.01))).values.min() < 0


def test_a_full_disk_leaves_nothing_behind(folder, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    keep(1.0)
    monkeypatch.setattr(np, "savez", full)
    keep(2.0)
    assert (kept() == 1.0).all()
    assert [p.name for p in folder.iterdir()] == [f"{KEY}.npz"]


def test_the_files_unused_for_longest_go_first(folder, monkeypatch):
    monkeypatch.setattr(disk_cache, "LARGEST", 30_000)
    for k in range(3):
        disk_cache.store(f"old{k}", {"value": np.zeros(1000)})
        os.utime(folder / f"old{k}.npz", (k, k))
    disk_cache.load("old0", ("value",))  # used just now
    disk_cache.store("new", {"value": np.zeros(1000)})
    assert sorted(p.stem for p in folder.iterdir()) == ["new", "old0", "old2"]


def test_folder_of_the_user(monkeypatch, tmp_path):
    monkeypatch.delenv("CODESIGN_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert disk_cache.cache_folder() == tmp_path / "xdg" / "codesign"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert disk_cache.cache_folder() == tmp_path / "home" / ".cache" / "codesign"


def test_several_processes_store_and_read_at_once():
    context = multiprocessing.get_context("fork")  # children only read and write files
    with context.Pool(2) as pool:
        whole = pool.map(_store_and_read, [1, 2], chunksize=1)
    assert all(whole)
    assert kept() is not None


def _store_and_read(value):
    """Whether everything read meanwhile was one of the two arrays, whole."""
    fine = True
    for _ in range(10):
        keep(value, size=20_000)
        found = kept()
        fine &= found is not None and found[0] in (1, 2) and (found == found[0]).all()
    return bool(fine)


def test_a_baked_finger_comes_from_the_disk(folder, monkeypatch):
    box = SurfaceMesh.box((0, 0, 0), (0.012, 0.01, 0.01))
    fresh = bake(box)
    assert len(list(folder.iterdir())) == 1
    distance._bake_cached.cache_clear()
    monkeypatch.setattr(distance, "_bake", None)  # must not be needed
    again = bake(SurfaceMesh(box.vertices, box.faces))
    assert again is not fresh
    assert np.array_equal(again.values, fresh.values)
    assert np.array_equal(again.origin, fresh.origin)
    assert again.thinnest == fresh.thinnest == np.inf


def test_a_damaged_baked_finger_is_baked_again(folder):
    box = SurfaceMesh.box((0, 0, 0), (0.013, 0.01, 0.01))
    fresh = bake(box)
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:500])
    distance._bake_cached.cache_clear()
    assert np.array_equal(bake(box).values, fresh.values)
    distance._bake_cached.cache_clear()
    assert np.array_equal(bake(box).values, fresh.values)  # and it was stored again
    assert path.stat().st_size > 500


@pytest.mark.parametrize("change", [{"_VERSION": -1}, {"_MARGIN_CELLS": 3}])
def test_another_way_of_baking_is_another_file(folder, monkeypatch, change):
    box = SurfaceMesh.box((0, 0, 0), (0.014, 0.01, 0.01))
    bake(box)
    distance._bake_cached.cache_clear()
    for name, value in change.items():
        monkeypatch.setattr(distance, name, value)
    bake(box)
    assert len(list(folder.iterdir())) == 2
