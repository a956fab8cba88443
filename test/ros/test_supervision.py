"""Nodes that die are started again; stop signals end every process in order; nothing is left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import ROOT
from ros_support import write_scene
from waiting import PATIENCE, existing, wait_until

from humansim_ros.files.reading.assets import resource_path
from humansim_ros.ros.processes.node_processes import NodeProcess
from humansim_ros.ros.processes.node_starter import NodeStarter
from humansim_ros.ros.processes.supervisor import Supervisor

HUMANSIM = [sys.executable, "-m", "humansim_ros.cli"]
NODE = [sys.executable, "-m", "humansim_ros.ros.nodes"]
SCENE = """
rate: 20
room: null
humans: {anna: {motion: {file: walk}}}
cameras: {front: {size: [64, 48], position: [3, 0, 1.5], look_at: [0, 0, 1]}}
"""


class Processes:
    """All processes that a test has started, with their descendants: by a variable of their environment."""

    def __init__(self) -> None:
        self._mark = f"HUMANSIM_TEST_MARK={uuid.uuid4()}"

    @property
    def environment(self) -> dict[str, str]:
        """Environment of the processes."""
        return {**os.environ, "PYTHONFAULTHANDLER": "", **dict([self._mark.split("=")])}

    def lines(self) -> dict[int, str]:
        """Command lines by process id."""
        found = {}
        for entry in Path("/proc").iterdir():
            try:
                if self._mark.encode() in (entry / "environ").read_bytes():
                    found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except (OSError, ValueError):
                continue
        return found

    def node(self, name: str) -> int | None:
        """Process id of the node of this name; None if it does not run."""
        for pid, line in self.lines().items():
            # a node of a run is a copy with the name of the node, of which Linux keeps 15 letters
            if f"__node:={name} " in line or name_of(pid) == name[:15]:
                return pid
        return None

    def are_gone(self) -> bool:
        return wait_until(lambda: not self.lines())

    def start(self, command: list[str], output: Path) -> subprocess.Popen[bytes]:
        with output.open("wb") as file:
            return subprocess.Popen(
                command, stdout=file, stderr=subprocess.STDOUT, env=self.environment, start_new_session=True
            )


def name_of(pid: int) -> str:
    """Name of a process, as top shows it; empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


@pytest.fixture
def processes() -> Iterator[Processes]:
    processes = Processes()
    yield processes
    for pid in processes.lines():
        os.kill(pid, signal.SIGKILL)
    assert processes.are_gone()


@pytest.fixture
def output(tmp_path: Path) -> Path:
    return tmp_path / "output"


def is_said(output: Path, words: str) -> bool:
    return wait_until(lambda: words in output.read_text())


def handles_hangup(pid: int | None) -> bool:
    """Whether a process has a handler for SIGHUP, which Python does not install by itself."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
    caught = int(status.partition("SigCgt:")[2].split()[0], 16)
    return bool(caught >> (signal.SIGHUP - 1) & 1)


# Restarts


def test_a_node_is_started_again_at_once_then_later_and_later_then_given_up() -> None:
    from humansim_ros.ros.processes.supervisor import RestartPolicy

    policy = RestartPolicy()
    assert [policy.delay(1.0) for _ in range(6)] == [0.0, 0.5, 1.0, 2.0, 4.0, None]


def test_a_long_run_ends_a_row_of_deaths() -> None:
    from humansim_ros.ros.processes.supervisor import RestartPolicy

    policy = RestartPolicy()
    assert [policy.delay(ran) for ran in (1.0, 1.0, 60.0, 1.0)] == [0.0, 0.5, 0.0, 0.5]


@pytest.mark.nightly
def test_a_node_that_dies_again_and_again_is_given_up(
    ros: None, processes: Processes, tmp_path: Path, output: Path
) -> None:
    run = processes.start([*HUMANSIM, "run", str(write_scene(tmp_path, SCENE))], output)

    def kill() -> None:
        if pid := processes.node("skinner_anna"):
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.05)

    assert wait_until(lambda: run.poll() is not None, step=kill)
    text = output.read_text()
    assert run.returncode == 1, text
    ended = "node skinner_anna ended unexpectedly (signal 9: Killed)"
    assert f"\n{ended}; started again now\n" in text
    assert f"\n{ended}; started again in 4 s\n" in text
    assert f"\nerror: {ended} again and again; the other nodes were stopped\n" in text
    assert processes.are_gone()


def test_a_node_with_wrong_input_is_not_started_again(ros: None, tmp_path: Path) -> None:

    scene = str(write_scene(tmp_path, SCENE))
    wrong = NodeProcess("skinner", "wrong", {"scene": scene, "human": "nobody"})
    with Supervisor([wrong]) as nodes:
        ended = nodes.wait(time.monotonic() + PATIENCE, respawn=True)
    assert ended is not None and ended.code == 2
    assert str(ended) == "node wrong ended unexpectedly (exit code 2)"


@pytest.mark.slow
@pytest.mark.nightly
def test_killed_nodes_are_back_with_their_latched_topics(
    ros: None, processes: Processes, tmp_path: Path
) -> None:
    """A kill of each process: player, skinner and camera."""
    tool = [sys.executable, str(ROOT / "tools" / "kill_nodes.py"), str(write_scene(tmp_path, SCENE))]
    done = subprocess.run(
        [*tool, "--kills", "3", "--limit", str(PATIENCE)],
        env={**processes.environment, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=4 * PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 of 3 back" in done.stdout
    assert "left at the end: nothing" in done.stdout


def test_a_node_is_started_again_with_the_scene_and_the_motion_that_were_read_at_the_start(
    ros: None, processes: Processes, tmp_path: Path, output: Path
) -> None:
    motion = tmp_path / "walk.bvh"
    motion.write_bytes(resource_path("assets/motions/walk.bvh").read_bytes())
    scene = write_scene(tmp_path, SCENE.replace("file: walk", "file: walk.bvh"))
    run = processes.start([*HUMANSIM, "run", str(scene)], output)
    assert is_said(output, "front delivers")
    motion.write_text("nothing")
    scene.write_text("nothing")
    os.kill(processes.node("skinner_anna"), signal.SIGKILL)
    os.kill(processes.node("motion_player"), signal.SIGKILL)
    assert wait_until(lambda: output.read_text().count("[skinner_anna]: skinning anna") == 2)
    assert wait_until(lambda: output.read_text().count("[motion_player]: playing 1 motion at") == 2)
    run.send_signal(signal.SIGINT)
    assert run.wait(PATIENCE) == 0
    assert processes.are_gone()


def test_all_nodes_are_started_again_when_the_process_that_starts_them_is_killed(
    ros: None, tmp_path: Path
) -> None:
    scene = write_scene(tmp_path, SCENE)
    skinner = NodeProcess("skinner", "skinner_anna", {"scene": str(scene), "human": "anna"})
    with Supervisor([skinner, replace(skinner, node_name="second")]) as nodes:
        first = nodes.pids
        assert nodes._starter is not None
        nodes._starter.process.kill()
        while first.keys() & {name for name, pid in nodes.pids.items() if pid == first[name]}:
            assert nodes.wait(time.monotonic() + 0.5, respawn=True) is None
        assert wait_until(lambda: not existing(first.values()))
        assert nodes.dead() is None


def test_a_node_is_started_again_although_nothing_can_be_said(
    ros: None, processes: Processes, tmp_path: Path
) -> None:
    """The output of `humansim run` is a full disk, or a terminal that is gone."""
    command = [*HUMANSIM, "run", str(write_scene(tmp_path, SCENE))]
    with Path("/dev/full").open("wb") as full, (tmp_path / "output").open("wb") as output:
        run = subprocess.Popen(command, stdout=output, stderr=full, env=processes.environment)
    assert wait_until(lambda: processes.node("skinner_anna"))
    killed = processes.node("skinner_anna")
    os.kill(killed, signal.SIGKILL)
    assert wait_until(lambda: processes.node("skinner_anna") not in (None, killed))
    run.send_signal(signal.SIGINT)
    assert run.wait(PATIENCE) == 0
    assert processes.are_gone()


def test_a_run_goes_on_without_a_reader_of_its_output(
    ros: None, processes: Processes, tmp_path: Path, output: Path
) -> None:
    """As with `humansim run | head`: what reports the first images ends quietly."""
    command = [*HUMANSIM, "run", str(write_scene(tmp_path, SCENE))]
    with output.open("wb") as errors:
        run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, env=processes.environment)
    while not run.stdout.readline().startswith(b"starting "):
        assert run.poll() is None
    run.stdout.close()

    def reporters() -> list[str]:
        return [line for line in processes.lines().values() if "first_images" in line]

    assert wait_until(reporters)
    assert wait_until(lambda: not reporters())
    assert "Traceback" not in output.read_text()
    assert run.poll() is None
    run.send_signal(signal.SIGINT)
    run.wait(PATIENCE)
    assert processes.are_gone()


def test_errors_of_the_scene_are_reported_by_the_nodes(
    ros: None, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    gone = NodeProcess("skinner", "skinner_anna", {"scene": str(tmp_path / "gone.yaml"), "human": "anna"})
    with Supervisor([gone]) as nodes:
        ended = nodes.wait(time.monotonic() + PATIENCE, respawn=True)
    assert ended is not None and ended.code == 2
    error = capfd.readouterr().err
    assert error.startswith("error: ") and "gone.yaml" in error


def test_copies_have_no_threads_of_the_process_that_starts_them(ros: None, tmp_path: Path) -> None:
    """A copy has only the thread that forks: a pool of threads would hang there."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with NodeStarter(str(write_scene(tmp_path, SCENE)), environment) as starter:
        node = starter.start(NodeProcess("skinner", "wrong", {"human": "nobody"}), environment)
        assert len(list(Path(f"/proc/{starter.process.pid}/task").iterdir())) == 1
        assert node.wait(PATIENCE) == 2


@pytest.mark.nightly
def test_a_process_that_loads_a_scene_before_the_transport_is_chosen_starts_its_nodes(
    ros: None, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its nodes have variables that are set after its start; another scene has another process."""
    scene = str(write_scene(tmp_path, SCENE))
    skinner = NodeProcess("skinner", "skinner_anna", {"scene": scene, "human": "anna"})
    early, other = NodeStarter(scene), NodeStarter(str(tmp_path / "other.yaml"))
    with Supervisor([skinner], {"RCUTILS_CONSOLE_OUTPUT_FORMAT": "said: {message}"}, early) as nodes:
        assert nodes._starter is early
        heard = ""
        while "said: skinning anna" not in heard:
            assert nodes.wait(time.monotonic() + 0.2) is None
            heard += "".join(capfd.readouterr())
    assert not early.is_running
    with Supervisor([skinner], starter=other) as nodes:
        assert nodes._starter is not other and not other.is_running


# Orphans


def test_a_node_whose_parent_is_dead_already_ends(ros: None, tmp_path: Path) -> None:
    """The parent can die before the node has asked the kernel for a signal at its death."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    result = subprocess.run(
        [*NODE, "motion_player", "--ros-args", "-p", f"scene:={write_scene(tmp_path, SCENE)}"],
        env={**os.environ, "HUMANSIM_PARENT_PID": str(gone.pid)},
        timeout=PATIENCE,
        check=False,
    )
    assert result.returncode == 0


@pytest.mark.daily("0.2")
@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.2, *(0.05 * 1.5**k for k in range(10))])
def test_nothing_is_left_of_a_run_that_is_killed_while_it_starts(
    ros: None, processes: Processes, tmp_path: Path, output: Path, delay: float
) -> None:
    run = processes.start([*HUMANSIM, "run", str(write_scene(tmp_path, SCENE))], output)
    is_said(output, "starting ")
    time.sleep(delay)  # the moment of the kill
    run.kill()
    run.wait()
    assert processes.are_gone()


# Signals


@pytest.mark.daily("INT")
@pytest.mark.parametrize("name", ["INT", "TERM", "HUP", "QUIT"])
def test_a_run_in_the_background_of_a_script_stops_in_order(
    ros: None, processes: Processes, tmp_path: Path, output: Path, name: str
) -> None:
    """Such a shell starts its jobs with SIGINT and SIGQUIT ignored."""
    run = " ".join([*HUMANSIM, "run", str(write_scene(tmp_path, SCENE))])
    script = f"{run} & pid=$!; trap 'kill -{name} $pid' USR1; wait $pid; wait $pid; echo code $?"
    shell = processes.start(["sh", "-c", script], output)
    assert is_said(output, "starting ")
    shell.send_signal(signal.SIGUSR1)
    shell.wait(PATIENCE)
    said = output.read_text()  # nodes may log until they end
    assert "\nstopping\n" in said and said.endswith("\ncode 0\n")
    assert processes.are_gone()


@pytest.mark.daily("bench-SIGHUP", "run-SIGTERM")
@pytest.mark.parametrize(
    ("command", "number"),
    [
        ("bench", signal.SIGHUP),
        ("run", signal.SIGTERM),
        ("bench", signal.SIGINT),
        ("demo", signal.SIGTERM),
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_a_command_that_has_not_finished_says_which_signal_stopped_it(
    ros: None, processes: Processes, tmp_path: Path, output: Path, command: str, number: signal.Signals
) -> None:
    scene = write_scene(tmp_path, SCENE)
    options = ["-o", str(tmp_path / "pictures")] if command == "demo" else []
    process = processes.start([*HUMANSIM, command, str(scene), *options], output)
    if command == "run":
        assert wait_until(lambda: handles_hangup(process.pid))
    else:
        assert wait_until(lambda: len(processes.lines()) == 5)  # with the one that starts the nodes
    process.send_signal(number)
    assert process.wait(PATIENCE) == 128 + number
    assert "Traceback" not in output.read_text()
    assert processes.are_gone()


def test_a_second_signal_kills_what_does_not_stop(
    ros: None, processes: Processes, tmp_path: Path, output: Path
) -> None:
    run = processes.start([*HUMANSIM, "run", str(write_scene(tmp_path, SCENE))], output)
    assert is_said(output, "starting ")
    assert wait_until(lambda: handles_hangup(processes.node("motion_player")))
    os.kill(processes.node("motion_player"), signal.SIGSTOP)
    run.send_signal(signal.SIGINT)
    assert is_said(output, "stopping")

    time.sleep(0.6)  # an earlier signal counts as the same request
    run.send_signal(signal.SIGINT)
    run.wait(PATIENCE)
    assert run.returncode == 130
    assert processes.are_gone()


def test_nohup_is_respected() -> None:
    code = """
import os, signal
signal.signal(signal.SIGHUP, signal.SIG_IGN)
signal.signal(signal.SIGINT, signal.SIG_IGN)
from humansim_ros.ros.processes.stop_signals import StopRequest
StopRequest()
os.kill(os.getpid(), signal.SIGHUP)
print("goes on", flush=True)
os.kill(os.getpid(), signal.SIGINT)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "goes on\n"
    assert done.returncode == 130
    assert not done.stderr


def test_a_node_remembers_a_signal_whose_exception_a_library_has_swallowed() -> None:
    code = """
import os, signal
from humansim_ros.ros.processes.stop_signals import StopRequest
request = StopRequest()
class Swallower:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
del_now = Swallower()
del del_now
print(request.number)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == f"{signal.SIGTERM.value}\n"


@pytest.mark.parametrize(
    ("run", "code"),
    [
        ("from humansim_ros.ros.processes.runtime import run_node; sys.exit(run_node(stop))", 0),
        (
            """import humansim_ros.cli.main as cli; cli.make_app = lambda _: stop()
from humansim_ros.cli.__main__ import main; sys.exit(main())""",
            130,
        ),
    ],
)
def test_a_stop_that_a_library_turns_into_its_own_error_is_a_stop(ros: None, run: str, code: int) -> None:
    """So does the Rust core of pydantic."""
    start = """
import os, signal, sys
def stop():
    try:
        os.kill(os.getpid(), signal.SIGINT)
    except SystemExit:
        raise ValueError("not a schema") from None
"""
    done = subprocess.run([sys.executable, "-c", start + run], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (code, "")


@pytest.mark.daily("camera-0.3", "recorder-1.0")
@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0, 2.0])
@pytest.mark.parametrize(
    "node", ["motion_player", "skinner", "camera", "camera_rig", "recorder", "evaluator"]
)
def test_ctrl_c_while_a_node_starts_is_quiet(
    ros: None, processes: Processes, tmp_path: Path, output: Path, node: str, delay: float
) -> None:
    scene = write_scene(tmp_path, SCENE)
    given = [
        "-p",
        f"scene:={scene}",
        *{"recorder": ["-p", f"output:={tmp_path}/bag"], "evaluator": ["-p", "topic:=/tracker/poses"]}.get(
            node, []
        ),
    ]
    process = processes.start([*NODE, node, "--ros-args", *given], output)
    assert wait_until(lambda: handles_hangup(process.pid))
    time.sleep(delay)  # the moment of the signal
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE) == 0, output.read_text()
    assert "Traceback" not in output.read_text()


@pytest.mark.parametrize("module", ["humansim_ros.ros.nodes.__main__", "humansim_ros.cli.__main__"])
def test_entry_points_import_nothing_before_they_can_be_stopped(module: str) -> None:
    code = f"import sys, {module}; print(sorted({{name.split('.')[0] for name in sys.modules}}))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    for package in ("numpy", "rclpy", "typer", "pydantic"):
        assert f"'{package}'" not in loaded


@pytest.mark.parametrize(
    "name", ["motion_player", "skinner", "camera", "camera_rig", "recorder", "evaluator"]
)
@pytest.mark.parametrize("before", [[], ["--ros-args", "-p", "x:=1"]])
def test_a_node_says_what_it_does(
    before: list[str], name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from humansim_ros.ros.nodes import __main__ as nodes

    monkeypatch.setattr(nodes, "end_process_on_stop", lambda _: None)
    monkeypatch.setattr(sys, "argv", [name, *before, "--help"])
    assert nodes.run(name) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"usage: ros2 run humansim_ros {name} [--ros-args") and len(said) > 200


def test_installed_commands_lead_to_the_light_entry_points() -> None:
    commands = [line.strip(' ",') for line in (ROOT / "setup.py").read_text().splitlines() if ":" in line]
    entries = [
        line.partition(" = ")[2] for line in commands if line.count(":") == 1 and " = humansim_ros." in line
    ]
    assert len(entries) == 11
    assert {entry.partition(":")[0] for entry in entries} == {
        "humansim_ros.cli.__main__",
        "humansim_ros.ros.nodes.__main__",
    }


def test_a_recorder_is_stopped_when_the_others_have_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    program = """
import signal, sys, time
from pathlib import Path
folder, name = Path(sys.argv[1]), sys.argv[2]
def stop(*_):
    if name == "camera":
        time.sleep(0.3)
    (folder / name).write_text(" ".join(sorted(each.name for each in folder.iterdir())))
    sys.exit()
signal.signal(signal.SIGTERM, stop)
(folder / f"{name}_runs").touch()
signal.pause()
"""

    def start(_: Supervisor, process: NodeProcess) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", program, str(tmp_path), process.executable])

    monkeypatch.setattr(Supervisor, "_start", start)
    processes = [NodeProcess("recorder", "recorder", {}, stops_last=True), NodeProcess("camera", "left", {})]
    with Supervisor(processes):
        assert wait_until(lambda: len(list(tmp_path.iterdir())) == 2)
    assert "camera" in (tmp_path / "recorder").read_text().split()
