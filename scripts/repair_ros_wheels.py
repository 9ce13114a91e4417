"""Puts this machine's include folders into the CMake files of the ROS wheels.

The message wheels export the folders of the host that built them
(/opt/python/cp311-cp311/include/python3.11 and the NumPy of that host); colcon stops on them.
"""

import re
import sys
import sysconfig
from pathlib import Path

import numpy

BUILD_HOST_PYTHON = re.compile(r"/opt/[^;\"\s]*?/include/python3\.\d+")
BUILD_HOST_NUMPY = re.compile(r"/[^;\"\s]*?/numpy/_?core/include")


def repair(text: str, python_include: str, numpy_include: str) -> str:
    """Returns `text` with both include folders replaced by this environment's."""
    text = BUILD_HOST_PYTHON.sub(lambda _: python_include, text)
    return BUILD_HOST_NUMPY.sub(lambda _: numpy_include, text)


def main() -> None:
    """Repairs every exported CMake file below the virtual environment's share/."""
    python_include = sysconfig.get_paths()["include"]
    for path in Path(sys.prefix, "share").rglob("*.cmake"):
        text = path.read_text()
        repaired = repair(text, python_include, numpy.get_include())
        if repaired != text:
            path.write_text(repaired)


if __name__ == "__main__":
    main()
