"""Let TrackEval and shapely score boxes of the AI City Challenge, beside ``humansim evaluate``.

    humansim export --frames 60 -o walk --format aicity
    python tools/exports/with_trackeval_3d.py --make walk/aicity/ground_truth.txt result.txt
    humansim evaluate --truth walk --estimate result.txt --output ours.json
    python tools/exports/with_trackeval_3d.py walk/aicity/ground_truth.txt result.txt ours.json

``--make`` writes a result with noise, missing and false boxes, and identities that change. Shapely intersects
the boxes, and TrackEval scores the similarities: pip install trackeval==1.3.0 shapely
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
from trackeval_reference import scores

#: Distance of the centres on the floor from which the similarity of 2024 is 0, metres.
ZERO = 2.0


def overlap(a: Any, b: Any) -> float:
    """3D IoU of two boxes (x, y, z, width, length, height, yaw)."""
    from shapely import affinity, box

    def base(each: Any) -> Any:
        own = box(-each[3] / 2, -each[4] / 2, each[3] / 2, each[4] / 2)
        return affinity.translate(affinity.rotate(own, each[6], (0, 0), use_radians=True), each[0], each[1])

    height = min(a[2] + a[5] / 2, b[2] + b[5] / 2) - max(a[2] - a[5] / 2, b[2] - b[5] / 2)
    common = base(a).intersection(base(b)).area * max(height, 0.0)
    return float(common / (np.prod(a[3:6]) + np.prod(b[3:6]) - common))


def distance(a: Any, b: Any) -> float:
    """Similarity of the challenge of 2024."""
    return max(0.0, 1.0 - float(np.hypot(a[0] - b[0], a[1] - b[1])) / ZERO)


def changed(truth: Any) -> Any:
    """Lines of a tracker that is not perfect."""
    rng = np.random.default_rng(5)
    result = truth[rng.random(len(truth)) < 0.9]
    result[:, 4:10] += rng.normal(0, 0.03, (len(result), 6))
    result[:, 10] += rng.normal(0, 0.2, len(result))
    late = result[:, 3] > np.median(result[:, 3])
    result[late, 2] = result[late, 2] % result[:, 2].max() + 1  # identities swap
    false = result[rng.random(len(result)) < 0.1]
    false[:, [2, 4]] += 100, 0.4
    return np.concatenate([result, false])


def main() -> None:
    """Print the scores of TrackEval, and the greatest difference to those of ``humansim evaluate``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("truth", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("ours", type=Path, nargs="?", help="JSON of humansim evaluate")
    parser.add_argument("--make", action="store_true", help="write the result from the truth")
    given = parser.parse_args()
    truth = np.loadtxt(given.truth)
    if given.make:
        lines = (" ".join([*(f"{n:.0f}" for n in row[:4]), *map(str, row[4:])]) for row in changed(truth))
        given.result.write_text("\n".join(lines) + "\n")
        return
    result = np.loadtxt(given.result)
    ours = json.loads(given.ours.read_text())["tracking"] if given.ours else {}
    for name, similarity in (("iou", overlap), ("distance", distance)):
        frames = []
        for frame in np.unique(truth[:, 3]):
            own, other = truth[truth[:, 3] == frame], result[result[:, 3] == frame]
            table = [[similarity(a[4:], b[4:]) for b in other] for a in own]
            identities = [[int(row[2]) for row in rows] for rows in (own, other)]
            frames.append({"truth": identities[0], "estimate": identities[1], "similarity": table})
        judged = scores(frames)
        print(name, ", ".join(f"{key} {value:.6f}" for key, value in judged.items()))
        if ours:
            worst = max(abs(value - ours[name][key]) for key, value in judged.items())
            print(f"  greatest difference to humansim evaluate: {worst:.1e}")


if __name__ == "__main__":
    main()
