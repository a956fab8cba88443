"""Count what Rerun's own reader finds in a recording of ``humansim export --format rerun``.

    humansim export SCENE.yaml --frames 30 -o walk --format rerun
    python tools/exports/with_rerun.py walk

Needs rerun-sdk 0.41: pip install rerun-sdk. ``rerun walk/rerun/rerun.rrd`` shows the recording.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path

from rerun.chunk import RrdReader


def main(export: Path) -> None:
    """Print the number of values by entity and component."""
    plan = json.loads((export / "index.json").read_text())["plan"]
    reader = RrdReader(export / "rerun" / "rerun.rrd")
    print(", ".join(f"{store.kind} {store.application_id!r}" for store in reader.recordings()))
    rows: Counter[str] = Counter()
    for chunk in reader.stream():
        for name in chunk.to_record_batch().schema.names:
            if ":" in name:
                rows[f"{chunk.entity_path} {name}{' (static)' * chunk.is_static}"] += chunk.num_rows
    for name, count in sorted(rows.items()):
        print(f"{count:6d} {name}")
    frames = plan["end"] - plan["first"]
    if wrong := [name for name, count in rows.items() if count > frames]:
        sys.exit(f"more rows than {frames} frames: {', '.join(wrong)}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
