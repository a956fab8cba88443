"""Write the layouts of the demo scene: config/humansim.rviz and config/humansim_foxglove.json.

python tools/viewer_layouts.py
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from humansim_ros.apps.viewer_layouts import foxglove_layout, rviz_layout  # noqa: E402
from humansim_ros.scene.names import read_names  # noqa: E402

if __name__ == "__main__":
    names = read_names(ROOT / "config" / "scenes" / "demo.yaml")
    (ROOT / "config" / "humansim.rviz").write_text(rviz_layout(names))
    (ROOT / "config" / "humansim_foxglove.json").write_text(foxglove_layout(names))
