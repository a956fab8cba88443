"""Write the levels of detail of the built-in humans, ``assets/humans/levels``.

    python tools/assets/simplify_humans.py

Run it when a built-in human or ``VERSION`` of ``humansim_ros/people/loading/levels.py`` has changed.
"""

from __future__ import annotations

from humansim_ros.cli.human import built_in_humans
from humansim_ros.files.reading.assets import resource_root
from humansim_ros.people.loading.levels import FOLDER, make_levels, path_of, write_levels
from humansim_ros.people.loading.loading import load_human


def main() -> None:
    folder = resource_root() / FOLDER
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.npz"):
        old.unlink()
    for name in built_in_humans():
        human = load_human(name)
        levels = make_levels(human)
        path = path_of(human, folder)
        write_levels(path, levels)
        errors = ", ".join(f"{1e3 * error:.1f}" for error in levels.errors[1:])
        print(f"{name}: {path.stat().st_size / 1e3:.0f} kB, errors {errors} mm")


if __name__ == "__main__":
    main()
