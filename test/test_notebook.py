"""The notebook of the examples runs from top to bottom, and is committed without output."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT

from humansim_ros import Frame, Scene, View

NOTEBOOK = ROOT / "examples" / "notebook.ipynb"


def code_cells() -> list[dict[str, Any]]:
    return [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]


def source(cell: dict[str, Any]) -> str:
    return "".join(cell["source"])


def test_the_notebook_has_no_output() -> None:
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code_cells())
    assert NOTEBOOK.stat().st_size < 20_000


@pytest.mark.gl
@pytest.mark.process
@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    namespace: dict[str, Any] = {}
    shown = []
    for cell in code_cells():
        exec(compile(source(cell), NOTEBOOK.name, "exec"), namespace)
        last = source(cell).rstrip().splitlines()[-1]
        if re.fullmatch(r'scene|frame|frame\.views\["front"\]', last):
            shown.append(eval(last, namespace))
    assert [type(each) for each in shown] == [Scene, Frame, View]
    assert all(len(each._repr_png_()) > 1000 for each in shown)
    said = re.search(r"MPJPE (\d+\.\d) mm, found 100% of the people", capsys.readouterr().out)
    assert said
    assert 2 < float(said[1]) < 25  # a pixel of noise is a centimetre at this distance
