#!/usr/bin/env bash
# Make a virtual environment with this package in it: tools/setup_env.sh EXTRAS (such as ros or ros,test).
# Does nothing, at once, if that was done before and nothing it depends on has changed.
# Every package has the version in constraints.txt: a release of tomorrow changes nothing here.
# PYTHON chooses the interpreter (default: the first of 3.10 to 3.13 found), VENV the folder (default: .venv).
set -euo pipefail
cd "$(dirname "$0")/.."

extras=$1
venv=${VENV:-.venv}
log="$venv/pip.log"
# as variables also for the environments in which pip builds packages; the second one is for pip 25.3 and later
export PIP_CONSTRAINT=$PWD/constraints.txt PIP_BUILD_CONSTRAINT=$PWD/constraints.txt

say() { printf '%s\n' "$*" >&2; }
die() { say "error: $*"; exit 1; }

is_suitable() {
    "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null
}

find_python() {
    # an environment that is there already is kept; python3 is the one that the package python3-venv belongs to
    for candidate in ${PYTHON:-"$venv/bin/python" python3 python3.12 python3.11 python3.13 python3.10}; do
        if is_suitable "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    die "this needs Python 3.10 to 3.13 (${PYTHON:-python3} is $("${PYTHON:-python3}" -V 2>/dev/null || echo not there))." \
        "Name one with: make demo PYTHON=/path/to/python3.12"
}

missing_packages() {
    "$python" -c 'import ensurepip, venv' 2>/dev/null || echo python3-venv
    "$python" tools/egl_probe.py || echo libegl1 libgl1 libgl1-mesa-dri
}

install_system_packages() {
    command -v apt-get >/dev/null || die "system libraries are missing; on Debian and Ubuntu they are called: $*"
    if [ "$(id -u)" -ne 0 ]; then
        die "system libraries are missing. Type this, then try again:

    sudo apt-get update && sudo apt-get install -y --no-install-recommends $*
"
    fi
    say "Installing system libraries: $*"
    export DEBIAN_FRONTEND=noninteractive
    { apt-get update -qq && apt-get install -qq -y --no-install-recommends "$@" >/dev/null; } ||
        die "apt-get could not install: $*"
}

# What the installed state follows from: the description of the package, the files that ROS finds in the environment,
# the interpreter, and where the checkout is.
fingerprint() {
    { cat setup.py setup.cfg pyproject.toml constraints.txt package.xml launch/*.py; "$python" -V; pwd; } | sha256sum
}

is_installed() {
    for extra in ${extras//,/ }; do
        [ "$(cat "$venv/.humansim-$extra" 2>/dev/null)" = "$(fingerprint)" ] || return 1
    done
}

# On a terminal one line that tells what pip is at; the whole story goes to the log.
progress() {
    if [ -t 2 ]; then
        tee "$log" | awk '/^ *(Collecting|Installing|Building) /{ printf "\r\033[K  %.90s", $0; fflush() }
                          END { printf "\r\033[K" }' >&2
    else
        cat >"$log"
    fi
}

install() {
    say "Installing humansim_ros[$extras] into $venv, $("$python" -V): half a minute, plus 280 MB of download at first."
    if [ "$("$venv/bin/python" -V 2>/dev/null)" != "$("$python" -V)" ] || ! "$venv/bin/python" -c 'import pip' 2>/dev/null; then
        "$python" -m venv --clear "$venv"
    fi
    if ! "$venv/bin/python" -m pip install --disable-pip-version-check -e ".[$extras]" 2>&1 | progress; then
        tail -n 25 "$log" >&2
        [ "$(uname -m)" = x86_64 ] || say "ROS wheels exist for x86-64 only: on $(uname -m) use a ROS Jazzy install."
        die "pip failed; all it said is in $log"
    fi
    for extra in ${extras//,/ }; do
        fingerprint >"$venv/.humansim-$extra"
    done
    say "Installed in $SECONDS s."
}

[ -n "${PYTHON:-}" ] || command -v python3 >/dev/null || install_system_packages python3 python3-venv
python=$(find_python)
packages=$(missing_packages | xargs)
if [ -n "$packages" ]; then
    # shellcheck disable=SC2086  # one word per package
    install_system_packages $packages
    [ -z "$(missing_packages)" ] || die "$packages: installed, but $python still does not find them"
fi
is_installed || install
