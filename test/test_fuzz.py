"""A short run of tools/fuzz.py: damaged files give a result or an error of the package, in a short time."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

_SPEC = importlib.util.spec_from_file_location("fuzz", Path(__file__).parent.parent / "tools" / "fuzz.py")
assert _SPEC is not None and _SPEC.loader is not None
fuzz = importlib.util.module_from_spec(_SPEC)
sys.modules["fuzz"] = fuzz
_SPEC.loader.exec_module(fuzz)


@pytest.mark.daily("100-bvh", "100-c3d", "100-obj", "100-glb", "100-calibration", "100-scene")
@pytest.mark.slow
@pytest.mark.parametrize("name", list(fuzz.READERS))
@pytest.mark.parametrize("inputs", [100, pytest.param(300, marks=pytest.mark.nightly)])
def test_damaged_files_give_a_result_or_an_error_of_the_package(
    name: str, inputs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # processor time, too, grows on a loaded machine
    for limit in ("_SECONDS", "_SECONDS_PER_BYTE", "_SECONDS_OF_SCENES"):
        monkeypatch.setattr(fuzz, limit, 10 * getattr(fuzz, limit))
    inputs = round(inputs * {"bvh": 5, "keyframes": 5, "scene": 0.2}.get(name, 1))
    outcome = fuzz.fuzz(name, fuzz.corpus_of(name), inputs, seed=7)
    assert outcome.findings == []
    # the damage is neither always harmless nor always fatal
    assert 0.01 * inputs <= outcome.kinds["read"] < 0.99 * inputs  # few archives pass their checksums
    assert sum(count for kind, count in outcome.kinds.items() if kind.endswith("Error")) > 0.01 * inputs


def test_the_fuzzer_finds_an_error_of_another_type(monkeypatch: pytest.MonkeyPatch) -> None:
    def careless(path: Path) -> float:
        data = path.read_bytes()
        return 1 / data.index(b"HIERARCHY") if b"nan" in data else float(data.count(b"\n") > 2)

    monkeypatch.setitem(fuzz.READERS, "bvh", (careless, "*.bvh"))
    outcome = fuzz.fuzz("bvh", fuzz.corpus_of("bvh"), inputs=400, seed=1)
    assert outcome.kinds["finding: ZeroDivisionError"] == len(outcome.findings) > 0
    assert all(b"nan" in data for _, data in outcome.findings)
