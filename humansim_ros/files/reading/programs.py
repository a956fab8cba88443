"""Other programs: run them under limits on untrusted files, divide the cores, convert FBX files to glTF.

FBX has no open specification. Blender or FBX2glTF converts it, if one is installed."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path

from humansim_ros.errors import HumansimError, located
from humansim_ros.files.reading.files import (
    cache_folder,
    expand_user,
    read_bytes,
    temporary_folder,
    write_file,
)


def cores() -> int:
    """Number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_limits(rendering: int) -> dict[str, str]:
    """Environment variables that divide the CPU cores among several processes. ``rendering``: their number.

    By default Mesa without a GPU, and OpenCV, start one thread per core in each process. Variables that the
    user has set are left out.
    """
    share = max(1, cores() // max(1, rendering))
    threads = {
        # 0: render in the calling thread. Waiting for a single other thread costs a tenth more
        "LP_NUM_THREADS": str(share if share > 1 else 0),
        # a thread without a core of its own delays the others
        "OPENCV_FOR_THREADS_NUM": str(share),
    }
    return {name: number for name, number in threads.items() if name not in os.environ}


#: Environment variable that names the program that converts FBX files.
FBX_VARIABLE = "HUMANSIM_FBX"
#: Largest FBX file, and largest glTF file that it is converted to, bytes.
_MAX_FBX = 1 << 29
#: Limits of a conversion: memory in bytes, processor time and wall-clock time in seconds.
_MEMORY, _CPU_SECONDS, _SECONDS = 8 << 30, 300, 600
#: Most converted files in the cache. The least recently used file is deleted first.
_MOST_CONVERTED = 50
#: Most names in the folder of an FBX file, and in its folders, that are searched for textures.
_MOST_NAMES = 5000
_BINARY_FBX = b"Kaydara FBX Binary"
_IMAGES = (".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff")
_NAMES = ("FBX2glTF", "fbx2gltf", "FBX2glTF-linux-x64", "FBX2glTF-linux-x86_64")

#: Program that runs a command under limits. The limits are not set by this process, since ``preexec_fn`` may
#: block if there are other threads.
_LIMITED = """
import os, resource, sys
memory, seconds, size = map(int, sys.argv[1:4])
resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
os.execv(sys.argv[4], sys.argv[4:])
"""
#: Script that converts in Blender. Images outside the folder of the FBX file are not read.
_BLENDER = """
import os, sys, bpy
source, target, folder = sys.argv[-3:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.fbx(filepath=source, use_image_search=False)
for image in list(bpy.data.images):
    file = os.path.realpath(bpy.path.abspath(image.filepath))
    if image.packed_file is None and not file.startswith(os.path.realpath(folder) + os.sep):
        bpy.data.images.remove(image)
bpy.ops.export_scene.gltf(filepath=target, export_format="GLB")
"""
_BY_HAND = (
    'blender -b --python-expr "import bpy; bpy.ops.wm.read_factory_settings(use_empty=True); '
    "bpy.ops.import_scene.fbx(filepath='{source}'); bpy.ops.export_scene.gltf(filepath='{target}')\""
)


def run_limited(
    command: list[str],
    data: bytes | None = None,
    *,
    memory: int,
    cpu_seconds: int,
    seconds: float,
    environment: dict[str, str] | None = None,
    folder: Path | None = None,
) -> subprocess.CompletedProcess[bytes]:
    """Run a program on an untrusted file. The program and its children end when a limit is reached.

    Args:
        command: Absolute path of the program, and its arguments.
        data: Standard input of the program.
        memory: Most address space, bytes.
        cpu_seconds, seconds: Most processor time, and most wall-clock time, seconds.
        environment, folder: Environment and working directory. If None, those of this process.

    Raises:
        subprocess.TimeoutExpired: The program took more than ``seconds``.
    """
    limits = [str(memory), str(cpu_seconds), str(2 * _MAX_FBX)]
    with subprocess.Popen(
        [sys.executable, "-ISc", _LIMITED, *limits, *command],
        stdin=subprocess.DEVNULL if data is None else subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment,
        cwd=folder,
        start_new_session=True,
    ) as process:
        try:
            output, errors = process.communicate(data, timeout=seconds)
        except BaseException:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            raise
    return subprocess.CompletedProcess(command, process.returncode, output, errors)


def is_fbx(data: bytes) -> bool:
    """Whether the content of a file is FBX, binary or text."""
    return data.startswith(_BINARY_FBX) or (data[:2] == b"; " and b"FBX" in data[:64])


def is_collada(data: bytes) -> bool:
    """Whether the content of a file is COLLADA."""
    start = data[:65536].lstrip(b"\xef\xbb\xbf \t\r\n")
    return start.startswith(b"<") and re.search(rb"<(\w+:)?COLLADA\b", start) is not None


def converted_fbx(
    path: str | os.PathLike[str], error: type[HumansimError], data: bytes | None = None
) -> bytes:
    """Convert an FBX file with its skins, textures and animations to glTF, in a process with limits.

    The environment variable ``HUMANSIM_FBX`` names the converter: a Python that has Blender's package
    ``bpy``, a Blender, or FBX2glTF. If the variable is not set, this Python, ``blender`` and ``FBX2glTF`` on
    the PATH are tried in this order. Results are kept in the cache folder.

    Args:
        path: FBX file. Textures that are not in it are read from its folder and below.
        error: Error class to raise.
        data: Content of the file, if it has been read already.

    Returns:
        Content of a .glb file: metres, y up.

    Raises:
        HumansimError: ``error`` with the path, if no converter is installed (with the line that converts the
            file by hand), or the file is missing or wrong.
    """
    with located(error, path):
        content = read_bytes(path, error, "FBX", _MAX_FBX) if data is None else data
        if not is_fbx(content):
            raise error("not an FBX file: its first bytes are not an FBX header")
        converter = find_converter(Path(path), error)
        cache = _cached_file(Path(path), content, converter)
        if cache is not None and cache.is_file():
            with suppress(OSError):
                os.utime(cache)
                return cache.read_bytes()
        if converter.blender and not content.startswith(_BINARY_FBX):
            raise error("an FBX text file, which Blender does not read: convert it to binary FBX or to glTF")
        converted = _convert(Path(path), converter, error)
        if cache is not None:
            with suppress(OSError, HumansimError):  # such as a full disk
                cache.parent.mkdir(parents=True, exist_ok=True)
                write_file(cache, converted)
                files = sorted(cache.parent.glob("*.glb"), key=lambda file: file.stat().st_mtime)
                for file in files[:-_MOST_CONVERTED]:
                    file.unlink(missing_ok=True)
        return converted


@dataclass(frozen=True)
class _Converter:
    """A program that converts. ``kind``: ``python`` (with bpy), ``blender`` or ``FBX2glTF``."""

    program: str
    kind: str

    @property
    def blender(self) -> bool:
        return self.kind != "FBX2glTF"

    def command(self, source: str, target: str, script: str) -> list[str]:
        folder = str(Path(source).parent)
        if self.kind == "python":
            return [self.program, script, source, target, folder]
        if self.kind == "blender":
            options = ["--background", "--factory-startup", "--python-exit-code", "3", "--python", script]
            return [self.program, *options, "--", source, target, folder]
        return [self.program, "--binary", "--input", source, "--output", target]


def find_converter(path: Path, error: type[HumansimError]) -> _Converter:
    """Find a program that converts FBX files. If there is none, ``error`` has the line that converts
    ``path``."""
    named = os.environ.get(FBX_VARIABLE)
    if named:
        program = shutil.which(expand_user(named))
        if program is None:
            raise error(
                f"{FBX_VARIABLE}={named[:200]!r} is not a program: name a Python with bpy, or unset it"
            )
        name = Path(program).name.lower()
        kind = next((k for k in ("blender", "FBX2glTF") if name.startswith(k.lower())), "python")
        return _Converter(str(Path(program).absolute()), kind)
    if importlib.util.find_spec("bpy") is not None:
        return _Converter(sys.executable, "python")
    for name in ("blender", *_NAMES):
        program = shutil.which(name)
        if program is not None:
            return _Converter(str(Path(program).absolute()), "blender" if name == "blender" else "FBX2glTF")
    line = _BY_HAND.format(source=path.name, target=path.with_suffix(".glb").name)
    raise error(
        "FBX files are read with Blender or FBX2glTF, and neither is installed: install Blender, or set "
        f"{FBX_VARIABLE} to a Python with bpy (pip install bpy), or convert the file elsewhere: {line}"
    )


def _convert(path: Path, converter: _Converter, error: type[HumansimError]) -> bytes:
    with temporary_folder() as folder:
        script, target = folder / "convert.py", folder / "converted.glb"
        script.write_text(_BLENDER)
        own = converter.program == sys.executable  # another Python cannot use the packages of this one
        environment = {key: value for key, value in os.environ.items() if own or not key.startswith("PYTHON")}
        environment |= {"BLENDER_USER_RESOURCES": str(folder), "TMPDIR": str(folder), "OMP_NUM_THREADS": "1"}
        try:
            done = run_limited(
                converter.command(str(path.resolve()), str(target), str(script)),
                memory=_MEMORY,
                cpu_seconds=_CPU_SECONDS,
                seconds=_SECONDS,
                environment=environment,
                folder=folder,
            )
        except subprocess.TimeoutExpired:
            raise error(f"it takes {converter.program} more than {_SECONDS} s: simplify the file") from None
        if done.returncode == 0 and target.is_file():
            return read_bytes(target, error, "converted", _MAX_FBX)
        reason = _last_line(done.stderr) or _last_line(done.stdout)
        if done.returncode < 0:
            reason = f"it was stopped at {_MEMORY >> 30} GB of memory or {_CPU_SECONDS} s"
        if "No module named 'bpy'" in reason:
            reason = "it is a Python without bpy; pip install bpy there"
        raise error(f"{converter.program} cannot convert it: {reason or 'no reason given'}")


def _last_line(text: bytes) -> str:
    """Last line of a program's output that is not empty, without control characters."""
    lines = [" ".join(line.split()) for line in text.decode(errors="replace").splitlines()]
    said = [line for line in lines if any(character.isalpha() for character in line)]
    return "".join(c for c in said[-1][:300] if c.isprintable()) if said else ""


def _cached_file(path: Path, content: bytes, converter: _Converter) -> Path | None:
    """File in the cache for this content, this converter, and the images in the folder and below it."""
    folder = cache_folder()
    if folder is None:
        return None
    digest = hashlib.sha256(content)
    digest.update(repr((converter, _BLENDER)).encode())
    parent = path.resolve().parent
    names = chain(parent.glob("*"), parent.glob("*/*"))
    for image in sorted(name for name in islice(names, _MOST_NAMES) if name.suffix.lower() in _IMAGES):
        with suppress(OSError):  # such as a link to nothing
            state = image.stat()
            digest.update(repr((str(image), state.st_size, state.st_mtime_ns)).encode())
    return folder / "converted" / f"{digest.hexdigest()[:40]}.glb"
