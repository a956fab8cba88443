#!/usr/bin/env bash
# Build the image of the Dockerfile without a registry, and run it: the demo, and a tracker beside the suite.
#
#     sudo tools/containers.sh [FOLDER]
#
# The base image is a minimal Debian from `tools/bare_machine.sh`, in FOLDER (default: a new folder in /var/tmp); podman and
# buildah come from Debian. The commit at HEAD is built. The stage `jazzy` needs the registry and the package server of ROS:
# it is not built. Prints the size of the image, what the tracker measures, and the wall times.
# Exit code: 0 everything passed, 1 a step failed.
set -euo pipefail
[ "$(id -u)" -eq 0 ] || { echo "error: debootstrap needs root: sudo $0" >&2; exit 2; }
folder=${1:-$(mktemp -d /var/tmp/containers.XXXX)}
here=$(cd "$(dirname "$0")" && pwd)
command -v buildah podman crun catatonit >/dev/null ||
    apt-get install -qq -y --no-install-recommends buildah catatonit crun podman >/dev/null

# No overlay, no limits and no control groups: this works inside a container or a sandbox, too.
store=(--root "$folder/store" --storage-driver vfs)
options=(--cgroups=disabled --init --security-opt seccomp=unconfined --shm-size 1g
    --ulimit "nofile=$(ulimit -n)" --ulimit nproc=4096)
podman() {
    # a machine with both versions of control groups confuses crun
    # shellcheck disable=SC2016
    unshare --mount bash -c 'umount /sys/fs/cgroup/unified 2>/dev/null; exec podman "$@"' bash "${store[@]}" --runtime crun "$@"
}
step() { printf '== %s (%d s)\n' "$1" "$SECONDS"; }

step "base image"
"$here/bare_machine.sh" --keep --folder "$folder" --target clean trixie
tar -C "$folder/system-trixie" --exclude=./root/humansim_ros -c . | podman import -q - docker.io/library/debian:trixie-slim

step "image"
rm -rf "$folder/source" && git clone -q "$(git -C "$here" rev-parse --show-toplevel)" "$folder/source"
local_wheels=()
[ ! -d "${PIP_FIND_LINKS:-}" ] || local_wheels=(-v "$PIP_FIND_LINKS:$PIP_FIND_LINKS:ro" --env "PIP_FIND_LINKS=$PIP_FIND_LINKS")
buildah "${store[@]}" bud --isolation chroot --network host "${local_wheels[@]}" --target debian -t humansim_ros \
    "$folder/source" >"$folder/image.log" 2>&1 || { tail -n 25 "$folder/image.log"; exit 1; }
podman images humansim_ros

step "demo"
install -d -m 777 "$folder/demo"
podman run --rm "${options[@]}" -v "$folder/demo:/data/demo" humansim_ros humansim demo | tail -n 3

step "tracker beside the suite, as in compose.yaml"
trap 'podman rm -f suite >/dev/null 2>&1' EXIT
# without a bridge: the network of the host, as multicast needs more than the loopback interface
podman run -d --name suite --network host --ipc shareable "${options[@]}" humansim_ros humansim run >/dev/null
podman run --rm --network container:suite --ipc container:suite "${options[@]}" humansim_ros \
    python /opt/humansim_ros/examples/tracker.py walker 60
step "passed"
