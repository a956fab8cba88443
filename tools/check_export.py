"""Let the programs of their fields judge an export: TrackEval (mot) and mlcroissant (croissant).

    humansim export --frames 60 -o walk --format mot,croissant
    python tools/check_export.py walk

The truth, scored against itself, must have HOTA, MOTA and IDF1 of 1, every image must be read, and
mlcroissant must find no error; its warnings are printed. The folder may be a data set of a recipe. Both
programs may be in an environment of their own: pip install trackeval mlcroissant pillow
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import Any


def scores(root: Path) -> dict[str, dict[str, float]]:
    """HOTA, MOTA and IDF1 of the truth as a tracker, by camera. ``root``: folder of the export."""
    from trackeval import Evaluator
    from trackeval.datasets import MotChallenge2DBox
    from trackeval.metrics import CLEAR, HOTA, Identity

    truth = root / "mot"
    cameras = (truth / "seqmap.txt").read_text().split()[1:]
    quiet: dict[str, Any] = {"PRINT_CONFIG": False}
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder) / "truth" / "data"
        results.mkdir(parents=True)
        for camera in cameras:
            shutil.copy(truth / camera / "gt" / "gt.txt", results / f"{camera}.txt")
        dataset = MotChallenge2DBox(
            {
                **quiet,
                "GT_FOLDER": str(truth),
                "TRACKERS_FOLDER": folder,
                "OUTPUT_FOLDER": folder,
                "SKIP_SPLIT_FOL": True,
                "SEQMAP_FILE": str(truth / "seqmap.txt"),
            }
        )
        options = {
            **quiet,
            "USE_PARALLEL": False,
            "PRINT_RESULTS": False,
            "OUTPUT_SUMMARY": False,
            "OUTPUT_DETAILED": False,
            "PLOT_CURVES": False,
            "TIME_PROGRESS": False,
            "BREAK_ON_ERROR": True,
        }
        metrics = [HOTA(), CLEAR(quiet), Identity(quiet)]
        output, _ = Evaluator(options).evaluate([dataset], metrics)
    found = output["MotChallenge2DBox"]["truth"]
    return {
        camera: {
            "HOTA": float(found[camera]["pedestrian"]["HOTA"]["HOTA"].mean()),
            "MOTA": float(found[camera]["pedestrian"]["CLEAR"]["MOTA"]),
            "IDF1": float(found[camera]["pedestrian"]["Identity"]["IDF1"]),
        }
        for camera in cameras
    }


def read_records(root: Path) -> tuple[dict[str, int], list[str]]:
    """Number of records that mlcroissant reads by record set, and its warnings.

    ``root``: folder of the export.
    """
    import mlcroissant

    dataset = mlcroissant.Dataset(str(root / "croissant.json"))
    sets = [row.uuid for row in dataset.metadata.record_sets]
    found = {name: sum(1 for _ in dataset.records(name)) for name in sets}
    return found, sorted(dataset.metadata.ctx.issues.warnings)


def main() -> None:
    """Print the scores, the numbers of records, and warnings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("export", type=Path, help="folder of the export")
    root: Path = parser.parse_args().export.resolve()
    if (root / "mot").exists():
        for camera, found in scores(root).items():
            print(camera, ", ".join(f"{name} {value:.6f}" for name, value in found.items()))
    if (root / "croissant.json").exists():
        records, warnings = read_records(root)
        for name, count in records.items():
            print(f"{name}: {count} records")
        print("\n".join(warnings) or "no warnings")


if __name__ == "__main__":
    main()
