"""Read a data set of a recipe with Hugging Face datasets, and compare it with the files.

    humansim export config/recipes/people.yaml -o people
    python tools/exports/with_huggingface.py people

Needs ``pip install datasets pillow``, best in an environment of its own. Nothing is sent or fetched.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path


def main(root: Path) -> None:
    """Read all images and lines of all splits; end with an error if one is not that of the files."""
    os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1"}
    from datasets import load_dataset
    from PIL import Image, ImageChops

    index = json.loads((root / "index.json").read_text())
    with tempfile.TemporaryDirectory() as cache:
        found = load_dataset(str(root), cache_dir=cache)
        for split, counts in index["splits"].items():
            if not counts["images"]:
                continue
            rows = found[split]
            if len(rows) != counts["images"]:
                sys.exit(f"{split}: {len(rows)} images, and {counts['images']} in the index")
            for row in rows:
                folder = root / split / row["scene"]
                image = Image.open(folder / "images" / row["camera"] / f"{row['frame']:06d}.png")
                if ImageChops.difference(image.convert("RGB"), row["image"].convert("RGB")).getbbox():
                    sys.exit(f"{folder}: {row['camera']} {row['frame']} has other pixels")
            people = sum(len(row["objects"]["bbox"]) for row in rows)
            print(f"{split}: {len(rows)} images with {people} people")
        print(", ".join(found[split].features))


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
