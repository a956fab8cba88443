"""Folders as version 0.2 has left them: interrupted work, reduced to the smallest form."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

#: Plan of an export of version 0.2.
_EXPORT_PLAN: dict[str, Any] = {
    "scene": "0123456789abcdef",
    "first": 0,
    "end": 12,
    "formats": ["images", "depth-png", "coco", "webdataset"],
    "image_suffix": ".png",
    "keypoints": "coco17",
    "shard_size": 1000000000,
    "device": "llvmpipe (LLVM 15.0.6, 256 bits)",
    "version": "0.2.0",
    "license": "",
}
_RECORDING_PLAN: dict[str, Any] = {
    "scene": "0123456789abcdef",
    "frames": 12,
    "topics": ["/anna/joints"],
    "images": "raw",
    "storage": "mcap",
    "compression": "none",
    "max_size": 0,
    "max_duration": 0.0,
    "device": "llvmpipe (LLVM 15.0.6, 256 bits)",
    "version": "0.2.0",
}
_DATA_SET_PLAN: dict[str, Any] = {
    "recipe": "tiny",
    "hash": "0123456789abcdef",
    "seed": 5,
    "formats": ["images", "trc"],
    "device": "llvmpipe (LLVM 15.0.6, 256 bits)",
    "version": "0.2.0",
}
_METADATA = """rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  duration: {{nanoseconds: 0}}
  starting_time: {{nanoseconds_since_epoch: 0}}
  message_count: 0
  topics_with_message_count: []
  compression_format: ''
  compression_mode: ''
  relative_file_paths: [out_0.mcap]
  files: []
  custom_data: {{humansim_recording: '{plan}'}}
  ros_distro: jazzy
"""
_MAGIC = b"\x89MCAP0\r\n"


def _index(key: str, plan: dict[str, Any]) -> str:
    return json.dumps({key: 1, "finished": False, "plan": plan}, indent=1) + "\n"


#: Content of the files of each folder, by the product that the same command makes today.
FOLDERS: dict[str, dict[str, str | bytes]] = {
    "record": {"metadata.yaml": _METADATA.format(plan=json.dumps(_RECORDING_PLAN)), "out_0.mcap": _MAGIC},
    "record-on-cluster": {"recording.json": "llvmpipe 0123456789abcdef\n", "out_0.mcap": _MAGIC},
    "export": {
        "index.json": _index("humansim_export", _EXPORT_PLAN),
        "images/left/000000.png": b"\x89PNG",
        ".frames/000000.json": json.dumps({"files": {}, "formats": {}}),
    },
    "recipe": {
        "index.json": _index("humansim_data_set", _DATA_SET_PLAN),
        "train/scene_000000/index.json": _index("humansim_export", _EXPORT_PLAN),
    },
}


def write_folder(name: str, folder: Path) -> None:
    """Write one of :data:`FOLDERS`."""
    for path, content in FOLDERS[name].items():
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content.encode() if isinstance(content, str) else content)
