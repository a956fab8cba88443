"""Check the SDF world of an export with the library of Gazebo, as ``gz sdf --check`` does.

    SDF_PATH=ROOT/usr/share/sdformat12/1.9 LD_LIBRARY_PATH=ROOT/usr/lib/x86_64-linux-gnu \\
        python tools/exports/with_sdformat.py FOLDER

``tools/exports/make.py`` makes the folder. Debian 12 has the library as libsdformat12-12, without the
command ``gz``. ROOT is a folder with its packages (``dpkg-deb -x``); empty if apt has installed them.
"""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path


def main(folder: Path) -> int:
    """Print what the library says; 0 if the world is valid."""
    library = ctypes.CDLL("libsdformat12.so.12")
    library.cmdCheck.argtypes, library.cmdCheck.restype = [ctypes.c_char_p], ctypes.c_int
    return int(library.cmdCheck(str(folder / "export" / "gazebo" / "scene.sdf").encode()))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
