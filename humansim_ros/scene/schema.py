"""JSON schema of scene files, for editors (``config/scene.schema.json``)."""

from __future__ import annotations

import json

from humansim_ros.scene.config import SceneConfig

#: Address by which editors know the schema; it need not exist.
SCHEMA_ID = "https://humansim-ros.invalid/scene.schema.json"


def schema_text() -> str:
    """JSON schema (draft 2020-12) of scene files, as text."""
    schema = SceneConfig.model_json_schema()
    top = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": SCHEMA_ID,
        "title": "Scene of humansim_ros",
    }
    return json.dumps(top | {key: value for key, value in schema.items() if key != "title"}, indent=1) + "\n"
