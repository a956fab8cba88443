#!/usr/bin/env bash
# Build wheel and sdist into dist/, check them, install each in a fresh environment and run the demo there.
# PYTHON chooses the interpreter (default: python3). Needs network or a package index that pip is configured for.
set -euo pipefail
cd "$(dirname "$0")/.."

python=${PYTHON:-python3}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# A source tree on the path would hide that the installed package lacks a file.
unset PYTHONPATH AMENT_PREFIX_PATH

"$python" -m venv "$work/tools"
"$work/tools/bin/pip" install --quiet build twine
rm -rf dist
# The wheel is built from the sdist, so the sdist has everything that a build needs.
"$work/tools/bin/python" -m build --outdir dist . >"$work/build.log" 2>&1 || { tail -n 40 "$work/build.log"; exit 1; }
"$work/tools/bin/twine" check --strict dist/*
missing=$(comm -23 <(git ls-files | sort) <(tar tzf dist/*.tar.gz | cut -d/ -f2- | sort))
[ -z "$missing" ] || { printf 'error: not in the sdist (MANIFEST.in):\n%s\n' "$missing" >&2; exit 1; }

for file in dist/*.whl dist/*.tar.gz; do
    echo "== $file: install, run the demo"
    target="$work/$(basename "$file")-installed"
    "$python" -m venv "$target"
    "$target/bin/pip" install --quiet "$PWD/${file}[ros]"
    mkdir "$target/empty"
    (cd "$target/empty" && "$target/bin/humansim" demo --seconds 2 --output demo && ls demo)
done
echo "dist/ is ready: $(cd dist && echo *)"
