#!/usr/bin/env bash
# Test the two commands of the README on bare Debian machines: a minimal system with `make` and nothing else.
#
#     sudo tools/bare_machine.sh [--target TARGET]... [--folder FOLDER] [--keep] [RELEASE ...]
#
# RELEASE   Debian releases to test. Default: bookworm trixie.
# --target  make target to run in each release, in the given order. Default: demo, then test.
# --folder  folder for logs, demo pictures and systems (one per release). Default: a new folder in /var/tmp.
# --keep    keep the systems. The next call with the same folder reuses them and updates only the checkout.
#
# A system is a chroot from `debootstrap --variant=minbase`; it grows to 4 GB. The commit at HEAD is tested;
# uncommitted changes are not. The Debian mirror, proxies, certificates and pip settings of this machine are used.
# The script prints the wall time of each step. Exit code: 0 all steps passed, 1 a step failed, 2 wrong usage.
# shellcheck disable=SC2329  # functions are called by name
set -euo pipefail

die() { printf 'error: %s\n' "$*" >&2; exit 2; }

targets=() releases=() folder='' keep=''
while [ $# -gt 0 ]; do
    case $1 in
        --target) targets+=("${2:?error: --target needs a make target}"); shift ;;
        --folder) folder=${2:?error: --folder needs a folder}; shift ;;
        --keep) keep=yes ;;
        -h | --help) sed -n '2,/^# shellcheck/{/shellcheck/!s/^# \?//p}' "$0"; exit ;;
        -*) die "unknown option $1; see --help" ;;
        *[!a-z]* | '') die "not the name of a release: $1" ;;
        *) releases+=("$1") ;;
    esac
    shift
done
[ "$(id -u)" -eq 0 ] || die "debootstrap and chroot need root: sudo $0"
[ ${#targets[@]} -gt 0 ] || targets=(demo test)
[ ${#releases[@]} -gt 0 ] || releases=(bookworm trixie)
command -v git >/dev/null || die "git is missing: apt-get install -y git"
command -v debootstrap >/dev/null || { apt-get -qq update && apt-get install -qq -y debootstrap >/dev/null; } ||
    die "debootstrap is missing: apt-get install -y debootstrap"

checkout=$(git -C "$(dirname "$0")" rev-parse --show-toplevel)
mkdir -p "${folder:=$(mktemp -d /var/tmp/bare_machine.XXXX)}"
folder=$(cd "$folder" && pwd)

# Package settings of this machine: the mirror of apt, variables, and files.
mirror=$(apt-get indextargets --format "\$(LABEL) \$(REPO_URI)" 'Created-By: Packages' | sed -n '/^Debian /{s///p;q}')
readarray -t variables < <(env | grep -Ei '^(PIP_[A-Z_]+|(https?|no|all)_proxy|SSL_CERT_FILE|REQUESTS_CA_BUNDLE)=')
pip_files=(/etc/pip.conf "$HOME/.pip/pip.conf" "$HOME/.config/pip/pip.conf")
files=("${pip_files[@]}" /etc/ssl/certs/ca-certificates.crt /usr/local/share/ca-certificates)

# Local folders of packages in the settings of pip. Pages of a file:// index link to files beside its folder.
wheels=()
while read -r path; do
    [ ! -d "$path" ] || wheels+=("$path")
done < <({ printf '%s\n' "${variables[@]}"; cat "${pip_files[@]}" 2>/dev/null; } | grep -oE '(file://)?/[^ ]+' |
    sed 's|^file://\(/.*\)/[^/]*$|\1|' | sort -u)

# Create a system, or update the checkout in one that exists.
prepare() {
    local root=$1
    [ -e "$root/complete" ] || { create "$root" && touch "$root/complete"; } || return
    git -C "$root$HOME/humansim_ros" fetch -q "$checkout" HEAD &&
        git -C "$root$HOME/humansim_ros" checkout -q --force --detach FETCH_HEAD &&
        run_in "$root" sh -c 'apt-get update && apt-get install -y make'
}

create() {
    local root=$1 release=${1##*-} file
    rm -rf --one-file-system "$root"
    # debootstrap mounts /proc; in a namespace of its own that mount ends with it, also when it is interrupted
    unshare --mount debootstrap --variant=minbase "$release" "$root" "${mirror:-http://deb.debian.org/debian}" || return
    for file in "${files[@]}"; do
        [ ! -e "$file" ] || (cd / && cp -RL --parents "${file#/}" "$root") || return
    done
    apt-config dump Acquire | grep -E '^Acquire::(https?|Check|Retries)' >"$root/etc/apt/apt.conf.d/90host"
    git clone -q --no-hardlinks "$checkout" "$root$HOME/humansim_ros"
}

# Run a command in the checkout of a system. Its mounts and processes end with it: they are in namespaces of its own.
run_in() {
    # shellcheck disable=SC2016  # the inner shell expands these
    unshare --mount --pid --fork --kill-child bash -euc '
        root=$1 count=$2
        shift 2
        mount -t proc proc "$root/proc"
        mount -t sysfs -o ro sysfs "$root/sys"
        mount -t devpts devpts "$root/dev/pts"
        mount -t tmpfs -o mode=1777 tmpfs "$root/dev/shm"
        for wheels in "${@:1:count}"; do
            mkdir -p "$root$wheels"
            mount --bind -o ro "$wheels" "$root$wheels"
        done
        shift "$count"
        # not exec: this bash is process 1, which has to reap the orphans of the command
        chroot "$root" env -i --chdir="$HOME/humansim_ros" "$@"
        exit
    ' bash "$1" "${#wheels[@]}" "${wheels[@]}" "HOME=$HOME" DEBIAN_FRONTEND=noninteractive \
        PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin "${variables[@]}" "${@:2}" </dev/null
}

failed=0
# Run one step of a release: its output goes to a log, its result and wall time to the terminal.
step() {
    local log="$folder/$1-$2.log" result=passed begin=$SECONDS
    "${@:3}" >"$log" 2>&1 || result=FAILED
    printf '%-10s %-10s %s in %d s\n' "$1" "$2" "$result" $((SECONDS - begin))
    [ $result = passed ] || { failed=1; tail -n 25 "$log"; printf 'full log: %s\n' "$log"; return 1; }
}

clean_up() {
    [ -n "$keep" ] || for release in "${releases[@]}"; do rm -rf --one-file-system "$folder/system-$release"; done
    printf 'logs%s are in %s\n' "${keep:+ and systems}" "$folder"
}
trap clean_up EXIT

for release in "${releases[@]}"; do
    root=$folder/system-$release
    step "$release" system prepare "$root" || continue
    for target in "${targets[@]}"; do
        step "$release" "$target" run_in "$root" make "$target" || true
    done
    if [ -d "$root$HOME/humansim_ros/demo" ]; then
        rm -rf "$folder/$release-pictures"
        cp -R "$root$HOME/humansim_ros/demo" "$folder/$release-pictures"
    fi
done
exit $failed
