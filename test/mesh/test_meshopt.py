"""The meshopt decoder: streams of npm's meshoptimizer (tools/meshopt/streams.mjs), and damaged streams."""

from __future__ import annotations

import base64
import contextlib
import json
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

from humansim_ros.mesh.meshopt import decode

STREAMS: list[dict[str, Any]] = json.loads((ROOT / "test" / "data" / "meshopt.json").read_text())


def decoded(stream: dict[str, Any], data: bytes) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return decode(data, stream["mode"], stream["filter"], stream["count"], stream["stride"])


@pytest.mark.parametrize("stream", STREAMS, ids=lambda stream: f"{stream['name']} {stream['stride']}")
def test_a_stream_decodes_as_the_reference_decodes_it(stream: dict[str, Any]) -> None:
    ours = decoded(stream, base64.b64decode(stream["data"]))
    theirs = np.frombuffer(base64.b64decode(stream["decoded"]), np.uint8)
    if stream["filter"] in ("NONE", "EXPONENTIAL"):
        np.testing.assert_array_equal(ours, theirs)
        return
    # the specification leaves these one unit in the last place
    signed = "u" if stream["filter"] == "COLOR" else "i"
    dtype = f"<{signed}{stream['stride'] // 4}"
    assert np.abs(ours.view(dtype).astype(int) - theirs.view(dtype)).max() <= 1


@pytest.mark.parametrize("stream", STREAMS[::3], ids=lambda stream: f"{stream['name']} {stream['stride']}")
def test_a_damaged_stream_is_decoded_or_refused_but_never_crashes(stream: dict[str, Any]) -> None:
    whole = base64.b64decode(stream["data"])
    random = np.random.default_rng(len(whole))
    for length in range(1, len(whole), max(len(whole) // 20, 1)):
        with pytest.raises(ValueError, match=r"\w"):
            decoded(stream, whole[:length])
    for _ in range(40):
        harmed = bytearray(whole)
        harmed[random.integers(len(harmed))] = random.integers(256)
        with contextlib.suppress(ValueError):
            assert len(decoded(stream, bytes(harmed))) == stream["count"] * stream["stride"]
