"""A short run of tools/fuzz_motion.py: damaged files give a motion or our error, quickly."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

_SPEC = importlib.util.spec_from_file_location(
    "fuzz_motion", Path(__file__).parent.parent / "tools" / "fuzz_motion.py"
)
assert _SPEC is not None and _SPEC.loader is not None
fuzz_motion = importlib.util.module_from_spec(_SPEC)
sys.modules["fuzz_motion"] = fuzz_motion
_SPEC.loader.exec_module(fuzz_motion)


@pytest.mark.parametrize("name", list(fuzz_motion.READERS))
def test_damaged_files_give_a_result_or_our_error(name: str) -> None:
    outcome = fuzz_motion.fuzz(name, fuzz_motion.corpus_of(name), inputs=1500, seed=7)
    assert outcome.findings == []
    # the damage is neither always harmless nor always fatal
    assert 20 < outcome.kinds["read"] < 1480
    assert outcome.kinds["MotionError"] > 20


def test_the_fuzzer_finds_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    def careless(path: Path) -> float:
        data = path.read_bytes()
        return 1 / data.index(b"HIERARCHY") if b"nan" in data else float(data.count(b"\n") > 2)

    monkeypatch.setitem(fuzz_motion.READERS, "bvh", (careless, "*.bvh"))
    outcome = fuzz_motion.fuzz("bvh", fuzz_motion.corpus_of("bvh"), inputs=400, seed=1)
    assert outcome.kinds["finding: ZeroDivisionError"] == len(outcome.findings) > 0
    assert all(b"nan" in data for _, data in outcome.findings)
