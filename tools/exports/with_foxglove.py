"""Read a recording of the format ``foxglove`` with mcap, and each message with Foxglove's own classes.

    humansim export SCENE.yaml --frames 30 -o walk --format foxglove
    python tools/exports/with_foxglove.py walk

The JSON of each message must have no field that Foxglove's protobuf schemas lack. Needs mcap 1.1 and
foxglove-schemas-protobuf 0.4: pip install mcap foxglove-schemas-protobuf
"""

from __future__ import annotations

import importlib
import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from google.protobuf import json_format
from mcap.reader import make_reader

#: Frames that transforms must know.
_WORLD = "map"


def with_times(value: Any) -> Any:
    """Times as protobuf's JSON has them."""
    if isinstance(value, list):
        return [with_times(each) for each in value]
    if not isinstance(value, dict):
        return value
    changed = {}
    for key, each in value.items():
        if isinstance(each, dict) and each.keys() == {"sec", "nsec"}:
            seconds = f"{each['sec'] % 60:02d}.{each['nsec']:09d}"
            minutes, hours = each["sec"] // 60 % 60, each["sec"] // 3600
            stamp = f"1970-01-01T{hours:02d}:{minutes:02d}:{seconds}Z"
            changed[key] = stamp if key == "timestamp" else f"{each['sec']}.{each['nsec']:09d}s"
        else:
            changed[key] = with_times(each)
    return changed


def main(export: Path) -> None:
    """Print what was read."""
    counts: Counter[str] = Counter()
    frames, known = set[str](), {_WORLD}
    with (export / "foxglove" / "foxglove.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
            declared = json.loads(schema.data)
            content = json.loads(message.data)
            assert declared["title"] == schema.name and content.keys() == declared["properties"].keys()
            module = importlib.import_module(
                f"foxglove_schemas_protobuf.{schema.name.removeprefix('foxglove.')}_pb2"
            )
            kind = getattr(module, schema.name.removeprefix("foxglove."))
            parsed = json_format.ParseDict(with_times(content), kind())
            assert parsed.ByteSize()
            counts[f"{channel.topic} {schema.name}"] += 1
            if "frame_id" in content:
                frames.add(content["frame_id"])
            known |= {each["child_frame_id"] for each in content.get("transforms", ())}
        assert reader.get_summary() is not None
    for name, count in sorted(counts.items()):
        print(f"{count:6d} {name}")
    print(f"{sum(counts.values())} messages are messages of Foxglove's schemas")
    if frames - known:
        sys.exit(f"no transform to {', '.join(sorted(frames - known))}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
