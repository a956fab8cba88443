"""Output folders on file systems of fsspec: a file has its name only when it is there as a whole."""

from __future__ import annotations

import errno
import pickle
import sys
from pathlib import Path
from typing import Any

import pytest

from humansim_ros.data.engine import OutputFolder
from humansim_ros.errors import HumansimError

fsspec = pytest.importorskip("fsspec")


@pytest.fixture(params=["path", "file", "memory"])
def output(request: pytest.FixtureRequest, tmp_path: Path) -> OutputFolder:
    urls = {
        "path": str(tmp_path / "bags"),
        "file": f"file://{tmp_path}/bags",
        "memory": f"memory://{tmp_path.name}/bags",
    }
    return OutputFolder.at(urls[request.param])


def test_files_are_moved_written_read_and_removed(output: OutputFolder, tmp_path: Path) -> None:
    assert output.names() == set() and output.name == "bags"
    output.create()
    assert output.names() == set()
    source = tmp_path / "shard"
    source.write_bytes(b"first")
    output.put(source, "a_0.mcap")
    assert not source.exists()
    output.write("plan.json", b"{}")
    assert output.names() - {".work"} == {"a_0.mcap", "plan.json"}
    assert output.read("plan.json") == b"{}"
    with output.open("a_0.mcap") as file:
        assert file.read(3) == b"fir" and file.read() == b"st"
    assert (output.size("a_0.mcap"), output.size("b")) == (5, None)
    source.write_bytes(b"second")
    output.put(source, "a_0.mcap")  # as a worker does whose first result was lost
    assert output.read("a_0.mcap") == b"second"
    output.remove("plan.json")
    assert output.names() - {".work"} == {"a_0.mcap"}
    output.write("inner/x", "text")
    assert output.names("inner") == {"x"} and output.read("inner/x") == b"text"
    output.delete("inner")
    output.delete("inner")
    output.remove("a_0.mcap")
    output.remove("a_0.mcap")
    assert output.names() <= {".work"}


def test_an_output_can_be_given_to_another_process(output: OutputFolder) -> None:
    output.create()
    copy = pickle.loads(pickle.dumps(output))
    copy.write("x", "")
    assert output.names() - {".work"} == {"x"} and (type(copy), copy.url) == (type(output), output.url)


def test_only_a_path_is_local(tmp_path: Path) -> None:
    assert OutputFolder.at(tmp_path).local == tmp_path
    assert OutputFolder.at("memory://bags").local is None


@pytest.mark.parametrize("url", ["file://{}/bags", "memory://{}/full"])
def test_a_disk_that_is_full_leaves_no_file(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = OutputFolder.at(url.format(tmp_path))
    output.create()
    system = output._place[0]
    put = type(system).put_file

    def put_half(self: Any, source: str, target: str, **options: Any) -> None:
        put(self, source, target, **options)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(type(system), "put_file", put_half)
    source = tmp_path / "shard"
    source.write_bytes(b"content")
    with pytest.raises(
        HumansimError, match=r"(bags|full): the output cannot be used: No space left on device"
    ):
        output.put(source, "a_0.mcap")
    assert output.names() <= {".work"} and source.exists()
    assert system.find(output._place[1]) == []


def test_a_file_system_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    with pytest.raises(HumansimError, match=r"^nothing://x: the output cannot be used: Protocol not known"):
        OutputFolder.at("nothing://x").names()
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(HumansimError, match="file"):
        OutputFolder(str(tmp_path / "file")).names()
    with pytest.raises(HumansimError, match="cannot be written: Not a directory"):
        OutputFolder(str(tmp_path / "file" / "bags")).create()


def test_missing_libraries_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(HumansimError, match=r"s3://bucket/x: Install s3fs to access S3"):
        OutputFolder.at("s3://bucket/x").names()
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(HumansimError, match=r"pip install 'humansim_ros\[ray\]'"):
        OutputFolder.at("s3://bucket/x").names()
